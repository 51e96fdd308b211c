"""Consistency of our covariances, of the flags of degeneracy and of the expected ATE with the truth.

    python -m tests.benchmarks.trust [--worlds town,...] [--sensors vlp-16,...] [--scans N] [--cache DIR]

Worlds of 3D lidars, sensors and cache are those of tests.benchmarks.odometry3d_set; the planar worlds are driven
with LMS-270. The odometry has no wheels. A line says

  NEES/k    squared error of the motion between two scans over its covariance, mean, divided by its dimension:
            1 is exact, more is overconfident; from scans that are not degenerate
  along     the same of the translation along the direction with the largest standard deviation (a corridor's)
  across    the same along the one with the smallest
  edges     NEES/k of the odometry edges of the pose graph
  blind     scans whose true geometry says next to nothing along some direction (tests.support.scan_information)
  flagged   share of those that are called degenerate; in brackets the median angle between the direction that is
            named and the blind ones
  sound     scans whose true geometry says enough along every direction
  wrongly   share of those that are called degenerate
  ATE       of the final trajectory, and the expected one with its bounds

Then the same of the real logs with relations: NEES of the final relative pose by the marginals of the graph, over
relations between visits (10 m of path or more). The relations' own noise is added; it follows from those below 1 m
by comparing relations, wheels and odometry without wheels (three-cornered hat: their errors are independent).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, State, Step, Trajectory
from scanchain.evaluation import (
    ExpectedError,
    absolute_error_of_any_path,
    expected_ate,
    motion_nees,
    pair,
    read_relations,
)
from scanchain.evaluation.absolute import path_length
from scanchain.evaluation.pairing import nearest
from scanchain.logs import open_log
from scanchain.settings import Override, load_settings
from scanchain.simulation import SENSORS, WORLDS, Drive, plan
from scanchain.slam import Slam, SlamResult
from tests.benchmarks.accuracy import DATA
from tests.benchmarks.odometry3d_set import PLACES, SEED, log_of, parser_of
from tests.support.scan_information import information, spectrum

BLIND_SHARE, SOUND_SHARE = 1e-6, 1e-3  # of the returns that speak about the worst direction
WARM_UP_SCANS = 3
NO_WHEELS = (Override("odometry.prior", "constant-velocity", "this benchmark"),)
PLANAR, PLANAR_SENSOR = ("office", "identical"), "lms-270"
SHORT_M, LONG_M = 1.0, 10.0  # paths of relations that show their own noise, and that show ours

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Trust:
    """What a line of the table holds; angles in degrees, empty where nothing is blind."""

    nees: Floats
    along_across: Floats
    of_edges: Floats
    angles_deg: Floats
    flags_of_blind: NDArray[np.bool_]
    flags_of_sound: NDArray[np.bool_]
    ate_m: float
    expected: ExpectedError

    def __str__(self) -> str:
        blind, sound = self.flags_of_blind, self.flags_of_sound
        figures = (self.nees, *self.along_across.T, self.of_edges)
        nees = "".join(f"{each.mean():8.2f}" if len(each) else f"{'-':>8}" for each in figures)
        flagged = f"{100.0 * blind.mean():7.1f} % ({np.median(self.angles_deg):4.1f} deg)" if blind.any() else "-"
        wrongly = f"{100.0 * sound.mean():.1f} %" if len(sound) else "-"
        ate = f"{self.ate_m:.3f} m, {self.expected.text}"
        return f"{nees}{len(blind):8}{flagged:>22}{len(sound):8}{wrongly:>10}  {ate}"


def placed(path: Path, overrides: tuple[Override, ...] = NO_WHEELS) -> tuple[SlamResult, list[Step], Matrix]:
    """The result of a log, its steps, and T_base_lidar."""
    log = open_log([path])
    slam = Slam(load_settings(log.dimension, overrides=overrides).config, log.T_base_lidar)
    steps = [slam.process(scan) for scan in log.scans()]
    return slam.finish(), steps, log.T_base_lidar


def trust(path: Path, drive: Drive) -> Trust:
    """Run our SLAM over a simulated log and compare."""
    result, steps, _ = placed(path)
    d = result.trajectory.dimension
    truth = Trajectory(result.trajectory.stamps_ns, drive.truth().poses[: len(steps)])
    true_poses = truth.poses
    flags = np.array([step.state is State.DEGENERATE for step in steps])
    shares, angles = np.full(len(steps), np.nan), np.full(len(steps), np.nan)
    for k, step in enumerate(steps if d == 3 else ()):
        H = information(drive.solids, truth.poses[k], drive.sensor, index=int(drive.scans[k]))
        all_shares, twists = spectrum(H)
        shares[k] = all_shares[0]
        if flags[k] and shares[k] < BLIND_SHARE:
            angles[k] = _angle_deg(step.match.degeneracy_direction, twists[all_shares < BLIND_SHARE], H)
    judged = np.arange(len(steps)) >= WARM_UP_SCANS
    blind, sound = judged & (shares < BLIND_SHARE), judged & (shares > SOUND_SHARE)
    covariances = np.linalg.pinv(np.array([step.match.information for step in steps]), hermitian=True)
    poses = result.odometry.poses
    sure = judged[1:] & ~flags[1:] & ~flags[:-1]
    motion = lie.between(poses[:-1], poses[1:])
    Ad = lie.adjoint(lie.inverse(motion))
    covariance = (covariances[1:] + Ad @ covariances[:-1] @ np.swapaxes(Ad, 1, 2))[sure]
    error = lie.log(lie.between(lie.between(true_poses[:-1], true_poses[1:]), motion))[sure]
    ate = absolute_error_of_any_path(pair(result.trajectory, truth))
    return Trust(
        motion_nees(poses, covariances, true_poses)[sure],
        along_and_across(error, covariance),
        _of_edges(result, true_poses),
        angles[blind & flags],
        flags[blind],
        flags[sound],
        ate.translation_m.rmse,
        expected_ate(result.graph, _scans_of_keyframes(result)),
    )


def along_and_across(error: Floats, covariance: Matrix) -> Floats:
    """(N, 2) squared errors (N, k) over variances along the translation of largest and of smallest variance."""
    d = 2 if error.shape[1] == 3 else 3
    variances, directions = np.linalg.eigh(covariance[:, :d, :d])
    parts = np.einsum("nij,ni->nj", directions, error[:, :d]) ** 2 / variances
    return parts[:, [-1, 0]]


def nees(error: Floats, covariance: Matrix) -> Floats:
    """(N,) NEES of errors (N, k), divided by k."""
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error) / error.shape[1]


def _of_edges(result: SlamResult, true_poses: Matrix) -> Floats:
    graph, odometry = result.graph, ~result.graph.is_loop
    at_keyframes = true_poses[[keyframe.scan_index for keyframe in result.keyframes]]
    i, j = graph.edges[odometry].T
    error = lie.log(lie.between(lie.between(at_keyframes[i], at_keyframes[j]), graph.measurements[odometry]))
    return nees(error, np.linalg.inv(graph.information[odometry]))


def _scans_of_keyframes(result: SlamResult) -> NDArray[np.int64]:
    starts = [keyframe.scan_index for keyframe in result.keyframes]
    return np.diff([*starts, len(result.trajectory)])


def _angle_deg(named: Floats, blind: Matrix, H: Matrix) -> float:
    """Between a twist and the span of blind ones, rotations counted as the lengths they move a return by."""
    lever_m = np.sqrt(np.trace(H[3:, 3:]) / np.trace(H[:3, :3]))
    even = np.repeat([1.0, lever_m], 3)
    basis = np.linalg.qr((blind * even).T)[0]
    named = named * even
    return float(np.degrees(np.arccos(min(np.linalg.norm(basis.T @ named) / np.linalg.norm(named), 1.0))))


def relations_line(name: str) -> str:
    """A line of the table of real logs."""
    log = DATA / f"2d/{name}.mcap"
    relations = read_relations(log.with_suffix(".relations"))
    unaided, steps, T_base_lidar = placed(log)
    result, _, _ = placed(log, ())
    places, off_ns = nearest(relations.stamps_ns.ravel(), result.trajectory.stamps_ns)
    known = (off_ns.reshape(-1, 2) < 1_000_000).all(axis=1)
    a, b = places.reshape(-1, 2)[known].T
    true = lie.flatten(relations.T_first_second[known])
    path_m = path_length(result.odometry.poses)
    length_m = np.abs(path_m[b] - path_m[a])
    noise = _own_noise(true, a, b, length_m < SHORT_M, unaided, steps, T_base_lidar)
    keyframes = np.array([keyframe.scan_index for keyframe in result.keyframes])
    first, last = (np.searchsorted(keyframes, scans, side="right") - 1 for scans in (a, b))
    chosen = np.flatnonzero((length_m > LONG_M) & (first != last))
    covariance = noise + np.array([result.graph.relative_covariance(int(first[c]), int(last[c])) for c in chosen])
    poses = result.trajectory.poses
    error = lie.log(lie.between(true, lie.between(poses[a], poses[b])))[chosen]
    along, across = along_and_across(error, covariance).mean(axis=0)
    sigmas = ", ".join(f"{value:.4f}" for value in np.sqrt(np.diag(noise)))
    return (
        f"{name:22}{nees(error, covariance).mean():8.2f}{along:8.2f}{across:8.2f}  over {len(chosen)} relations "
        f"of noise {sigmas} m, m, rad; expected ATE {expected_ate(result.graph, _scans_of_keyframes(result)).text}"
    )


def _own_noise(
    true: Matrix, a: NDArray[np.int64], b: NDArray[np.int64], is_short: NDArray[np.bool_], unaided: SlamResult,
    steps: list[Step], T_base_lidar: Matrix,
) -> Matrix:  # fmt: skip
    """(3, 3) diagonal covariance of relations, of three independent measurements of the same motions."""
    unknown = np.full((3, 3), np.nan)
    wheels = np.array(
        [unknown if s.scan.T_odom_base is None else s.scan.T_odom_base @ T_base_lidar for s in steps]
    )
    chosen = is_short & np.isfinite(wheels[a, 0, 0]) & np.isfinite(wheels[b, 0, 0])
    poses = unaided.odometry.poses
    three = [true[chosen], *(lie.between(each[a], each[b])[chosen] for each in (poses, wheels))]
    apart = [np.mean(lie.log(lie.between(three[i], three[j])) ** 2, axis=0) for i, j in ((0, 1), (0, 2), (1, 2))]
    return np.diag(np.maximum(0.5 * (apart[0] + apart[1] - apart[2]), 1e-8))


def main() -> None:
    parser = parser_of(__doc__)
    parser.set_defaults(worlds=",".join((*PLACES, *PLANAR)))
    arguments = parser.parse_args()
    heads = "".join(f"{head:>8}" for head in ("NEES/k", "along", "across", "edges", "blind"))
    print(f"{'sequence':22}{heads}{'flagged':>22}{'sound':>8}{'wrongly':>10}  ATE")
    for world in arguments.worlds.split(","):
        is_planar = SENSORS[WORLDS[world].sensor].dimension == 2
        for sensor in (PLANAR_SENSOR,) if is_planar else arguments.sensors.split(","):
            scans = 10**9 if is_planar else arguments.scans
            path = log_of(world, sensor, scans, arguments.cache)
            answer = trust(path, plan(world, seed=SEED, sensor=sensor))
            print(f"{world + ' ' + sensor:22}{answer}", flush=True)
    for name in ("intel", "aces"):
        if (DATA / f"2d/{name}.mcap").exists():
            print(relations_line(name), flush=True)


if __name__ == "__main__":
    main()
