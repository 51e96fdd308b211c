"""Simulated drives without wheels: what the gyro's rotation between keyframes adds to the graph as an edge.

Rates without bias are integrated from keyframe to keyframe (Forster et al. 2017) and added to the finished graph
as edges of the rotation alone, with standard deviations of 0.01° to 0.1° per root second. "edges" are the errors
of the rotations between keyframes by matching and by the gyro; of the results follow ATE, tilt, and the error of
the rotation over 30 scans, without such edges and with each standard deviation.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

import scanchain
from scanchain import lie
from scanchain.data import Mask, Matrix
from scanchain.evaluation import absolute_error_of_any_path, pair
from scanchain.graph.factors import Odometry
from scanchain.loops import spread
from tests.benchmarks.harness import PLACES, options_of, table
from tests.support import made

SIGMAS_DEG = (0.01, 0.03, 0.1)  # per root second
SCANS = 30  # of the relative rotation


def rotations_of(slam: scanchain.Slam, log: scanchain.Log) -> tuple[Rotation, Mask]:
    """The log is processed; integrated rotations at its keyframes, and whether there are samples for them."""
    samples = []
    for scan in log:
        if scan.inertial is not None:
            samples.append((scan.inertial.stamps_ns, scan.inertial.rates))
        slam.process(replace(scan, T_odom_base=None))
    model = slam.front_end.odometry.predictor.gyro.model
    times_ns, first = np.unique(np.concatenate([times for times, _ in samples]), return_index=True)
    rates = np.concatenate([rates for _, rates in samples])[first] @ model.axes.T - model.bias
    times_s = 1e-9 * (times_ns - times_ns[0]) - model.delay_s
    turned = [Rotation.identity()]
    for step in Rotation.from_rotvec(0.5 * (rates[:-1] + rates[1:]) * np.diff(times_s)[:, None]):
        turned.append(turned[-1] * step)
    at_s = 1e-9 * (np.array([keyframe.stamp_ns for keyframe in slam.keyframes]) - times_ns[0])
    inside_s = np.clip(at_s, times_s[0], times_s[-1])
    return Slerp(times_s, Rotation.concatenate(turned))(inside_s), inside_s == at_s


def with_edges(graph: scanchain.PoseGraph, rotations: Rotation, known: Mask, sigma_deg: float) -> Matrix:
    """Poses (K, 4, 4) of the graph with edges of these rotations."""
    result = graph.copy()
    for k in np.flatnonzero(known[:-1] & known[1:]).tolist():
        Z, information = lie.between(graph.poses[k], graph.poses[k + 1]), np.zeros((6, 6))
        Z[:3, :3] = (rotations[k].inv() * rotations[k + 1]).as_matrix()
        lasted_s = 1e-9 * float(graph.stamps_ns[k + 1] - graph.stamps_ns[k])
        information[3:, 3:] = np.eye(3) / (np.radians(sigma_deg) ** 2 * lasted_s)
        result.add_factor(Odometry(), k + 1, information, Z, i=k)
    scanchain.optimize(result)
    return result.poses


def errors_of(poses: Matrix, true: Matrix, stamps_ns: NDArray[np.int64]) -> str:
    """ATE in m, tilt and rotation over SCANS in degrees."""
    pairs = pair(scanchain.Trajectory(stamps_ns, poses), scanchain.Trajectory(stamps_ns, true))
    tilts = np.linalg.norm(np.cross(poses[:, 2, :3], true[:, 2, :3]), axis=1)
    motions = (lie.between(each[:-SCANS], each[SCANS:]) for each in (poses, true))
    turns = lie.rotation_angle(lie.between(*motions))
    figures = (np.degrees(np.sqrt(np.mean(each**2))) for each in (tilts, turns))
    return f"{absolute_error_of_any_path(pairs).translation_m.rmse:.4f}, " + ", ".join(f"{x:.3f}" for x in figures)


def main() -> None:
    options = options_of(__doc__, worlds=PLACES, sensor="vlp-16", imu="mems", seeds=1)
    row = table("world, seed", "edges deg: matching, gyro", "without", *(f"{sigma:g}°" for sigma in SIGMAS_DEG))
    for world, seed in product(options.worlds, range(options.seeds)):
        path = made.log(world, folder=options.cache, sensor=options.sensor, seed=seed, imu=options.imu)
        slam = scanchain.Slam(dimension=3)
        rotations, known = rotations_of(slam, scanchain.open_log(path))
        result = slam.finish()
        stamps_ns, odometry = result.odometry.stamps_ns, result.odometry.poses
        true = scanchain.read_tum(path.with_suffix(".tum")).poses[: len(odometry)]
        scan_of = np.array([keyframe.scan_index for keyframe in result.keyframes])
        by_truth, by_match = (lie.between(each[scan_of][:-1], each[scan_of][1:]) for each in (true, odometry))
        by_gyro = by_match.copy()
        by_gyro[:, :3, :3] = (rotations[:-1].inv() * rotations[1:]).as_matrix()
        both = known[:-1] & known[1:]
        of_edges = (lie.rotation_angle(lie.between(by_truth, each))[both] for each in (by_match, by_gyro))
        graphs = [result.graph.poses, *(with_edges(result.graph, rotations, known, each) for each in SIGMAS_DEG)]
        row(
            f"{world}, {seed}",
            ", ".join(f"{np.degrees(np.sqrt(np.mean(each**2))):.4f}" for each in of_edges),
            *(errors_of(spread(poses, scan_of, odometry, [0]), true, stamps_ns) for poses in graphs),
        )


if __name__ == "__main__":
    main()
