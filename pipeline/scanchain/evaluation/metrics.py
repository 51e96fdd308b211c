"""All metrics of a trajectory against the truth, after correction of its time offset and scale."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from scanchain import checks
from scanchain.data import Matrix, Trajectory
from scanchain.errors import InputError
from scanchain.evaluation.errors import (
    AbsoluteError,
    Alignment,
    KittiError,
    RelationError,
    RelativeError,
    absolute_error,
    align,
    far_off,
    relative_errors,
)
from scanchain.evaluation.pairing import Pairs, pair, read_truth
from scanchain.trajectory import read_tum

_FARTHEST_S, _STEP_S = 1.0, 0.05  # largest offset tried, and step between offsets
_FLAT = 1.02  # ratio of the ATE at the farthest offsets to the least, below which it does not depend on the offset


def shifted(trajectory: Trajectory, offset_s: float) -> Trajectory:
    """The trajectory with ``offset_s`` added to its stamps."""
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
        ate_m, bounds=(offsets_s[best - 1], offsets_s[best + 1]), method="bounded", options={"xatol": 1e-5}
    )
    return float(found.x)


Result = AbsoluteError | RelativeError | KittiError | RelationError
Kind = TypeVar("Kind", bound=Result)

_INTERVAL = re.compile(r"(\d+(?:\.\d+)?)(poses?|s|m)")


@dataclass(frozen=True, slots=True)
class Results:
    """Metrics by name: those computed, and the reason for each that could not be.

    ``pairing`` : which poses were compared with the truth; ``warnings`` : why that may mislead, one per line
    ``start_m`` : error of the motion from the first pose to the second; ``after_start`` : the ATE without that
    ``scale``, ``time_offset_s`` : the factor put on the estimate and the seconds added to its stamps before that
    ``aligned`` : (N, 4, 4) the estimate as the ATE compares it, ``reference`` the true poses paired with it
    """

    found: dict[str, Result]
    missing: dict[str, str]
    pairing: str = ""
    warnings: Sequence[str] = ()
    scale: float = 1.0
    time_offset_s: float = 0.0
    start_m: float | None = None
    after_start: AbsoluteError | None = None
    aligned: Matrix = field(default_factory=lambda: np.empty((0, 4, 4)))
    reference: Matrix = field(default_factory=lambda: np.empty((0, 4, 4)))

    def __repr__(self) -> str:
        shares = {name: e.translation_share for name, e in self.found.items() if isinstance(e, KittiError)}
        errors = {name: e.translation_m.rmse for name, e in self.found.items() if not isinstance(e, KittiError)}
        texts = [f"{name} rmse {rmse_m:.4f} m" for name, rmse_m in errors.items()]
        return f"Results({', '.join(texts + [f'{name} {100.0 * share:.3g} %' for name, share in shares.items()])})"

    @property
    def ate(self) -> AbsoluteError:
        """The ATE."""
        return self._of("ate", AbsoluteError)

    @property
    def rpe(self) -> dict[str, RelativeError]:
        """The RPE by interval, as "1_pose", "1_s" or "10_m"; without those that the path is too short for."""
        parts = self.found.items()
        return {name.removeprefix("rpe_"): error for name, error in parts if isinstance(error, RelativeError)}

    @property
    def kitti(self) -> KittiError:
        """The KITTI metric. Raises InputError where the path is too short for it."""
        return self._of("kitti", KittiError)

    def _of(self, name: str, kind: type[Kind]) -> Kind:
        error = self.found.get(name)
        if not isinstance(error, kind):
            raise InputError(self.missing.get(name, f"{name} was not computed: the result has no ground truth"))
        return error


def evaluate(
    estimate: Trajectory | str | Path,
    truth: Trajectory | str | Path,
    *,
    align: str = "rigid",
    max_gap_s: float | None = None,
    rpe: str = "1pose,1s,10m,100m",
    scale: bool = False,
    time_offset: float | Literal["auto"] = 0.0,
) -> Results:
    """Every metric that a trajectory and its ground truth allow: ATE, RPE over each interval, KITTI.

    estimate : a trajectory, a TUM file, or a run directory, for its trajectory.tum
    truth : a trajectory, a TUM file, or a KITTI file with one row per pose of the estimate
    align : "rigid", "first" or "none", for the ATE
    max_gap_s : widest gap of the truth to interpolate over; by default five typical intervals, 0.1 to 0.6 s
    rpe : intervals in poses, seconds or meters
    scale : whether the estimate is scaled to fit the truth first (Umeyama 1991), for one of unknown scale
    time_offset : seconds to add to the stamps of the estimate, or "auto" for those of the least ATE within ±1 s
    Returns ``ate``, ``rpe`` by interval ("1_s") and ``kitti``; ``missing`` with reasons, ``warnings``.
    Raises InputError where no pose has a true one, or an argument is none of these.
    """
    checks.one_of(align, tuple(each.value for each in Alignment), "align")
    intervals = _intervals(rpe)
    if isinstance(estimate, str | Path):
        estimate = read_tum(estimate)
    checks.instance(estimate, Trajectory, "estimate", "read_tum(path)")
    if isinstance(truth, str | Path):
        truth = read_truth(Path(truth)).at(estimate.stamps_ns)
    checks.instance(truth, Trajectory, "truth", "read_tum(path)")
    if time_offset == "auto":
        time_offset = find_time_offset(estimate, truth, gap_s=max_gap_s, with_scale=scale)
    offset_s = checks.seconds(time_offset, "time_offset")
    pairs = pair(shifted(estimate, offset_s), truth, gap_s=max_gap_s)
    factor = scale_of(pairs) if scale else 1.0
    pairs = scaled(pairs, factor)
    ate = absolute_error(pairs, Alignment(align))
    complaint = far_off(ate.translation_m.rmse, ate.path_length_m, ate.rotation_rad.rmse)
    warnings = [complaint, *pairs.warnings] if complaint else pairs.warnings
    aligned = ate.T_reference_estimate @ pairs.estimate
    errors, missing = relative_errors(pairs, intervals)
    after = None
    with suppress(InputError):  # no alignment is determined without the first pose
        after = absolute_error(pairs.after_start, Alignment(align)) if pairs.starts else None
    return Results(
        {"ate": ate, **errors}, missing, pairs.description, warnings, factor, offset_s, pairs.start_error_m, after,
        aligned, pairs.reference,
    )  # fmt: skip


def _intervals(text: str) -> list[tuple[float, str]]:
    """Size and unit of each interval of a list such as ``1pose,0.5s,10m``."""
    found = [(word, _INTERVAL.fullmatch(word.strip())) for word in text.split(",")]
    for word, match in found:
        if match is None or float(match[1]) == 0.0 or (match[2].startswith("pose") and "." in match[1]):
            raise InputError(f"--rpe has {word!r}; take sizes such as 1pose, 0.5s or 10m, with commas")
    return [(float(match[1]), match[2].removesuffix("s") or "s") for _, match in found if match]
