"""``--gt``: a file or a topic, and ``--max-gap``."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from pathlib import Path

import click

from scanchain.errors import InputError
from scanchain.settings import Override


def max_gap_option(command: Callable[..., None]) -> Callable[..., None]:
    """The option ``--max-gap``."""
    return click.option(
        "--max-gap",
        type=float,
        callback=_checked_gap,
        metavar="SECONDS",
        help="Between true poses to interpolate. [default: five times their usual interval, at most 0.6]",
    )(command)


def _checked_gap(_: click.Context, __: click.Parameter, value: float | None) -> float | None:
    if value is not None and not 0.0 <= value < inf:
        raise InputError(f"--max-gap is {value:g} s; choose a number from 0 up")
    return value


def ground_truth(text: str | None) -> tuple[Path | None, tuple[Override, ...]]:
    """A file, or a topic as an override; what is neither a file nor looks like a topic is taken for a file."""
    if text is None:
        return None, ()
    path = Path(text)
    if text.startswith("/") and not path.exists() and not path.suffix:
        return None, (Override("log.ground_truth_topic", text, "--gt"),)
    return path, ()
