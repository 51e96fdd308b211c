"""Options shared by commands, as decorators (configuration keys, --out, --gt, limits), and output of results."""

from __future__ import annotations

import gc
from collections.abc import Callable, Collection, Sequence
from functools import reduce
from math import inf, isfinite, isnan
from pathlib import Path
from typing import Any

import click

from scanchain.config import NO_TOPIC
from scanchain.errors import InputError
from scanchain.files import source_of
from scanchain.processes import MIB_PER_GIB
from scanchain.settings import Override
from scanchain.threads import MOST, use_threads

_ALIASES = "scanchain.commands.aliases"
PATH = click.Path(path_type=Path)


def collect_garbage_seldom() -> None:
    """Run the garbage collector less often, for commands that process a log."""
    gc.set_threshold(500_000)  # new objects; frequent collections cost 5 % of the time


class NumberRange(click.FloatRange):
    """A range of numbers that also rejects NaN, which passes the comparisons of click."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number; fails if it is NaN or out of range."""
        number = super().convert(value, param, ctx)
        if isnan(number):
            self.fail(f"{value} is no number.", param, ctx)
        return number


ABOVE_ZERO = NumberRange(0.0, min_open=True)


class OverrideCommand(click.Command):
    """Command that takes any configuration key as ``--section.key value``; ``overrides`` are all given ones.

    Options with a dot in their name are taken out of the arguments before click sees the rest.
    """

    def __init__(self, *words: Any, options_metavar: str = "[OPTIONS] [--section.key VALUE]...", **more: Any):
        super().__init__(*words, options_metavar=options_metavar, **more)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the overrides and the ordinary arguments; for a key that is set twice, the last value counts.

        Keys that are written out override their short forms.
        """
        rest: list[str] = []
        overrides: list[Override] = []
        words = iter(args)
        for word in words:
            if word == "--":
                rest += [word, *words]
                break
            flag, equals, text = word.partition("=")
            if not flag.startswith("--") or "." not in flag:
                rest.append(word)
                continue
            text = text if equals else next(words, "")
            if not equals and not text:
                raise click.UsageError(f"{flag} needs a value, as in {flag} VALUE", ctx)
            overrides.append(Override(flag[2:], text, flag))
        unused = super().parse_args(ctx, rest)
        ctx.params["overrides"] = (*ctx.meta.get(_ALIASES, ()), *overrides)
        return unused


def key(flag: str, name: str, *, value: str | None = None, **attributes: Any) -> Callable[[Any], Any]:
    """An option that sets a configuration key; with ``value``, a flag without argument that sets this value."""

    def keep(ctx: click.Context, _: click.Parameter, given: str | bool | tuple[str, ...] | None) -> None:
        given = (",".join(given) or None) if isinstance(given, tuple) else given  # a tuple if ``multiple``
        if given not in (None, False):
            ctx.meta.setdefault(_ALIASES, []).append(Override(name, value or str(given), flag))

    return click.option(flag, is_flag=True if value else None, expose_value=False, callback=keep, **attributes)


logs = click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=source_of)


def _together(*options: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Several options as one decorator, in this order."""
    return lambda command: reduce(lambda decorated, option: option(decorated), reversed(options), command)


def part(log: str = "the log", *, topic: str = "the only one that fits") -> Callable[[Any], Any]:
    """``--topic``, ``--start``, ``--end`` and ``--every``, the part of a log.

    log, topic : in words, the log that is cut, and the lidar topic used without ``--topic``
    """
    of = "" if log == "the log" else f" of {log}"
    topics = f"Lidar topic{of}; several are combined, in the frame of the first. [default: {topic}]"
    begin = f"Skip {log} up to this time, counted from its first message."
    return _together(
        key("--topic", "log.topic", metavar="TOPIC", multiple=True, help=topics),
        key("--start", "log.start_s", metavar="SECONDS", help=begin),
        key("--end", "log.end_s", metavar="SECONDS", help=f"Skip {log} after this time."),
        key("--every", "log.every", metavar="N", help="Take every N-th scan."),
    )


