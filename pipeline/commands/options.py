"""Options that commands share: the LOG argument, configuration keys as flags, --gt, limits, output checks."""

from __future__ import annotations

import gc
from collections.abc import Callable, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

import click

from scanchain.config import NO_TRUTH
from scanchain.errors import InputError
from scanchain.settings import Override
from scanchain.source import Source, source_of
from scanchain.threads import use_threads

OWN_PROCESS = object()  # what a command of its own process finds in click.Context.obj
_GARBAGE_EVERY = 500_000  # new objects; most stay to the end, and to search them often costs a twentieth


def collect_garbage_seldom() -> None:
    """Search for garbage less often, for commands that process a log."""
    gc.set_threshold(_GARBAGE_EVERY)


class OverrideCommand(click.Command):
    """Command that takes any configuration key as ``--section.key value``.

    Options with a dot in their name are taken out of the arguments before click sees the rest.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Split the arguments into overrides, kept in the context, and ordinary ones."""
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
            if not equals:
                text = next(words, "")
                if not text:
                    raise click.UsageError(f"{flag} needs a value, as in {flag} VALUE", ctx)
            overrides.append(Override(flag[2:], text, flag))
        ctx.meta[_KEY] = tuple(overrides)
        return super().parse_args(ctx, rest)


def overrides(ctx: click.Context, aliases: Sequence[Override] = ()) -> tuple[Override, ...]:
    """The keys that a command's options set: ``aliases`` as --matcher, and the ``--section.key`` options.

    Raises click.UsageError where two of them set the same key.
    """
    chosen: dict[str, Override] = {}
    for override in (*aliases, *ctx.meta[_KEY]):
        other = chosen.setdefault(override.key, override)
        if other is override:
            continue
        if other.flag == override.flag:
            raise click.UsageError(
                f"{other.flag} is given twice ({other.text}, {override.text}); give it once", ctx
            )
        raise click.UsageError(f"{other.flag} and {override.flag} both set {override.key}; give one of them", ctx)
    return tuple(chosen.values())


def alias(key: str, value: Any, flag: str) -> tuple[Override, ...]:
    """Override of the key that an option sets; empty if the option was not given."""
    return () if value is None else (Override(key, str(value), flag),)


_KEY = "scanchain.commands.overrides"


class _LogType(click.ParamType):
    name = "log"

    def convert(self, value: str | Source, param: click.Parameter | None, ctx: click.Context | None) -> Source:
        """Path or address that a word stands for."""
        return source_of(value)


LOG = _LogType()


_PART = (
    ("topic", "TOPIC", "log.topic", "Lidar topic{of}. [default: {topic}]"),
    ("start", "SECONDS", "log.start_s", "Skip {log} up to this time, counted from its first message."),
    ("end", "SECONDS", "log.end_s", "Skip {log} after this time."),
    ("every", "N", "log.every", "Take every N-th scan."),
)


def part_options(log: str = "the log", *, topic: str = "the only one that fits") -> Callable[[Any], Any]:
    """``--topic``, ``--start``, ``--end`` and ``--every``, the part of a log; ``part_of`` reads them.

    log, topic : in words, what is cut and which lidar is taken without ``--topic``
    """

    def decorate(command: Any) -> Any:
        for name, metavar, _, text in reversed(_PART):
            of = "" if log == "the log" else f" of {log}"
            command = click.option(f"--{name}", metavar=metavar, help=text.format(log=log, of=of, topic=topic))(
                command
            )
        return command

    return decorate


def part_of(options: Mapping[str, str | bool | None]) -> tuple[Override, ...]:
    """The keys that ``part_options`` set."""
    return tuple(each for name, _, key, _ in _PART for each in alias(key, options[name], f"--{name}"))


def _use(context: click.Context, parameter: click.Parameter, count: int | None) -> None:
    if count is not None:
        use_threads(count)


threads_option = click.option(
    "--threads",
    type=click.IntRange(1),
    metavar="N",
    callback=_use,
    expose_value=False,
    help="Threads to compute with; the results are the same. [default: SCANCHAIN_THREADS, or one for each core]",
)


matcher_option = click.option(
    "--matcher",
    metavar="plicp|svd|MODULE:CLASS",
    help="LM-PLICP (the default), SVD-ICP, or your own class (scanchain.registration.Matcher).",
)
no_loops_option = click.option("--no-loops", is_flag=True, help="Odometry only, no loop closures.")


def method_of(options: Mapping[str, str | bool | None]) -> tuple[Override, ...]:
    """The keys that ``matcher_option`` and ``no_loops_option`` set."""
    no_loops = "false" if options.get("no_loops") else None
    return (
        *alias("matching.matcher", options["matcher"], "--matcher"),
        *alias("loops.enabled", no_loops, "--no-loops"),
    )


def max_gap_option(command: Callable[..., None]) -> Callable[..., None]:
    """The option ``--max-gap``."""
    return click.option(
        "--max-gap",
        "max_gap_s",
        type=float,
        callback=_checked_gap,
        metavar="SECONDS",
        help="Longest gap between true poses to interpolate. [default: 5 of their usual intervals, 0.1 to 0.6]",
    )(command)


def _checked_gap(_: click.Context, __: click.Parameter, value: float | None) -> float | None:
    if value is not None and not 0.0 <= value < inf:
        raise InputError(f"--max-gap is {value:g} s; choose a number from 0 up")
    return value


def ground_truth(text: str | None) -> tuple[Path | None, tuple[Override, ...]]:
    """A file, or a topic or "none" as an override; any other word is a file."""
    if text is None:
        return None, ()
    path = Path(text)
    if text == NO_TRUTH or (text.startswith("/") and not path.exists() and not path.suffix):
        return None, (Override("log.ground_truth_topic", text, "--gt"),)
    return path, ()


_MIB_PER_GIB = 1024.0
_ABOVE_ZERO = click.FloatRange(0.0, min_open=True)


def limit_options(what: str, *, time_default: str, memory_default: str) -> Callable[[Any], Any]:
    """``--time-limit`` as ``time_limit`` in seconds, ``--memory-limit`` as ``memory_mib``; None where not given.

    what : the thing limited, in words; time_default, memory_default : the defaults, in words
    """

    def decorate(command: Any) -> Any:
        for option in (
            click.option(
                "--memory-limit",
                "memory_mib",
                type=_ABOVE_ZERO,
                callback=lambda _, __, gib: None if gib is None else _MIB_PER_GIB * gib,
                metavar="GIB",
                help=f"Memory limit of {what}. [default: {memory_default}]",
            ),
            click.option(
                "--time-limit",
                type=_ABOVE_ZERO,
                metavar="SECONDS",
                help=f"Time limit of {what}. [default: {time_default}]",
            ),
        ):
            command = option(command)
        return command

    return decorate


def check_output(path: Path, *, force: bool, endings: Sequence[str] = ()) -> None:
    """Refuse what could not be written after the work, would replace something, or has none of these suffixes."""
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; make it first")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file")
    if endings and path.suffix not in endings:
        raise InputError(f"{path}: name a file that ends in {' or '.join(endings)}")
    if path.exists() and not force:
        raise InputError(f"{path}: exists; choose another name, or --force to replace it")
