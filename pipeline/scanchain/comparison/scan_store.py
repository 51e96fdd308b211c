"""Decoded scans in a folder, so that every method's process reads the very same arrays.

Scan by scan they are read into memory of their own rather than mapped: what is mapped counts as resident, and the
memory of a method would grow with the log. Straight after decoding the files lie in the system's page cache.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Pose, Scan

_POINTS, _TIMES, _TABLE = "points.f32", "times.f32", "scans.npz"


@dataclass(frozen=True, slots=True)
class StoredScans:
    """The scans of a folder, row by row.

    Attributes
    ----------
    folder : where their points and times lie
    points, times : (N,) numbers of points and of times of each scan, which lie one after the other
    stamps_ns, log_times_ns, dropped : (N,) as in ``Scan``
    wheels : (N, d+1, d+1) T_odom_base, NaN where the log has none
    T_base_lidar : (d+1, d+1)
    """

    folder: Path
    points: NDArray[np.int64]
    times: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    log_times_ns: NDArray[np.int64]
    dropped: NDArray[np.int64]
    wheels: NDArray[np.float64]
    T_base_lidar: Pose

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.T_base_lidar) - 1

    def scans(self) -> Iterator[Scan]:
        """The scans as they were decoded."""
        with (self.folder / _POINTS).open("rb") as points, (self.folder / _TIMES).open("rb") as times:
            for index in range(len(self)):
                wheels = self.wheels[index]
                yield Scan(
                    index=index,
                    stamp_ns=int(self.stamps_ns[index]),
                    log_time_ns=int(self.log_times_ns[index]),
                    points=_read(points, self.points[index] * self.dimension).reshape(-1, self.dimension),
                    times_s=_read(times, self.times[index]),
                    dropped=int(self.dropped[index]),
                    T_odom_base=wheels if np.isfinite(wheels).all() else None,
                )


def store(scans: Iterable[Scan], T_base_lidar: Pose, folder: Path) -> StoredScans:
    """Write scans into an empty folder."""
    rows: list[tuple[int, ...]] = []
    wheels: list[Pose] = []
    unknown = np.full(T_base_lidar.shape, np.nan)
    with (folder / _POINTS).open("wb") as points, (folder / _TIMES).open("wb") as times:
        for scan in scans:
            rows.append((len(scan.points), len(scan.times_s), scan.stamp_ns, scan.log_time_ns, scan.dropped))
            wheels.append(unknown if scan.T_odom_base is None else scan.T_odom_base)
            points.write(np.ascontiguousarray(scan.points, np.float32).data)
            times.write(np.ascontiguousarray(scan.times_s, np.float32).data)
    np.savez(folder / _TABLE, rows=np.array(rows, np.int64), wheels=np.array(wheels), T_base_lidar=T_base_lidar)
    return open_store(folder)


def open_store(folder: Path) -> StoredScans:
    """The scans that ``store`` wrote."""
    with np.load(folder / _TABLE) as table:
        points, times, stamps_ns, log_times_ns, dropped = table["rows"].T.copy()
        wheels, T_base_lidar = table["wheels"], table["T_base_lidar"]
    return StoredScans(folder, points, times, stamps_ns, log_times_ns, dropped, wheels, T_base_lidar)


def _read(file: BinaryIO, count: int) -> NDArray[np.float32]:
    """The next floats (count,)."""
    return np.fromfile(file, np.float32, int(count))
