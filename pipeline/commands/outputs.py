"""Files that a command is to write, checked before the work."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scanchain.errors import InputError


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
