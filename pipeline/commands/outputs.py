"""Files that a command is to write, checked before the work."""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import InputError


def check_output(path: Path, *, force: bool, ending: str = "") -> None:
    """Refuse what could not be written after the work, or would replace something; ``ending`` is the suffix."""
    if ending and path.suffix != ending:
        raise InputError(f"{path}: name a file that ends in {ending}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; make it first")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file")
    if path.exists() and not force:
        raise InputError(f"{path}: exists; choose another name, or --force to replace it")
