"""The files that a path stands for, and how large they are."""

from __future__ import annotations

import os
from pathlib import Path

from scanchain.logs.remote.files import RemoteFile
from scanchain.source import Source


def files_of(path: Path) -> list[Path]:
    """The file itself, or every file in a folder and below, in the order of their names."""
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]


def misspelled(source: Source) -> str:
    """What is wrong with a name that is no text, which nothing could be written about; empty where it is text."""
    name = os.path.realpath(source) if isinstance(source, Path) else str(source)
    return "" if spelled(name) == name else f"{spelled(name)}: the name is not UTF-8; rename it"


def spelled(name: str) -> str:
    """A name as text; bytes in it that are not UTF-8 are written as numbers (x and two digits)."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def size_of(source: Source) -> int:
    """Bytes of all of them, or of what lies at an address."""
    if not isinstance(source, Path):
        return RemoteFile(source).size
    return sum(file.stat().st_size for file in files_of(source))
