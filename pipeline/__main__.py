"""The command line; the one place where the pipeline meets its viewer."""

from __future__ import annotations

import atexit
import difflib
import errno
import gc
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from scanchain.commands.batch import batch
from scanchain.commands.compare import compare
from scanchain.commands.config import config
from scanchain.commands.convert import convert
from scanchain.commands.doctor import doctor
from scanchain.commands.evaluate import evaluate
from scanchain.commands.info import info
from scanchain.commands.landmarks import landmarks
from scanchain.commands.optimize import optimize
from scanchain.commands.run import run
from scanchain.commands.sequence import sequence
from scanchain.commands.simulate import simulate
from scanchain.commands.view import view
from scanchain.config import RecordingConfig
from scanchain.errors import InputError, ScanchainError, told
from scanchain.runs.recorder import Recorder, SinkName, Viewing

if TYPE_CHECKING:
    from scanchain.batch.task import Row
    from scanchain.graph.optimisation import GraphChange
    from scanchain.landmarks.study import Study


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="scanchain", message="%(prog)s %(version)s")
def scanchain() -> None:
    """Lidar logs in, trajectory and map out.

    \b
    Examples:
      scanchain simulate office office.mcap
      scanchain run office.mcap --out runs/office
      scanchain view runs/office

    Exit codes: 0 done, 1 the run failed, was stopped, or most of its scans are degenerate or lost,
    2 bad input or arguments.
    """


_COMMANDS = (
    run, batch, view, compare, info, doctor, convert, simulate, evaluate, optimize, landmarks, config, sequence,
)  # fmt: skip
for _command in _COMMANDS:
    scanchain.add_command(_command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; every error is one line on stderr, the exit code is returned."""
    viewing = Viewing(
        _record, _show, _draw, _report, _present_batch, _present_comparison, _draw_graph, _record_graph,
        _present_landmarks, _record_landmarks,
    )  # fmt: skip
    words = list(sys.argv[1:] if arguments is None else arguments)
    atexit.register(gc.freeze)  # else garbage is sought once more, for half a second, before the interpreter goes
    try:
        return scanchain.main(words, prog_name="scanchain", obj=viewing, standalone_mode=False) or 0
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return 2
    except click.UsageError as error:
        if isinstance(error, click.NoSuchOption):
            error = _with_near_options(error)
        path = error.ctx.command_path if error.ctx else "scanchain"
        return _fail(f"{error.format_message().rstrip('.')}; see {path} --help", 2)
    except click.ClickException as error:
        return _fail(error.format_message(), 2)
    except InputError as error:
        return _fail(str(error), 2)
    except ScanchainError as error:
        return _fail(str(error), 1)
    except (KeyboardInterrupt, click.Abort):
        return _fail("interrupted", 1)
    except BrokenPipeError:  # the reader of our output went away, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        return _unforeseen(error)


def _unforeseen(error: Exception) -> int:
    """What nobody raised on purpose: a remedy where the system refused something, else the way to the place."""
    if os.environ.get("SCANCHAIN_DEBUG"):
        raise error
    if isinstance(error, OSError) and told(error):
        return _fail(told(error), 2 if error.errno == errno.ENAMETOOLONG else 1)
    return _fail(f"{type(error).__name__}: {error}; SCANCHAIN_DEBUG=1 shows where it happened", 1)


def _with_near_options(error: click.NoSuchOption) -> click.NoSuchOption:
    """The error without suggestions that are near only by the hyphens that every option begins with."""
    bare = {option.lstrip("-"): option for option in error.possibilities or ()}
    near = [bare[name] for name in difflib.get_close_matches(error.option_name.lstrip("-"), bare)]
    return click.NoSuchOption(error.option_name, possibilities=near, ctx=error.ctx)


def _fail(message: str, code: int) -> int:
    click.echo(f"error: {' '.join(message.split())}", err=True)
    return code


def _record(
    path: Path | None, *, dimension: int, name: str, sinks: frozenset[SinkName], config: RecordingConfig
) -> Recorder:
    from scanchain.viz.recording import Recording

    return Recording(path, dimension=dimension, name=name, sinks=sinks, config=config)


def _show(path: Path, tell: Callable[[str], None], in_browser: bool) -> None:
    from scanchain.viz.show import show

    show(path, tell, in_browser=in_browser)


def _draw(directory: Path, picture: Path) -> None:
    from scanchain.viz.run_picture import draw_run

    draw_run(directory, picture)


def _draw_graph(change: GraphChange, picture: Path) -> None:
    from scanchain.viz.graph_picture import draw_graph

    draw_graph(change, picture)


def _record_graph(change: GraphChange, path: Path) -> None:
    from scanchain.viz.graph_recording import record_graph

    record_graph(change, path)


def _report(directory: Path) -> None:
    from scanchain.viz.run_report import write_run_report

    write_run_report(directory)


def _present_batch(directory: Path, rows: Sequence[Row], command: Sequence[str]) -> None:
    from scanchain.viz.batch_report import write_batch_report

    write_batch_report(directory, rows, command)


def _present_comparison(directory: Path) -> None:
    from scanchain.viz.compare_recording import record_comparison
    from scanchain.viz.compare_report import write_compare_report

    write_compare_report(directory)
    record_comparison(directory)


def _present_landmarks(directory: Path, studies: Sequence[Study]) -> None:
    from scanchain.viz.landmark_report import write_report

    write_report(directory, studies)


def _record_landmarks(studies: Sequence[Study], path: Path) -> None:
    from scanchain.viz.landmark_recording import record_landmarks

    record_landmarks(studies, path)


if __name__ == "__main__":
    sys.exit(main())
