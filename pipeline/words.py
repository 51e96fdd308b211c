"""Numbers in sentences."""

from __future__ import annotations

FREEDOM = ("degree of freedom", "degrees of freedom")


def counted(number: int, noun: str, plural: str = "") -> str:
    """A number and what it counts: "1 scan", "2,000 scans"; ``plural`` where that is not the noun and s."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"
