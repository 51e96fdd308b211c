"""Logs of a user's own format: a class that iterates over scans, which are converted to a temporary MCAP file."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanchain import plugins
from scanchain.checks import point_times
from scanchain.errors import InputError, counted, one_line, shown
from scanchain.files import Source
from scanchain.logs.mcap.index import index_file
from scanchain.logs.mcap.records import FileIndex
from scanchain.logs.writer import LATEST_NS, LogWriter

_TOPIC, _FRAME = "/points", "lidar"


class ScanFormat(Protocol):
    """Protocol of a class named by ``log.format``: it is made of the path of a log and iterates over its scans."""

    def __init__(self, path: Path) -> None: ...

    def scans(self) -> Iterator[tuple[float, ArrayLike, ArrayLike | None]]:
        """The scans in the order of time: stamp in seconds, points, times of the points or None.

        points : (N, 3) meters in the lidar's frame, or (N, 2) of a planar scanner; NaN where nothing came back
        times : (N,) seconds after the stamp
        """
        ...


def load_format(name: str) -> type[ScanFormat]:
    """The class that ``module:Class`` names. Raises InputError where there is none, or it is no log format."""
    return plugins.load(name, "scans")


def index_scans(path: Path, number: int, name: str, source: Source | None = None) -> FileIndex:
    """The scans of a path as the class ``name`` reads them, as the ``number``-th file of a log.

    source : what ``path`` is a copy of, None for itself
    Raises InputError where the class fails, or yields something else than scans.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    with TemporaryDirectory(prefix="scanchain-", ignore_cleanup_errors=True) as folder:
        copy = Path(folder) / "log.mcap"
        try:
            scans = _write(copy, path, name)
        except OSError as error:
            raise InputError(f"{copy}: {path} cannot be converted there ({error.strerror}); set TMPDIR") from error
        index = index_file(copy, number, source or path)  # which maps the file: it may be deleted
    index.notes.append(f"{source or path}: {counted(scans, 'scan')} read by {name} (log.format)")
    return index


def _write(destination: Path, path: Path, name: str) -> int:
    """Write the scans that the class reads of a path; returns their number."""
    make = load_format(name)
    written, dimension, end = 0, 0, object()
    with LogWriter(destination) as log:
        with _blaming(f"{path}: {name}"):
            scans = iter(make(path).scans())
        for written in count():
            where = f"{path}: scan {written} of {name}"
            with _blaming(where):
                scan = next(scans, end)
            if scan is end:
                break
            stamp_ns, points, times_s = _checked(scan, where)
            d = points.shape[1]
            dimension = dimension or d
            if d != dimension:
                raise InputError(
                    f"{where} has points (N, {d}), the scans before it (N, {dimension}); yield one kind"
                )
            points = np.pad(points, ((0, 0), (0, 3 - d)))  # in the plane z = 0, by which it is known as 2D
            log.point_cloud(_TOPIC, stamp_ns, _FRAME, points, times_s=times_s, time_field="time")
    if not written:
        raise InputError(f"{path}: {name} yields no scan of it; check the path and the format")
    return written


@contextmanager
def _blaming(where: str) -> Iterator[None]:
    """Make an InputError that says where of whatever goes wrong in the user's own code."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        line = f"{Path(last.filename).name}, line {last.lineno}"
        raise InputError(f"{where} failed with {type(error).__name__}: {one_line(error)} ({line})") from error


def _checked(scan: object, where: str) -> tuple[int, NDArray[np.float32], NDArray[np.float32] | None]:
    """Stamp in nanoseconds, points (N, d) and their times of what the class yielded. Raises InputError."""
    if not isinstance(scan, tuple) or len(scan) != 3:
        raise InputError(f"{where} is {shown(scan)}; wanted a tuple (stamp_s, points, times_s or None)")
    stamp_s, points, times_s = scan
    try:
        stamp_ns = round(float(stamp_s) * 1e9)
    except (TypeError, ValueError, OverflowError):
        stamp_ns = -1
    if not 0 <= stamp_ns < LATEST_NS:
        raise InputError(
            f"{where} has the stamp {shown(stamp_s)}; wanted seconds, from 0 to {LATEST_NS * 1e-9:.0f}"
        )
    try:
        array = np.asarray(points, np.float32)
    except (TypeError, ValueError):
        array = np.empty(0, np.float32)
    if array.shape[1:] not in ((2,), (3,)):
        raise InputError(f"{where} has the points {shown(points)}; wanted (N, 2) or (N, 3) numbers in meters")
    times = point_times(times_s, f"{where}: times_s", len(array))
    return stamp_ns, array, times if len(times) else None
