"""The files that a path stands for, and how large they are."""

from __future__ import annotations

from pathlib import Path

from pipeline.logs.remote import RemoteFile
from pipeline.source import Source


def files_of(path: Path) -> list[Path]:
    """The file itself, or every file in a folder and below, in the order of their names."""
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]


def size_of(source: Source) -> int:
    """Bytes of all of them, or of what lies at an address."""
    if not isinstance(source, Path):
        return RemoteFile(source).size
    return sum(file.stat().st_size for file in files_of(source))
