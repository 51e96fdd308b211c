"""Expected ATE and covariances against the truth.

Worlds of 3D lidars, sensors and cache are those of ``odometry3d --set``; planar worlds are driven with
LMS-270 and UTM-30, all without wheels. A line says

  ATE       of the final trajectory
  expected  ATE, and bounds that contain the true one in 95 of 100 cases; over the true one; * where they do not
  NEES/k    squared error of the motion between two scans over its covariance, mean, divided by its dimension: 1 is
            exact, more is overconfident; from scans that are neither degenerate nor lost
  k         of smfeval, if it is installed: median of the squared error of keyframes after alignment over their
            covariances (keyframes.tum), over that of right ones

Then the same of real logs. Of Intel and ACES, whose truth are relations, the errors of relations between visits
(10 m of path or more) take the place of the ATE: root mean square, and that which their covariances expect. The
relations' own noise is part of that; it follows from those below 1 m by comparing relations, wheels and odometry
without wheels (three-cornered hat: their errors are independent).
"""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import evaluation, lie
from scanchain.data import Matrix, State, Step, Trajectory
from scanchain.evaluation.consistency import with_map_errors
from scanchain.evaluation.pairing import nearest
from scanchain.logs import open_log
from scanchain.settings import Override, load_settings
from scanchain.simulation import SENSORS, WORLDS
from scanchain.slam import Slam, SlamResult
from scanchain.trajectory import write_tum, write_wide_tum
from tests.benchmarks.harness import PLACES, SEQUENCES, drive_of, options_of, table
from tests.support.scenes import DATA

WARM_UP_SCANS = 3
NO_WHEELS = (Override("odometry.prior", "constant-velocity", "this benchmark"),)
PLANAR, PLANAR_SENSORS = ("office", "identical"), ("lms-270", "utm-30")
SHORT_M, LONG_M = 1.0, 10.0  # paths of relations that show their own noise, and that show ours
REAL = {  # file, and keys of [log]
    "KITTI 0001": ("3d/kitti_0001_first54.mcap", {}),
    "PandaSet 002": ("3d/pandaset_002_sweeps30to55.mcap", {"topic": "/pandar64/points"}),
    "mocap room 1": ("2d/mocap_room_1.bag", {"ground_truth_topic": "/vrpn_client_node/jackal/pose"}),
    "mocap room 2": ("2d/mocap_room_2.bag", {"ground_truth_topic": "/vrpn_client_node/jackal/pose"}),
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
        return self.name, f"{self.true_m:.4f}", bounds, ratio, f"{self.nees:.2f}", f"{self.gap:.2f}"


def placed(
    path: Path, overrides: tuple[Override, ...] = NO_WHEELS, **of_log: object
) -> tuple[SlamResult, list[Step], Matrix, evaluation.ExpectedErrors, Trajectory | None]:
    """The result of a log, its steps, T_base_lidar, what is expected of it, and the truth."""
    log = open_log([path], **of_log)
    config = load_settings(log.dimension, overrides=overrides).config
    slam = Slam(config, log.T_base_lidar)
    steps = [slam.process(scan) for scan in log.scans()]
    result = slam.finish()
    starts = [keyframe.scan_index for keyframe in result.keyframes]
    scans = np.diff([*starts, len(steps)])
    expected = evaluation.expected_errors(result.graph, result.map_errors, config, scans)
    return result, steps, log.T_base_lidar, expected, log.ground_truth()


def line(name: str, path: Path, overrides: tuple[Override, ...] = NO_WHEELS, **of_log: object) -> Line:
    """A log with a truth of its own."""
    result, steps, _, expected, truth = placed(path, overrides, **of_log)
    return judged(name, result, steps, expected, truth)


def judged(
    name: str, result: SlamResult, steps: Sequence[Step], expected: evaluation.ExpectedErrors, truth: Trajectory
) -> Line:
    """A result against the truth."""
    error = evaluation.absolute_error_of_any_path(evaluation.pair(result.trajectory, truth))
    true_m, ate = error.translation_m.rmse, expected.ate
    nees, gap = _nees(result, steps, truth), _gap(result, expected, truth)
    return Line(name, true_m, ate.mean, ate.low, ate.high, nees, gap)


def _nees(result: SlamResult, steps: Sequence[Step], truth: Trajectory) -> float:
    """Mean NEES of the motions between scans; NaN where not every scan has a true pose."""
    pairs = evaluation.pair(result.odometry, truth)
    estimate, reference = pairs.estimate, pairs.reference
    if result.odometry.dimension == 2:
        estimate, reference = lie.flatten(lie.lift(estimate)), lie.flatten(lie.lift(reference))
    covariances = np.array([step.match.covariance for step in steps])[pairs.places]
    is_sure = np.array([step.state in (State.OK, State.CONTRADICTED) for step in steps])[pairs.places]
    covariances[~is_sure | (pairs.places < WARM_UP_SCANS)] = np.nan
    return float(np.nanmean(evaluation.motion_nees(estimate, covariances, reference)))


def _gap(result: SlamResult, expected: evaluation.ExpectedErrors, truth: Trajectory) -> float:
    """The scale gap k of smfeval; NaN where it is not installed."""
    try:
        from smfeval.cli.main import main
    except ImportError:
        return np.nan
    with tempfile.TemporaryDirectory() as folder:
        estimate, reference = Path(folder, "keyframes.tum"), Path(folder, "truth.tum")
        write_wide_tum(estimate, result.keyframe_trajectory, expected.covariances)
        write_tum(reference, truth, force=True)
        frames = ("--est-body-frame", "lidar", "--ref-body-frame", "lidar", "--t_max_diff", "0.02")
        said = io.StringIO()
        quiet = contextlib.redirect_stderr(io.StringIO())
        with contextlib.redirect_stdout(said), quiet, contextlib.suppress(SystemExit):
            main(["nees", str(estimate), str(reference), *frames])
    found = re.findall(r"\bk = ([0-9.e+-]+)", said.getvalue())
    return float(found[0]) if found else np.nan


def relations_line(name: str) -> Line:
    """A log whose truth are relations."""
    log = DATA / f"2d/{name}.mcap"
    relations = evaluation.read_relations(log.with_suffix(".relations"))
    unaided, steps, T_base_lidar, _, _ = placed(log)
    result, _, _, expected, _ = placed(log, ())
    places, off_ns = nearest(relations.stamps_ns.ravel(), result.trajectory.stamps_ns)
    known = (off_ns.reshape(-1, 2) < 1_000_000).all(axis=1)
    a, b = places.reshape(-1, 2)[known].T
    true = lie.flatten(relations.T_first_second[known])
    path_m = evaluation.path_length(result.odometry.poses)
    length_m = np.abs(path_m[b] - path_m[a])
    noise = _own_noise(true, a, b, length_m < SHORT_M, unaided, steps, T_base_lidar)
    keyframes = np.array([keyframe.scan_index for keyframe in result.keyframes])
    first, last = (np.searchsorted(keyframes, scans, side="right") - 1 for scans in (a, b))
    chosen = np.flatnonzero((length_m > LONG_M) & (first != last))
    graph, own = with_map_errors(result.graph, result.map_errors, load_settings(2).config)
    ends = zip(first[chosen].tolist(), last[chosen].tolist(), strict=True)
    covariance = noise + np.array([graph.relative_covariance(i, j) + own[i] + own[j] for i, j in ends])
    poses = result.trajectory.poses
    error = lie.log(lie.between(true, lie.between(poses[a], poses[b])))[chosen]
    nees = float(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error).mean()) / 3.0
    expected_m = float(np.sqrt(covariance[:, [0, 1], [0, 1]].sum(axis=1).mean()))
    true_m = float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean()))
    low, high = (expected_m * each / expected.ate.mean for each in (expected.ate.low, expected.ate.high))
    return Line(f"{name}, relations", true_m, expected_m, low, high, nees, np.nan)


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


