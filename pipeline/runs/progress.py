"""What a long job asks of whoever watches it; the command line brings a progress bar."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from scanchain.data import Scan


class Progress(Protocol):
    """Whoever watches a run and may end it early."""

    @property
    def stopped(self) -> bool:
        """Whether the user ended the run early."""
        ...

    def say(self, line: str) -> None:
        """Tell something that happens, to a person who looks on."""
        ...

    def tell(self, line: str) -> None:
        """Tell something that must be known, to anyone."""
        ...

    def track(self, scans: Iterator[Scan], count: int) -> Iterator[Scan]:
        """Pass the scans on, of which there should be ``count``, until they end or the user wants no more."""
        ...


class Unwatched:
    """Nobody watches: for scripts."""

    stopped = False

    def say(self, line: str) -> None:
        """Nothing is told."""

    def tell(self, line: str) -> None:
        """Nothing is told."""

    def track(self, scans: Iterator[Scan], count: int) -> Iterator[Scan]:
        """The scans as they come."""
        return scans
