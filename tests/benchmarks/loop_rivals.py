"""Loop closures of ours, MapClosures, KISS-SLAM and Retro-SLAM with their defaults, on simulated logs with truth.

    pip install '.[slam]' retro-slam        in an environment of its own: map-closures wants numpy < 2.3
    python -m tests.benchmarks.loop_rivals

A loop is what a method puts into its pose graph, or would: the relative pose of two keyframes (ours), of two local
maps of 100 m after verification by ICP (KISS-SLAM), of two local maps by their density maps alone, with more than
5 inliers (MapClosures, on KISS-ICP, as in its own pipeline), of two scans that begin submaps of 25 m (Retro-SLAM:
the edges of its graph that do not join neighbors). --local-map changes the 100 m.

  true      the relative pose is less than 3 m and 5° from the truth, at the instants at which the poses hold
  false     the rest; "worst" is the largest error of all
  revisits  share of the scans within 5 m of one that lies 100 m or more of the way back, for which a true loop is
            of a keyframe within 10 m of the way (ours), or of the local map or submap that they are in
  ATE       before and after loop closure, at the stamps of the scans
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.baselines import BASELINES, KISS, KISS_SLAM, AtStamp, finite
from scanchain.data import ClosureVerdict, Matrix, Trajectory
from scanchain.evaluation import path_length
from scanchain.logs import open_log
from scanchain.logs.log import Log
from scanchain.runs.closures import final_verdicts
from scanchain.settings import Override, load_settings
from scanchain.slam import Slam
from tests.benchmarks.harness import ate_m, drive_of, in_fresh_process, options_of, table
from tests.benchmarks.loops import ALONG_M, revisits

LOGS = ("rounds:vlp-16", "rounds:os1-32", "town:os1-32", "garage:vlp-16", "highway:os1-32")
TRUE_M, TRUE_RAD = 3.0, np.radians(5.0)
EVERY = 5  # scans of which revisits are counted
HEAD = "log,method,loops,true,false,median error of true ones,worst,revisits found,ATE,s"


class Loop(NamedTuple):
    """An accepted loop closure: T_old_new of two scans, and the scans of the new keyframe or local map."""

    old: int
    new: int
    T_old_new: Matrix
    scans: tuple[int, int]


class Found(NamedTuple):
    """Loops and trajectories at the stamps; ``held_s`` (N,) after these the scans' poses in loops hold."""

    loops: list[Loop]
    odometry: Trajectory | None
    final: Trajectory | None
    held_s: NDArray[np.float64]


def ours(log: Log, local_map_m: float) -> Found:
    """As ``plicp+loops`` of a comparison: without wheels."""
    wheels = Override("odometry.prior", "constant-velocity", "")
    slam = Slam(load_settings(3, overrides=(wheels,)).config, log.T_base_lidar)
    for scan in log.scans():
        slam.process(scan)
    result = slam.finish()
    scans = [keyframe.scan_index for keyframe in result.keyframes]
    path_m = path_length(result.odometry.poses)

    def near(k: int) -> tuple[int, int]:
        first, last = np.searchsorted(path_m, path_m[scans[k]] + np.array([-ALONG_M, ALONG_M]))
        return int(first), int(last)

    accepted = [
        each for each in final_verdicts(result.closures, result.state) if each.verdict is ClosureVerdict.ACCEPTED
    ]
    loops = [
        Loop(scans[each.target], scans[each.source], each.match.T_target_source, near(each.source))
        for each in accepted
    ]
    return Found(loops, result.odometry, result.trajectory, np.zeros(len(path_m)))


