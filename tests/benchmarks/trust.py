"""Error bars and covariances against the truth.

Worlds of 3D lidars, sensors and cache are those of ``odometry3d --set``; planar worlds are driven with LMS-270 and
UTM-30, all without wheels; with the times of the points and without, every scan and every second, and with noisy
ranges of which 30 % are missing (``--noises``, in meters). Then real logs,
their halves, and every second and third of their scans. A line says

  ATE       of the final trajectory
  expected  ATE, and its error bar; over the true one; * where it does not contain that
  wide      upper over lower bound
  NEES/k    squared error of the motion between two scans over its covariance, median, divided by that of the
            distribution of right ones: 1 is exact, more is overconfident; from scans that are neither degenerate
            nor lost
  k         of smfeval, if it is installed: median of the squared error of keyframes after alignment over their
            covariances (keyframes.tum), over that of right ones, of as many directions as the log has
  k pair    of smfeval's pair, which needs no truth: keyframes against KISS-ICP's, in space, which states no
            covariances and is given these: above 1 the two contradict each other by more than both would claim

Of Intel and ACES, whose truth are relations, errors of relations between visits (10 m of path or more) take the
place of the ATE: root mean square, and that of samples. The relations' own noise is part of that; it follows from
those below 1 m by comparing relations, wheels and odometry without wheels (three-cornered hat: their errors are
independent).
"""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from scanchain import evaluation, lie
from scanchain.baselines import KISS, KissIcp
from scanchain.data import Matrix, State, Step, Trajectory
from scanchain.errors import MissingExtraError
from scanchain.evaluation.consistency import error_samples
from scanchain.evaluation.pairing import nearest
from scanchain.logs import open_log
from scanchain.odometry.distortion import choose_point_times
from scanchain.runs.results import expected_of, systematic_of
from scanchain.settings import Override, load_settings
from scanchain.simulation import SENSORS, WORLDS
from scanchain.slam import Slam, SlamResult
from scanchain.trajectory import write_tum, write_wide_tum
from tests.benchmarks.harness import PLACES, SEQUENCES, drive_of, options_of, table
from tests.support.scenes import DATA

WARM_UP_SCANS = 3
FEW_KEYFRAMES = 5
NO_WHEELS = (Override("odometry.prior", "constant-velocity", "this benchmark"),)
PLANAR, PLANAR_SENSORS = ("office", "identical"), ("lms-270", "utm-30")
DROPOUT = 0.3  # share of the rays of noisy lidars that do not return
SHORT_M, LONG_M = 1.0, 10.0  # paths of relations that show their own noise, and that show ours
MOCAP = {"ground_truth_topic": "/vrpn_client_node/jackal/pose"}
REAL = {  # file, and keys of [log]
    "KITTI 0001": ("3d/kitti_0001_first54.mcap", {}),
    "PandaSet 002": ("3d/pandaset_002_sweeps30to55.mcap", {"topic": "/pandar64/points"}),
    "PandaSet 002, forward": ("3d/pandaset_002_sweeps30to55.mcap", {"topic": "/pandar_gt/points"}),
    "mocap room 1": ("2d/mocap_room_1.bag", MOCAP),
    "mocap room 2": ("2d/mocap_room_2.bag", MOCAP),
}
PARTS = {  # of real logs
    "": {},
    "first half": {"end_s": 0.5},
    "second half": {"start_s": 0.5},
    "every 2": {"every": 2},
    "every 3": {"every": 3},
}

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Line:
    """A line of the table; NaN where there is nothing."""

    name: str
    true_m: float
    expected_m: float
    low_m: float
    high_m: float
    nees: float
    gap: float
    pair_gap: float
    kind: str = ""

    @property
    def ratio(self) -> float:
        return self.expected_m / self.true_m

    @property
    def is_covered(self) -> bool:
        return self.low_m <= self.true_m <= self.high_m

    @property
    def cells(self) -> tuple[str, ...]:
        bounds = f"{self.expected_m:.4f} ({self.low_m:.4f} to {self.high_m:.4f})"
        ratio = f"{self.ratio:.2f}{'' if self.is_covered else '*'}"
        wide = f"{self.high_m / self.low_m:.1f}"
        figures = (f"{each:.2f}" for each in (self.nees, self.gap, self.pair_gap))
        return self.name, f"{self.true_m:.4f}", bounds, ratio, wide, *figures


