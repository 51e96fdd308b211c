"""Numbers in sentences."""

from __future__ import annotations

FREEDOM = ("degree of freedom", "degrees of freedom")


def counted(number: int, noun: str, plural: str = "") -> str:
    """A number and what it counts: "1 scan", "2,000 scans"; ``plural`` where that is not the noun and s."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def duration(time_s: float) -> str:
    """A time in the largest unit of which it is more than one."""
    for unit, seconds in (("days", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if time_s > seconds:
            return f"{time_s / seconds:.1f} {unit}"
    return f"{time_s:.1f} s"
