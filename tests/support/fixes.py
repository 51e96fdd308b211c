"""Fixes of simulated receivers along drives that are not scanned, and trajectories that drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scanchain import lie
from scanchain.data import Fixes, Trajectory
from scanchain.geodesy import Geodesy
from scanchain.graph.pose_graph import PoseGraph
from scanchain.simulation import plan
from scanchain.simulation.drive import fixes_of
from scanchain.simulation.gnss import ORIGIN, T_ENU_WORLD

EVERY = 5  # scans per keyframe
SIGMAS = np.array([0.02] * 3 + [0.002] * 3)  # of an odometry edge


def drive_of(world, gnss, seed=0, seconds=None, **changed):
    """A drive with a receiver of the seed, whose model is changed, as planned."""
    drive = plan(world, sensor="vlp-16", gnss=gnss, duration_s=seconds)
    return replace(drive, seed=seed, gnss=replace(drive.gnss, **changed))


def fixes_along(drive, *, is_antenna_known=True):
    """Fixes of a drive, and which are wrong by multipath (M,)."""
    stamps_ns, samples = fixes_of(drive, drive.gnss, int(drive.truth().stamps_ns[-1]))
    kept = ~samples.is_out
    antenna_m = lie.transform(lie.inverse(drive.T_base_lidar), drive.gnss.antenna_m[None])[0]
    covariances = np.tile(np.diag(np.square(drive.gnss.sigma_m)), (int(kept.sum()), 1, 1))
    positions = Geodesy(*ORIGIN).geodetic(samples.enu_m[kept])
    known = antenna_m if is_antenna_known else None
    return Fixes(stamps_ns[kept], positions, covariances, known), samples.is_multipath[kept]


def driven(truth, yaw_rad_m=0.0, pitch_rad_m=0.0):
    """Trajectory of a lidar whose odometry turns too far by so much per meter, its graph, scans of keyframes."""
    steps = lie.between(truth.poses[:-1], truth.poses[1:])
    twists = np.zeros((len(steps), 6))
    twists[:, 4:] = np.linalg.norm(steps[:, :3, 3], axis=1)[:, None] * [pitch_rad_m, yaw_rad_m]
    poses = [np.eye(4)]
    for step in steps @ lie.exp(twists):
        poses.append(lie.normalize(poses[-1] @ step))
    trajectory = Trajectory(truth.stamps_ns, np.array(poses))
    chosen, graph = np.arange(0, len(poses), EVERY), PoseGraph(3)
    for scan in chosen.tolist():
        graph.add_pose(poses[scan], int(truth.stamps_ns[scan]))
    for a, b in zip(chosen[:-1].tolist(), chosen[1:].tolist(), strict=True):
        graph.add_edge(a // EVERY, b // EVERY, lie.between(poses[a], poses[b]), np.diag(SIGMAS**-2.0))
    return trajectory, graph, chosen


def true_positions(truth):
    """(N, 3) east, north and up of the origin of the simulator."""
    return (T_ENU_WORLD @ truth.poses)[:, :3, 3]


def positions_by(georeference, trajectory):
    """(N, 3) east, north and up of the origin of the simulator, of a trajectory and its place on Earth."""
    at = georeference.geodesy.geodetic(georeference.enu(trajectory).positions)
    return Geodesy(*ORIGIN).enu(at)