def placed(
    path: Path, overrides: tuple[Override, ...] = NO_WHEELS, **of_log: object
) -> tuple[SlamResult, list[Step], Matrix, evaluation.ExpectedErrors | None, Trajectory | None]:
    """The result of a log, its steps, T_base_lidar, what is expected of it, and the truth."""
    log = open_log([path], **of_log)
    choose_point_times(log)
    config = load_settings(log.dimension, overrides=overrides).config
    slam = Slam(config, log.T_base_lidar)
    steps = [slam.process(scan) for scan in log.scans()]
    result = slam.finish()
    expected = expected_of(result, open_log([path], log.config).scans(), log.distorted_share)
    return result, steps, log.T_base_lidar, expected, log.ground_truth()


def line(name: str, path: Path, overrides: tuple[Override, ...] = NO_WHEELS, **of_log: object) -> Line:
    """A log with a truth of its own."""
    result, steps, _, expected, truth = placed(path, overrides, **of_log)
    return judged(name, result, steps, expected, truth)


def judged(
    name: str,
    result: SlamResult,
    steps: Sequence[Step],
    expected: evaluation.ExpectedErrors | None,
    truth: Trajectory,
) -> Line:
    """A result against the truth; without an error bar where the log is too short for one."""
    error = evaluation.absolute_error_of_any_path(evaluation.pair(result.trajectory, truth))
    true_m = error.translation_m.rmse
    if expected is None:
        return Line(name, true_m, *[np.nan] * 6)
    ate = expected.ate
    nees, gap = _nees(result, steps, truth), smfeval_gap(result, expected, truth)
    return Line(name, true_m, ate.mean, ate.low, ate.high, nees, gap, pair_gap(result, expected, steps))


def _nees(result: SlamResult, steps: Sequence[Step], truth: Trajectory) -> float:
    """Median NEES of the motions between scans over that of right ones."""
    pairs = evaluation.pair(result.odometry, truth)
    estimate, reference = pairs.estimate, pairs.reference
    if result.odometry.dimension == 2:
        estimate, reference = lie.flatten(lie.lift(estimate)), lie.flatten(lie.lift(reference))
    covariances = np.array([step.match.covariance for step in steps])[pairs.places]
    is_sure = np.array([step.state in (State.OK, State.CONTRADICTED) for step in steps])[pairs.places]
    covariances[~is_sure | (pairs.places < WARM_UP_SCANS)] = np.nan
    nees = evaluation.motion_nees(estimate, covariances, reference)
    k = covariances.shape[1]
    return float(np.nanmedian(nees) / (chi2.median(k) / k))


def smfeval_gap(
    result: SlamResult, expected: evaluation.ExpectedErrors, truth: Trajectory, sync: str = "nearest"
) -> float:
    """The scale gap k of smfeval, which assumes three directions, for the log's; NaN if it is not installed."""
    try:
        from smfeval.cli.main import main
    except ImportError:
        return np.nan
    with tempfile.TemporaryDirectory() as folder:
        estimate, reference = Path(folder, "keyframes.tum"), Path(folder, "truth.tum")
        write_wide_tum(estimate, result.keyframe_trajectory, expected.covariances)
        write_tum(reference, truth, force=True)
        frames = ("--est-body-frame", "lidar", "--ref-body-frame", "lidar", "--t_max_diff", "0.02", "--sync", sync)
        said = io.StringIO()
        quiet = contextlib.redirect_stderr(io.StringIO())
        with contextlib.redirect_stdout(said), quiet, contextlib.suppress(SystemExit):
            main(["nees", str(estimate), str(reference), *frames])
    found = re.findall(r"\bk = ([0-9.e+-]+)", said.getvalue())
    of_dimension = chi2.median(3) / chi2.median(result.trajectory.dimension)
    return float(found[0]) * of_dimension if found else np.nan