def kiss_slam(log: Log, local_map_m: float) -> Found:
    """The adapter of a comparison, whose verified closures are recorded."""
    baseline = BASELINES["kiss-slam"].make(msgspec.structs.replace(KISS_SLAM, local_map_m=local_map_m))
    verify, edges = baseline.slam.closer.compute, []

    def recorded(*arguments):
        is_good, old, new, T_new_old = answer = verify(*arguments)
        if is_good:
            edges.append((old, new, lie.inverse(np.array(T_new_old, np.float64))))
        return answer

    baseline.slam.closer.compute = recorded
    odometry = tracked(log, baseline)
    final = Trajectory(odometry.stamps_ns, baseline.final_poses())
    counts = [len(each.local_trajectory) for each in baseline.slam.local_map_graph.local_maps()]
    bounds = np.cumsum([0, counts[0] - 1, *(count - 1 for count in counts[1:])])
    loops = [Loop(int(bounds[old]), int(bounds[new]), T, tuple(bounds[new : new + 2])) for old, new, T in edges]
    return Found(loops, odometry, final, np.array([held_s for _, held_s in baseline.held]))


def map_closures(log: Log, local_map_m: float) -> Found:
    """MapClosures on local maps of KISS-ICP, as its own pipeline builds them."""
    from map_closures.config import MapClosuresConfig
    from map_closures.map_closures import MapClosures
    from map_closures.voxel_map import VoxelMap

    config, baseline = MapClosuresConfig(), BASELINES["kiss-icp"].make(KISS)
    register, deskewed = baseline.odometry.register_frame, []
    baseline.odometry.register_frame = lambda *frame: deskewed.append(register(*frame)[0])
    detector, voxels = MapClosures(config), VoxelMap(config.density_map_resolution, KISS.max_range_m)
    T_map, starts, loops, poses, held = np.eye(4), [0], [], [], []
    scans = list(range(len(log)))
    for index, scan in zip(scans, log.scans(), strict=True):
        poses.append(baseline.track(scan.points, scan.times_s, scan.stamp_ns))
        held.append(baseline.at_stamp.last_held_s)
        T_odom_lidar = np.array(baseline.odometry.last_pose)
        T_map_lidar = lie.between(T_map, T_odom_lidar)
        voxels.integrate_frame(deskewed.pop(), T_map_lidar)
        if np.linalg.norm(T_map_lidar[:3, 3]) <= local_map_m and index < scans[-1]:
            continue
        number = len(starts) - 1
        for each in detector.get_closures(number, voxels.point_cloud()):
            if each.number_of_inliers > config.inliers_threshold:
                loop = starts[each.source_id], starts[number], lie.inverse(np.array(each.pose))
                loops.append(Loop(*loop, (starts[number], index)))
        voxels.remove_far_away_points(T_map_lidar[:3, 3])
        kept = voxels.point_cloud()
        voxels.clear()
        voxels.integrate_frame(kept, lie.inverse(T_map_lidar))
        T_map = T_odom_lidar
        starts.append(index)
    stamps_ns = np.array([scan.stamp_ns for scan in log.scans()])
    return Found(loops, Trajectory(stamps_ns, np.array(poses)), None, np.array(held))


def retro_slam(log: Log, local_map_m: float) -> Found:
    """Retro-SLAM, whose loops are the edges of its graph that are not between neighbors."""
    from retro_slam.config import load_config
    from retro_slam.slam import RetroSLAM

    config = load_config(None)
    config.local_mapper.localmap_splitting_distance = local_map_m
    slam, stamps_ns, held = RetroSLAM(config), [], []
    for scan in log.scans():
        frame, times = finite(scan.points, scan.times_s)
        slam.process_scan(frame, times)
        stamps_ns.append(scan.stamp_ns)
        held.append(times.max(initial=0.0))
    slam.exit()  # waits for the last closures
    with tempfile.NamedTemporaryFile(suffix=".g2o") as file:
        slam.write_pose_graph(file.name)
        lines = [line.split() for line in Path(file.name).read_text().splitlines() if line.startswith("EDGE")]
    starts = np.linalg.norm(slam.poses[:, None, :3, 3] - slam.keyposes[:, :3, 3], axis=2).argmin(axis=0)
    loops = []
    for _, a, b, *numbers in lines:
        if abs(int(a) - int(b)) > 1:
            T, quat_xyzw = np.eye(4), [float(word) for word in numbers[3:7]]
            T[:3, :3], T[:3, 3] = Rotation.from_quat(quat_xyzw).as_matrix(), [float(word) for word in numbers[:3]]
            old, new, T = (int(a), int(b), T) if int(a) < int(b) else (int(b), int(a), lie.inverse(T))
            later = starts[starts > new]
            loops.append(Loop(old, new, T, (new, int(later[0]) if len(later) else len(held) - 1)))
    optimized = at_stamps(slam.poses, stamps_ns, held)
    return Found(loops, None, optimized, np.array(held))


