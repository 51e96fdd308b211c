"""Time offset and scale of an estimate, which rigid alignment leaves out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.evaluation.absolute import Alignment, absolute_error, align
from scanchain.evaluation.pairing import Pairs, pair

_FARTHEST_S, _STEP_S = 1.0, 0.05  # offsets that are tried: the largest, and from one to the next
_EXACT_S = 1e-5  # error of the offset at which the search ends
_FLAT = 1.02  # ratio of the ATE at the farthest offsets to the least, below which it does not depend on the offset


def shifted(trajectory: Trajectory, offset_s: float) -> Trajectory:
    """The trajectory with so many seconds added to its stamps."""
    return Trajectory(trajectory.stamps_ns + round(offset_s * 1e9), trajectory.poses)


def scaled(pairs: Pairs, scale: float) -> Pairs:
    """Pairs with the positions of the estimate multiplied."""
    estimate = pairs.estimate.copy()
    estimate[:, :3, 3] *= scale
    return replace(pairs, estimate=estimate)


def scale_of(pairs: Pairs) -> float:
    """Scale s of the estimate that minimizes Σ ‖t_ref − s R t_est − t‖² (Umeyama 1991, eq. 42).

    Raises InputError where the estimate stands still, or no positive scale fits.
    """
    R = align(pairs.estimate, pairs.reference, Alignment.RIGID)[:3, :3]
    estimate, reference = (
        poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (pairs.estimate, pairs.reference)
    )
    spread, common = float(np.sum(estimate**2)), float(np.sum(reference * (estimate @ R.T)))
    if not 0.0 < common < np.inf or not spread:
        raise InputError("no positive scale of the estimate fits the ground truth; leave the scale out")
    return common / spread


def find_time_offset(
    estimate: Trajectory, truth: Trajectory, *, gap_s: float | None = None, with_scale: bool = False
) -> float:
    """Seconds to add to the stamps of the estimate at which its ATE after rigid alignment is least, within ±1 s.

    with_scale : the estimate is scaled to fit at each offset, too
    Raises InputError where the ATE does not depend on the offset, or is least at the farthest one that is tried.
    """
    from scipy.optimize import minimize_scalar

    def ate_m(offset_s: float) -> float:
        try:
            pairs = pair(shifted(estimate, offset_s), truth, gap_s=gap_s)
        except InputError:  # no pair at this offset
            return np.inf
        return absolute_error(scaled(pairs, scale_of(pairs)) if with_scale else pairs).translation_m.rmse

    absolute_error(pair(estimate, truth, gap_s=gap_s))  # raises where no alignment is determined
    offsets_s = np.arange(-_FARTHEST_S, _FARTHEST_S + _STEP_S / 2, _STEP_S)
    errors_m = np.array([ate_m(offset_s) for offset_s in offsets_s])
    best = int(np.argmin(errors_m))
    if np.nanmax(errors_m[[0, -1]]) < _FLAT * errors_m[best]:
        raise InputError(
            "the ATE does not depend on the time offset, as at rest; give it in seconds, or leave it out"
        )
    if best in (0, len(offsets_s) - 1):
        raise InputError(f"the time offset is not within {_FARTHEST_S:g} s; give it in seconds")
    found = minimize_scalar(
        ate_m, bounds=(offsets_s[best - 1], offsets_s[best + 1]), method="bounded", options={"xatol": _EXACT_S}
    )
    return float(found.x)
