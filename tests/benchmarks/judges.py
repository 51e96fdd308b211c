"""Trajectories of real logs with ground truth before outside judges: evo (GPL 3) and smfeval (Apache 2.0).

  ATE       from the first scan on, by our evaluation; by evo, with the truth interpolated at the stamps of the
            scans, as by ours, and with the nearest true pose within 20 ms
  k         median of the squared error of keyframes after alignment over their covariances, over that of right
            ones (above 1 is overconfident): by our evaluation; by smfeval, with the truth interpolated and nearest
  k pair    of smfeval, which needs no truth: keyframes against KISS-ICP's, given the same covariances; in space

smfeval assumes errors in three directions. Planar ones have two, so that its k is put on the scale of these.
"""

from __future__ import annotations

import numpy as np
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from scipy.stats import chi2

from scanchain import evaluation, lie
from scanchain.data import Trajectory
from scanchain.evaluation import ExpectedErrors
from tests.benchmarks.harness import options_of, table
from tests.benchmarks.trust import NO_WHEELS, REAL, pair_gap, placed, smfeval_gap
from tests.support.scenes import DATA

NEAREST_S = 0.02  # of smfeval and evo


def evo_ate(estimate: Trajectory, truth: Trajectory, method: str) -> float:
    """ATE after rigid alignment by evo, with its pairing of stamps."""
    start_ns = truth.stamps_ns.min()
    both = (
        PoseTrajectory3D(poses_se3=list(lie.lift(each.poses)), timestamps=1e-9 * (each.stamps_ns - start_ns))
        for each in (truth, estimate)
    )
    reference, found = sync.associate_trajectories(*both, max_diff=NEAREST_S, sync_method=sync.SyncMethod[method])
    found.align(reference)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((reference, found))
    return float(error.get_statistic(metrics.StatisticsType.rmse))


def our_gap(keyframes: Trajectory, expected: ExpectedErrors, truth: Trajectory) -> float:
    """The same as k of smfeval, by our evaluation: of the translations of log(T_estimate⁻¹ T_truth)."""
    pairs, d = evaluation.pair(keyframes, truth), keyframes.dimension
    aligned = evaluation.absolute_error_of_any_path(pairs).T_reference_estimate @ pairs.estimate
    error = lie.log(lie.between(aligned, pairs.reference))[:, :d]
    covariances = expected.covariances[pairs.places, :d, :d]
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(covariances, error[..., None])[..., 0])
    return float(np.median(nees) / chi2.median(d))


def main() -> None:
    options_of(__doc__, cache=False)
    row = table(
        "log", "ATE m", "evo, interpolated", "evo, nearest", "k", "smfeval, interpolated", "nearest", "k pair"
    )
    for name, (file, of_log) in REAL.items():
        result, steps, _, expected, truth = placed(DATA / file, NO_WHEELS, **of_log)
        ours = evaluation.absolute_error_of_any_path(evaluation.pair(result.trajectory, truth)).translation_m.rmse
        evo = [evo_ate(result.trajectory, truth, method) for method in ("interpolation", "nearest_time")]
        gaps = [our_gap(result.keyframe_trajectory, expected, truth)]
        gaps += [smfeval_gap(result, expected, truth, method) for method in ("interpolate_ref", "nearest")]
        gaps += [pair_gap(result, expected, steps)]
        row(name, *(f"{each:.4f}" for each in (ours, *evo)), *(f"{each:.2f}" for each in gaps))


if __name__ == "__main__":
    main()