def at_stamps(poses: Matrix, stamps_ns: list[int], held: list[float]) -> Trajectory:
    """Poses that hold some time after the stamps, moved there."""
    at_stamp = AtStamp()
    moved = [at_stamp.move(*each) for each in zip(poses, stamps_ns, held, strict=True)]
    return Trajectory(np.array(stamps_ns), np.array(moved))


def tracked(log: Log, baseline) -> Trajectory:
    poses = [(scan.stamp_ns, baseline.track(scan.points, scan.times_s, scan.stamp_ns)) for scan in log.scans()]
    return Trajectory(np.array([stamp_ns for stamp_ns, _ in poses]), np.array([pose for _, pose in poses]))


METHODS: dict[str, Callable[[Log, float], Found]] = {
    "ours": ours, "map-closures": map_closures, "kiss-slam": kiss_slam, "retro-slam": retro_slam,
}  # fmt: skip


def row(path: Path, method: str, local_map_m: float) -> tuple[object, ...]:
    """The cells of a log and a method."""
    log = open_log(path)
    truth = log.ground_truth()
    began = perf_counter()
    with redirect_stdout(None):
        found = METHODS[method](log, local_map_m)
    spent_s = perf_counter() - began
    before, after = (
        "–" if each is None else f"{ate_m(each, truth):.2f}" for each in (found.odometry, found.final)
    )
    stamps_ns = next(each.stamps_ns for each in (found.odometry, found.final) if each is not None)
    poses = true_at(truth, stamps_ns + np.rint(1e9 * found.held_s).astype(np.int64))
    errors = [lie.apart(lie.between(poses[each.old], poses[each.new]), each.T_old_new) for each in found.loops]
    off_m, off_rad = np.array(errors).reshape(-1, 2).T
    is_true = (off_m < TRUE_M) & (off_rad < TRUE_RAD)
    covered = np.zeros(len(poses), np.bool_)
    for each, good in zip(found.loops, is_true, strict=True):
        covered[each.scans[0] : each.scans[1] + 1] |= good
    revisit, _ = revisits(poses[::EVERY], path_length(poses)[::EVERY])
    share = f"{100.0 * np.mean(covered[::EVERY][revisit]):.0f} % of {np.sum(revisit)}" if revisit.any() else "–"
    middle = f"{np.median(off_m[is_true]):.2f} m, {np.degrees(np.median(off_rad[is_true])):.2f}°"
    counts = len(errors), int(is_true.sum()), int((~is_true).sum())
    worst = f"{off_m.max():.1f} m" if len(errors) else "–"
    return (
        method,
        *counts,
        middle if is_true.any() else "–",
        worst,
        share,
        f"{before} to {after} m",
        f"{spent_s:.0f}",
    )


def true_at(truth: Trajectory, stamps_ns: NDArray[np.int64]) -> Matrix:
    """True poses (N, 4, 4), interpolated."""
    k = np.clip(np.searchsorted(truth.stamps_ns, stamps_ns) - 1, 0, len(truth) - 2)
    share = (stamps_ns - truth.stamps_ns[k]) / (truth.stamps_ns[k + 1] - truth.stamps_ns[k])
    return np.array([lie.interpolate(*truth.poses[i : i + 2], float(s)) for i, s in zip(k, share, strict=True)])


def main() -> None:
    options = options_of(__doc__, logs=list(LOGS), methods=list(METHODS), scans=1600, local_map=100.0)
    line = table(*HEAD.split(","))
    for name in options.logs:
        path = drive_of(*name.split(":"), options.scans, options.cache)
        for method in options.methods:
            line(name, *in_fresh_process(row, path, method, options.local_map))


if __name__ == "__main__":
    main()
