"""Ground truth from a TUM or KITTI file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Trajectory
from scanchain.errors import InputError, counted
from scanchain.evaluation.pairing import span
from scanchain.trajectory import read_kitti, read_tum, text_lines

_KITTI_FIELDS = 12
_SLACK_NS = 1_000_000_000  # largest error of the expected stamps of a log's scans


@dataclass(frozen=True, slots=True)
class TruthFile:
    """Poses of the lidar from a TUM file, or from a KITTI file, whose k-th row is the k-th scan's.

    ``has_stamps`` : whether the stamps of ``poses`` are times
    """

    path: Path
    poses: Trajectory
    has_stamps: bool

    def check(self, scans_ns: NDArray[np.int64], scans: int) -> None:
        """Refuse a file that cannot belong to so many scans between these stamps. Raises InputError."""
        if self.has_stamps:
            check_overlap(str(self.path), self.poses.stamps_ns, scans_ns)
        else:
            self._check_rows(scans)

    def at(self, stamps_ns: NDArray[np.int64]) -> Trajectory:
        """The poses with their stamps; those of a KITTI file, of which there must be N, with those of N scans."""
        if self.has_stamps:
            return self.poses
        self._check_rows(len(stamps_ns))
        return Trajectory(stamps_ns, self.poses.poses)

    def first(self, scans: int) -> TruthFile:
        """Of a KITTI file that of the first scans alone; a TUM file as it is."""
        if self.has_stamps:
            return self
        poses = Trajectory(self.poses.stamps_ns[:scans], self.poses.poses[:scans])
        return TruthFile(self.path, poses, has_stamps=False)

    def _check_rows(self, scans: int) -> None:
        if len(self.poses) != scans:
            raise InputError(
                f"{self.path}: has {counted(len(self.poses), 'line')} for {counted(scans, 'scan')}; "
                "a KITTI file has one line a scan that is read, or give a TUM file, which has stamps"
            )


def check_overlap(source: str, truth_ns: NDArray[np.int64], scans_ns: NDArray[np.int64]) -> None:
    """Refuse a truth whose stamps, given whole or by both ends, lie all before or all after those of the scans."""
    if truth_ns.min() > scans_ns.max() + _SLACK_NS or truth_ns.max() < scans_ns.min() - _SLACK_NS:
        raise InputError(
            f"{source}: its poses ({span(truth_ns)}) and the scans ({span(scans_ns)}) have no time in common; "
            "check that both keep the same clock and that it belongs to this log"
        )


def read_truth(path: Path) -> TruthFile:
    """Ground truth of a TUM or a KITTI file, by the number of words in its first line."""
    first = next(iter(text_lines(path)), None)
    is_kitti = first is not None and len(first[1]) == _KITTI_FIELDS
    return TruthFile(path, read_kitti(path) if is_kitti else read_tum(path), not is_kitti)