def pair_gap(result: SlamResult, expected: evaluation.ExpectedErrors, steps: Sequence[Step]) -> float:
    """The scale gap k of smfeval's pair with KISS-ICP in space; NaN where smfeval or KISS-ICP is not installed."""
    try:
        from smfeval.io.load import load_tum_gaussian
        from smfeval.scoring.pairwise import PairInputError, pair_translation_nees

        other = KissIcp(KISS) if result.trajectory.dimension == 3 else None
    except (ImportError, MissingExtraError):
        other = None
    if other is None:
        return np.nan
    ours = result.keyframe_trajectory
    poses = np.array([other.track(each.scan.points, each.scan.times_s, each.scan.stamp_ns) for each in steps])
    stamps_ns = np.array([each.scan.stamp_ns for each in steps])
    theirs = Trajectory(ours.stamps_ns, poses[np.searchsorted(stamps_ns, ours.stamps_ns)])
    loaded = []
    with tempfile.TemporaryDirectory() as folder:
        for name, trajectory in (("ours", ours), ("theirs", theirs)):
            write_wide_tum(Path(folder, name), trajectory, expected.covariances)
            loaded += load_tum_gaussian(Path(folder, name), pose_frame="map", body_frame="lidar")
    try:
        return pair_translation_nees(*loaded, min_matched=FEW_KEYFRAMES).k_pair
    except PairInputError:  # few keyframes
        return np.nan


def relations_line(name: str) -> Line:
    """A log whose truth are relations."""
    log = DATA / f"2d/{name}.mcap"
    relations = evaluation.read_relations(log.with_suffix(".relations"))
    unaided, steps, T_base_lidar, _, _ = placed(log)
    result = placed(log, ())[0]
    places, off_ns = nearest(relations.stamps_ns.ravel(), result.trajectory.stamps_ns)
    known = (off_ns.reshape(-1, 2) < 1_000_000).all(axis=1)
    a, b = places.reshape(-1, 2)[known].T
    true = lie.flatten(relations.T_first_second[known])
    path_m = evaluation.path_length(result.odometry.poses)
    length_m = np.abs(path_m[b] - path_m[a])
    noise = _own_noise(true, a, b, length_m < SHORT_M, unaided, steps, T_base_lidar)
    chosen = np.flatnonzero(length_m > LONG_M)
    poses = result.trajectory.poses
    error = lie.log(lie.between(true, lie.between(poses[a], poses[b])))[chosen]
    true_m = float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean()))
    config = load_settings(2).config
    opened = open_log([log])
    choose_point_times(opened)
    systematic = systematic_of(result, opened.scans(), opened.distorted_share)
    samples = error_samples(result.graph, result.map_errors, config, *systematic)
    expected_m = np.concatenate([_relation_errors(each, poses, a[chosen], b[chosen]) for each in samples])
    expected_m = np.sqrt(expected_m**2 + noise[0, 0] + noise[1, 1])
    low, high = np.percentile(expected_m, (2.5, 97.5))
    return Line(f"{name}, relations", true_m, float(expected_m.mean()), low, high, np.nan, np.nan, np.nan)


def _relation_errors(errors: Matrix, poses: Matrix, first: NDArray[np.int64], last: NDArray[np.int64]) -> Floats:
    """(n,) root mean squared position errors of the motions from first to last poses, of samples (n, N, 3)."""
    away = poses[last, :2, 2] - poses[first, :2, 2]
    turned = errors[:, first, 2, None] * np.stack([-away[:, 1], away[:, 0]], axis=1)
    apart = errors[:, last, :2] - errors[:, first, :2] - turned
    return np.sqrt((apart**2).sum(axis=2).mean(axis=1))


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


