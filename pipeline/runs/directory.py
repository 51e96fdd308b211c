"""The directory a run writes: complete under its own name, or absent, or marked partial."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import TracebackType
from typing import Self

from pipeline.errors import InputError

RUN_FILE = "run.json"


class RunDirectory:
    """A new run directory; a context manager.

    It is written beside its destination, as ``NAME.partial-PID``, and takes its name in ``complete``. Left before
    that, it stays where it is if ``worth_keeping`` was called, else nothing remains. A directory that is replaced
    stays untouched until the new one is complete.

    Attributes
    ----------
    destination : the name it will have; path : where its files are now
    """

    def __init__(self, destination: Path, *, force: bool) -> None:
        _check(destination, force)
        self.destination = destination.resolve()
        self.force = force
        self.path = self.destination.with_name(f"{self.destination.name}.partial-{os.getpid()}")
        self.is_worth_keeping = False

    def __enter__(self) -> Self:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.path.exists():  # a dead process had the same number
                shutil.rmtree(self.path)
            self.path.mkdir()
        except OSError as error:
            raise InputError(
                f"{self.destination}: cannot be made ({error.strerror}); choose another --out"
            ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.path != self.destination and not self.is_worth_keeping:
            shutil.rmtree(self.path, ignore_errors=True)

    def worth_keeping(self) -> None:
        """Let what there is stay, marked partial, even if the run fails."""
        self.is_worth_keeping = True

    def complete(self) -> None:
        """Give the directory its name; one that had it before is removed only now.

        Raises InputError where one that must not be replaced has come to be in the meantime.
        """
        _check(self.destination, self.force)
        old = self.destination.with_name(f"{self.destination.name}.replaced-{os.getpid()}")
        if self.destination.exists():
            self.destination.rename(old)
        self.path.rename(self.destination)
        self.path = self.destination
        shutil.rmtree(old, ignore_errors=True)


def _check(destination: Path, force: bool) -> None:
    """Refuse what must not be overwritten."""
    if not destination.exists():
        return
    if not destination.is_dir():
        raise InputError(f"{destination}: is a file; choose another --out")
    if not force:
        raise InputError(f"{destination}: exists; choose another --out or pass --force to replace it")
    if any(destination.iterdir()) and not (destination / RUN_FILE).is_file():
        raise InputError(
            f"{destination}: is not a run ({RUN_FILE} is missing), so --force does not replace it; "
            "choose another --out"
        )
