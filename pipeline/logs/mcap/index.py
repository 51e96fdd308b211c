"""What lies where in an MCAP file: its blocks of messages, channels and damage, found by walking the records.

A walk reads nine bytes a record and a chunk's header, never its contents, and needs no summary: files that were
cut off or never finished are indexed like any other. Behind damage it goes on at the next record that is one.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import mmap
from pathlib import Path

from scanchain.errors import InputError
from scanchain.logs.mcap.records import MAGIC, FileIndex
from scanchain.logs.mcap.resync import Resync, is_end, record_end, vouches_for_itself
from scanchain.logs.mcap.walk import Walk
from scanchain.source import Source


def index_file(path: Path, number: int, source: Source | None = None) -> FileIndex:
    """Walk one file, the ``number``-th of a log. Raises InputError for what is no MCAP file at all.

    source : what it is a copy of, and is called in what is said of it; None for itself
    """
    index = FileIndex(source or path, number, _map(path))
    data, walk, resync = index.data, Walk(index), Resync(index.data)
    offset, end = len(MAGIC), record_end(index.data, len(MAGIC))
    while not is_end(data, offset):
        following = record_end(data, end) if end else 0
        if end and (following or is_end(data, end)):
            walk.take(offset)
            offset, end = end, following
            continue
        resumed = resync.behind(offset)
        if end and (vouches_for_itself(data, offset) or not 0 < resumed < end):
            walk.take(offset)
            offset = resumed if 0 < resumed < end else end
        if not resumed:
            break
        index.damage.append(
            f"{index.path}: the record at byte {offset} is damaged; reading went on at byte {resumed}"
        )
        walk.close(offset, complete=False)
        offset, end = resumed, record_end(data, resumed)
    walk.finish(offset)
    return index


def _map(path: Path) -> mmap.mmap:
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:
                raise InputError(f"{path}: is empty (0 bytes); record or copy it again")
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot be read ({reason}); check its permissions") from error
    if data[: len(MAGIC)] != MAGIC:
        raise InputError(f"{path}: is not an MCAP file (starts with {data[:8]!r}); see scanchain convert --help")
    return data
