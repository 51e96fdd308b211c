"""Numbers in sentences, and sentences that differ in numbers alone."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

_SHOWN = 3  # of lines that are alike
FREEDOM = ("degree of freedom", "degrees of freedom")


def counted(number: int, noun: str, plural: str = "") -> str:
    """A number and what it counts: "1 scan", "2,000 scans"; ``plural`` where that is not the noun and s."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def below(value: float) -> str:
    """A value that is below a limit, two digits rounded down: it never reads like the limit."""
    return f"{math.floor(100.0 * value) / 100.0:.2f}"


def duration(time_s: float) -> str:
    """A time in the largest unit of which it is more than one."""
    for unit, seconds in (("years", 31_557_600.0), ("days", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if time_s > seconds:
            return f"{time_s / seconds:.1f} {unit}"
    return f"{time_s:.1f} s"


def grouped(lines: Iterable[str]) -> list[str]:
    """The lines in order; of many that differ in numbers alone the first ones, and how many more there are."""
    kinds: dict[str, list[str]] = {}
    for line in lines:
        kinds.setdefault(re.sub(r"\d+", "#", line), []).append(line)
    result: list[str] = []
    for alike in kinds.values():
        result += alike[:_SHOWN]
        if len(alike) > _SHOWN:
            result[-1] += f" (and {len(alike) - _SHOWN:,} more like this)"
    return result
