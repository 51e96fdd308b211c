"""A remote file as a whole, copied to this machine, where it stays as long as the program runs."""

from __future__ import annotations

import atexit
import shutil
from pathlib import Path
from tempfile import mkdtemp

from scanchain.download import fetch
from scanchain.errors import InputError
from scanchain.logs.remote.files import RemoteFile

_PIECE_BYTES = 8_000_000


def fetch_whole(file: RemoteFile) -> Path:
    """The path of the copy. Raises InputError where it does not come or finds no room."""
    folder = Path(mkdtemp(prefix="scanchain-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    copy = folder / (file.address.name or "log")
    try:
        if file.has_ranges:
            _copy(file, copy)
        else:
            fetch(file.address.url, copy)
    except OSError as error:
        raise InputError(f"{copy}: {file.address} cannot be kept there ({error.strerror}); set TMPDIR") from error
    return copy


def _copy(file: RemoteFile, destination: Path) -> None:
    """Piece by piece, so that a broken line costs one piece only."""
    with destination.open("wb") as copy:
        for offset in range(0, file.size, _PIECE_BYTES):
            copy.write(file.read(offset, min(_PIECE_BYTES, file.size - offset)))
