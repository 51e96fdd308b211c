"""Scans of a log in the order of the path, and the keyframes among them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Keyframe, KeyframeErrors, State, Trajectory
from scanchain.graph.growing_array import GrowingArray
from scanchain.odometry import Located
from scanchain.point_store import PointStore


class Trail:
    """Odometry pose of every scan; keyframes, those of a prior map first, with their points.

    ``first`` is the first keyframe of the log, ``lost_before`` the number of scans lost before the newest one.
    """

    def __init__(self, dimension: int, points_file: Path | None, *, keeps_scans: bool) -> None:
        """keeps_scans : whether points of all scans are kept, not only of keyframes."""
        self.keeps_scans = keeps_scans
        self.points = PointStore(dimension, points_file)
        self.spans = GrowingArray((2,), np.int64)
        self.stamps_ns = GrowingArray((), np.int64)
        self.odometry_poses = GrowingArray((dimension + 1,) * 2, np.float64)
        self.keyframes: list[Keyframe] = []
        self.map_errors: list[KeyframeErrors] = []
        self.first = self.lost_before = self._lost = 0
        self.traveled_m = 0.0

    def begin_in(self, keyframes: Sequence[Keyframe], traveled_m: float) -> None:
        """Put the keyframes of a map first, without errors; the path length continues from ``traveled_m``."""
        k = lie.twist_size(keyframes[0].T_odom_lidar)
        self.keyframes += keyframes
        self.map_errors += [KeyframeErrors(1.0, np.zeros((k, k)), 1.0) for _ in keyframes]
        self.first, self.traveled_m = len(keyframes), traveled_m

    def add(self, located: Located) -> bool:
        """Add a scan; True if it moved far enough to be a keyframe, which is then the newest."""
        tracked = located.tracked
        if len(self.odometry_poses):
            self.traveled_m += lie.apart(self.odometry_poses.rows[-1], tracked.T_odom_lidar)[0]
        self.stamps_ns.append(tracked.scan.stamp_ns)
        scan = self.odometry_poses.append(tracked.T_odom_lidar)
        if scan == 1:  # only now is the motion known that distorted the first scan
            stored = self.points.add(located.first_points)
            self.keyframes[self.first] = replace(self.keyframes[self.first], stored=stored)
            self.spans.replace(np.array([(stored.first, stored.count)]))
        self._lost += tracked.state is State.LOST
        if not located.is_keyframe and not self.keeps_scans:
            return False
        stored = self.points.add(tracked.points)
        self.spans.append((stored.first, stored.count))
        if located.is_keyframe:
            self.keyframes.append(
                Keyframe(
                    index=len(self.keyframes),
                    scan_index=scan,
                    stamp_ns=tracked.scan.stamp_ns,
                    stored=stored,
                    T_odom_lidar=tracked.T_odom_lidar,
                    traveled_m=self.traveled_m,
                    scale=located.scale,
                    noise_m=located.noise_m,
                )
            )
            self.map_errors.append(located.errors)
            self.lost_before, self._lost = self._lost, 0
        return located.is_keyframe

    @property
    def odometry(self) -> Trajectory:
        """Odometry poses of all scans."""
        return Trajectory(self.stamps_ns.rows.copy(), self.odometry_poses.rows.copy())

    @property
    def scan_of(self) -> NDArray[np.int64]:
        """Number of the scan of each keyframe of the log itself."""
        return np.array([keyframe.scan_index for keyframe in self.keyframes[self.first :]])
