"""The command line."""

from __future__ import annotations

import atexit
import errno
import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress

import click

from scanchain.commands.calibrate import calibrate
from scanchain.commands.evaluate import evaluate
from scanchain.commands.landmarks import landmarks
from scanchain.commands.logs import convert, doctor, info, simulate
from scanchain.commands.many import batch, compare
from scanchain.commands.maps import changes, localize, map_group, merge
from scanchain.commands.optimize import optimize
from scanchain.commands.preparing import config, sequence, warm_up
from scanchain.commands.run import check, run, view
from scanchain.errors import InputError, OwnCodeError, ScanchainError, printable, remedy_of, spelled

_SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 110, "show_default": True}


@click.group(context_settings=_SETTINGS)
@click.version_option(package_name="scanchain", message="%(prog)s %(version)s")
@click.option(
    "--debug", is_flag=True, expose_value=False, help="Print tracebacks of errors; after a command, too."
)
def scanchain() -> None:
    """Lidar logs in, trajectory and map out.

    \b
    Examples:
      scanchain simulate office office.mcap
      scanchain run office.mcap --out runs/office
      scanchain view runs/office

    Exit codes: 0 done, 1 the run failed, was stopped, or its result is not trustworthy,
    2 bad input or arguments.
    """


for _command in (
    run, localize, merge, changes, map_group, check, batch, view, compare, info, doctor, calibrate, convert,
    simulate, evaluate, optimize, landmarks, config, sequence, warm_up,
):  # fmt: skip
    scanchain.add_command(_command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; every error is one line on stderr, the exit code is returned.

    arguments : None for those of the process, which then exits with that code at once: it skips the quarter of a
        second in which the interpreter would free memory that the system frees anyway
    """
    if arguments is not None:
        return _run(list(arguments))
    code = _run(sys.argv[1:])
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # a closed stream
            stream.flush()
    os._exit(code)


def _run(words: list[str]) -> int:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small: threads would wait for each other
    if words[:1] != ["batch"] and (odd := next((word for word in words if spelled(word) != word), "")):
        return _fail(f"{spelled(odd)}: the name is not UTF-8; rename it", 2)
    is_debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    try:
        return scanchain.main(words, prog_name="scanchain", standalone_mode=False) or 0
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return 2
    except click.UsageError as error:
        path = error.ctx.command_path if error.ctx else "scanchain"
        return _fail(f"{error.format_message().rstrip('.')}; see {path} --help", 2)
    except click.ClickException as error:
        return _fail(error.format_message(), 2)
    except ScanchainError as error:
        hint = _traced(error, is_debug) if is_debug or isinstance(error, OwnCodeError) else ""
        return _fail(error.text + hint, 2 if isinstance(error, InputError) else 1)
    except (KeyboardInterrupt, click.Abort):
        return _fail("interrupted", 1)
    except BrokenPipeError:  # the reader of our output closed the pipe, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        hint = _traced(error, is_debug)
        if isinstance(error, OSError) and remedy_of(error):
            return _fail(remedy_of(error), 2 if error.errno == errno.ENAMETOOLONG else 1)
        return _fail(f"{type(error).__name__}: {error}{hint}", 1)


def _traced(error: Exception, is_debug: bool) -> str:
    """Print the traceback of an error if asked for, else return how to get it."""
    if not is_debug:
        return "; --debug shows the traceback"
    traceback.print_exception(error)
    return ""


def _fail(message: str, code: int) -> int:
    click.echo(f"error: {printable(' '.join(message.split()))}", err=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