def summary(lines: Sequence[Line]) -> None:
    """Coverage, spread and width by kind."""
    print()
    lines = [each for each in lines if np.isfinite(each.low_m)]
    row = table("kind", "logs", "within the bounds", "expected over true", "spread", "wide", "NEES/k", "k pair")
    for kind in dict.fromkeys(each.kind for each in lines):
        chosen = [each for each in lines if each.kind == kind]
        logarithms = np.log([each.ratio for each in chosen])
        row(
            kind,
            len(chosen),
            f"{100 * np.mean([each.is_covered for each in chosen]):.0f} %",
            f"{np.exp(np.median(logarithms)):.2f}",
            f"{np.exp(np.std(logarithms)):.2f}",
            f"{np.median([each.high_m / each.low_m for each in chosen]):.1f}",
            f"{np.nanmedian([each.nees for each in chosen]):.2f}",
            f"{np.nanmedian([each.pair_gap for each in chosen]):.2f}",
        )
    far = [each.name for each in lines if each.true_m > 2.0 * each.high_m]
    print(f"off by more than twice the upper bound: {', '.join(far) or 'none'}", flush=True)


def simulated(arguments: Namespace) -> Iterator[tuple[str, str, Path, dict[str, object]]]:
    """Kind, name, log and keys of [log] of every simulated run."""
    for world in arguments.worlds.split(","):
        is_planar = SENSORS[WORLDS[world].sensor].dimension == 2
        sensors = PLANAR_SENSORS if is_planar else arguments.sensors.split(",")
        for sensor, seed in product(sensors, map(int, arguments.seeds.split(","))):
            path, place = (
                drive_of(world, sensor, arguments.scans, arguments.cache, seed),
                "2D" if is_planar else "3D",
            )
            yield f"simulated, {place}", f"{world} {sensor} {seed}", path, {}
            yield f"simulated, {place}", f"{world} {sensor} {seed}, every 2", path, {"every": 2}
            for noise_m in filter(None, map(float, arguments.noises.split(","))):
                noisy = drive_of(
                    world, sensor, arguments.scans, arguments.cache, seed, noise_m=noise_m, dropout=DROPOUT
                )
                yield f"simulated with noise, {place}", f"{world} {sensor} {seed}, {100 * noise_m:g} cm", noisy, {}
            untimed = f"{world} {sensor} {seed}, no times"
            yield f"simulated without times, {place}", untimed, path, {"point_times": "none"}


def real() -> Iterator[tuple[str, str, Path, dict[str, object]]]:
    """The same of the given real logs, and of their parts."""
    for (name, (file, of_log)), (part, keys) in product(REAL.items(), PARTS.items()):
        path = DATA / file
        log = open_log([path], **of_log)
        span_s = 1e-9 * np.ptp(log.expected_stamps(log.topic))
        seconds = {key: value * span_s if key.endswith("_s") else value for key, value in keys.items()}
        yield f"real, {file[:2].upper()}", ", ".join(filter(None, (name, part))), path, of_log | seconds


def main() -> None:
    arguments = options_of(
        __doc__,
        seeds="1,2,3",
        noises="0.02,0.04,0.08",
        real=False,
        **SEQUENCES | {"worlds": ",".join((*PLACES, *PLANAR)), "scans": 150},
    )
    row = table("sequence", "ATE m", "expected", "over", "wide", "NEES/k", "k", "k pair")
    lines = []
    for kind, name, path, of_log in chain([] if arguments.real else simulated(arguments), real()):
        lines.append(replace(line(name, path, **of_log), kind=kind))
        row(*lines[-1].cells)
    for name in ("intel", "aces"):
        lines.append(replace(relations_line(name), kind="real, 2D"))
        row(*lines[-1].cells)
    summary(lines)


if __name__ == "__main__":
    main()