threads = click.option(
    "--threads",
    type=click.IntRange(1, MOST),
    metavar="N",
    callback=lambda _, __, count: None if count is None else use_threads(count),
    expose_value=False,
    help="Threads to compute with; the results are the same. [default: SCANCHAIN_THREADS, or one for each core]",
)
matcher = key(
    "--matcher",
    "matching.matcher",
    metavar="plicp|svd|MODULE:CLASS",
    help="LM-PLICP (the default), SVD-ICP, or your own class (scanchain.registration.Matcher).",
)
no_loops = key("--no-loops", "loops.enabled", value="false", help="Odometry only, no loop closures.")
error_bars = key(
    "--error-bars",
    "outputs.error_bars",
    metavar="full|quick",
    help="quick: without the systematic errors, for which odometry runs again without groups of directions.",
)
config = click.option("--config", "config_file", metavar="FILE", type=PATH, help="TOML file on top of the preset.")
relations = click.option(
    "--relations", metavar="FILE", type=PATH, help="Manually verified relative poses (Kümmerle et al. 2009)."
)
strict = click.option("--strict", is_flag=True, help="Exit with 1 unless the verdict is trustworthy.")
as_json = click.option("--json", "as_json", is_flag=True, help="Print as JSON.")


max_gap = click.option(
    "--max-gap",
    "max_gap_s",
    type=NumberRange(0.0, inf, max_open=True),
    metavar="SECONDS",
    help="Longest gap between true poses to interpolate. [default: 5 of their usual intervals, 0.1 to 0.6]",
)


def ground_truth(
    metavar: str = "FILE|TOPIC|none",
    help: str = "Ground truth: TUM, KITTI or a topic; none to ignore that of the log. [default: /ground_truth]",
) -> Callable[[Any], Any]:
    """``--gt``: a file is passed as ``ground_truth``, else None; a topic or "none" becomes an override."""

    def keep(ctx: click.Context, _: click.Parameter, text: str | None) -> Path | None:
        if text is None:
            return None
        path = Path(text)
        if text == NO_TOPIC or (text.startswith("/") and not path.exists() and not path.suffix):
            ctx.meta.setdefault(_ALIASES, []).append(Override("log.ground_truth_topic", text, "--gt"))
            return None
        return path

    return click.option("--gt", "ground_truth", metavar=metavar, callback=keep, help=help)


of_log = _together(config, part(), matcher, ground_truth(), max_gap, threads)


def force(replaced: str) -> Callable[[Any], Any]:
    """``--force``; ``replaced`` says in the help what it replaces."""
    return click.option("--force", is_flag=True, help=f"Replace {replaced}.")


def out(what: str = "Directory to create.", *, required: bool = True) -> Callable[[Any], Any]:
    """``--out``."""
    return click.option("--out", required=required, metavar="DIR", type=PATH, help=what)


def result(replaced: str, what: str = "Directory to create.", *, required: bool = True) -> Callable[[Any], Any]:
    """``--out``, ``--force`` and ``--json`` of a command that writes a directory with its metrics."""
    as_metrics = click.option("--json", "as_json", is_flag=True, help="Print metrics.json instead of the summary.")
    return _together(out(what, required=required), force(replaced), as_metrics)


def print_summary(out: Path, summary: str, *, as_json: bool) -> None:
    """Print the summary and the directory of a result, or its metrics.json unchanged."""
    from scanchain.runs.metrics import shortened

    click.echo((out / "metrics.json").read_text(encoding="utf-8") if as_json else shortened(summary), nl=False)
    if not as_json:
        click.echo(f"written        {out}")


def limits(what: str, *, time_default: str, memory_default: str) -> Callable[[Any], Any]:
    """``--time-limit`` as ``time_s``, ``--memory-limit`` as ``memory_mib``; None where not given.

    what : the thing limited, in words; time_default, memory_default : the defaults, in words
    """
    return _together(
        click.option(
            "--time-limit",
            "time_s",
            type=ABOVE_ZERO,
            metavar="SECONDS",
            help=f"Time limit of {what}. [default: {time_default}]",
        ),
        click.option(
            "--memory-limit",
            "memory_mib",
            type=ABOVE_ZERO,
            callback=lambda _, __, gib: None if gib is None else MIB_PER_GIB * gib,
            metavar="GIB",
            help=f"Memory limit of {what}. [default: {memory_default}]",
        ),
    )


def numbers(text: str, counts: Collection[int], wrong: str) -> list[float]:
    """Comma-separated finite numbers, as many as one of ``counts``. Raises InputError(wrong) otherwise."""
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        raise InputError(wrong) from None
    if len(values) not in counts or not all(map(isfinite, values)):
        raise InputError(wrong)
    return values


def check_output(path: Path, *, force: bool, endings: Sequence[str] = ()) -> None:
    """Refuse a path that cannot be written, that exists unless ``force``, or that has none of these suffixes."""
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; make it first")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file")
    if endings and path.suffix not in endings:
        raise InputError(f"{path}: name a file that ends in {' or '.join(endings)}")
    if path.exists() and not force:
        raise InputError(f"{path}: exists; choose another name, or --force to replace it")