def summary(kind: str, lines: Sequence[Line]) -> None:
    """Coverage and median ratio of some lines."""
    ratios = np.array([each.ratio for each in lines])
    covered = np.mean([each.is_covered for each in lines])
    print(
        f"{kind}: {len(lines)} logs, {100 * covered:.0f} % within the bounds, expected over true "
        f"{np.median(ratios):.2f} "
        f"(median; {np.percentile(ratios, 10):.2f} to {np.percentile(ratios, 90):.2f} in eight of ten), NEES/k "
        f"{np.nanmin([each.nees for each in lines]):.2f} to {np.nanmax([each.nees for each in lines]):.2f}",
        flush=True,
    )


def main() -> None:
    arguments = options_of(
        __doc__, seeds="1,2,3", real=False, **SEQUENCES | {"worlds": ",".join((*PLACES, *PLANAR)), "scans": 150}
    )
    row = table("sequence", "ATE m", "expected", "over", "NEES/k", "k")
    lines = []
    for world in [] if arguments.real else arguments.worlds.split(","):
        is_planar = SENSORS[WORLDS[world].sensor].dimension == 2
        for sensor in PLANAR_SENSORS if is_planar else arguments.sensors.split(","):
            for seed in map(int, arguments.seeds.split(",")):
                path = drive_of(world, sensor, arguments.scans, arguments.cache, seed)
                lines.append(line(f"{world} {sensor} {seed}", path))
                row(*lines[-1].cells)
    if lines:
        summary("simulated", lines)
    lines = [line(name, DATA / file, (), **of_log) for name, (file, of_log) in REAL.items()]
    lines += [relations_line(name) for name in ("intel", "aces")]
    for each in lines:
        row(*each.cells)
    summary("real", lines)


if __name__ == "__main__":
    main()
