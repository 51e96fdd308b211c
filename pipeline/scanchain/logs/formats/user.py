"""Logs in a user-defined format: a class iterates over scans, which are converted to a temporary MCAP file."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from scanchain import plugins
from scanchain.data import Scan
from scanchain.errors import InputError, counted, shown
from scanchain.logs.formats.mcap import temporary_index
from scanchain.logs.index import FileIndex
from scanchain.logs.writer import LATEST_NS, LogWriter


class ScanFormat(Protocol):
    """Protocol of the class named by ``log.format``: constructed from a log's path, it iterates over its scans."""

    def __init__(self, path: Path) -> None: ...

    def scans(self) -> Iterator[tuple[float, ArrayLike, ArrayLike | None]]:
        """Scans in order of time: stamp in seconds, points, times of the points or None.

        points : (N, 3) meters in the lidar's frame, or (N, 2) of a planar scanner; NaN for beams without return
        times : (N,) seconds after the stamp
        """
        ...


def index_scans(path: Path, number: int, name: str) -> FileIndex:
    """Index of the scans that the class ``name`` reads from a path, as the ``number``-th file of a log.

    Raises InputError if the class fails or yields anything other than scans.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    index = temporary_index(path, number, lambda log: _write(log, path, name))
    scans = sum(index.counts.values())
    if not scans:
        raise InputError(f"{path}: {name} yields no scan; check the path and the format")
    index.notes.append(f"{path}: {counted(scans, 'scan')} read by {name} (log.format)")
    return index


def _write(log: LogWriter, path: Path, name: str) -> None:
    """Write the scans that the class reads from a path."""
    make: type[ScanFormat] = plugins.load(name, "scans")
    dimension, end = 0, object()
    with plugins.own_code(f"{path}: {name}"):
        scans: Iterator[Any] = iter(make(path).scans())
    for number in count():
        with plugins.own_code(f"{path}: scan {number} of {name}"):
            yielded = next(scans, end)
            if yielded is end:
                break
            if not isinstance(yielded, tuple) or len(yielded) != 3:
                raise InputError(f"is {shown(yielded)}; wanted a tuple (stamp_s, points, times_s or None)")
            stamp_s, points, times_s = yielded
            scan = Scan.of(points, stamp_s, times_s)
            if not 0 <= scan.stamp_ns < LATEST_NS:
                raise InputError(f"stamp_s is {stamp_s}; wanted 0 to {LATEST_NS * 1e-9:.0f} s")
            dimension = dimension or scan.points.shape[1]
            if scan.points.shape[1] != dimension:
                raise InputError(f"points are not (N, {dimension}) as before; yield one dimension only")
        rows = np.asarray(points, np.float32)
        rows = np.pad(rows, ((0, 0), (0, 3 - dimension)))  # z = 0, from which the log is recognized as 2D
        fields = {"time": np.asarray(times_s, np.float32)} if len(scan.times_s) else {}
        log.point_cloud("/points", scan.stamp_ns, "lidar", rows, fields)
