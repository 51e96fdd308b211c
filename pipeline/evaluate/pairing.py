"""Poses of two trajectories that belong to the same instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.data import Matrix, Trajectory
from pipeline.errors import InputError

PAIRING_LIMIT_S = 0.01


@dataclass(frozen=True, slots=True)
class Pairs:
    """Estimate and reference, pose by pose, in the order of the estimate.

    Attributes
    ----------
    stamps_ns : (N,) int64, the estimate's
    estimate, reference : (N, 4, 4) poses; SE(2) lifted into the plane z = 0
    indices : (N, 2) int64, their places in the estimate and in the reference
    estimate_count, reference_count : poses there were
    limit_s : largest difference of stamps allowed
    """

    stamps_ns: NDArray[np.int64]
    estimate: Matrix
    reference: Matrix
    indices: NDArray[np.int64]
    estimate_count: int
    reference_count: int
    limit_s: float

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def share(self) -> float:
        """Share of the poses of the shorter trajectory that found a partner."""
        return len(self) / min(self.estimate_count, self.reference_count)

    @property
    def description(self) -> str:
        """What was paired, in words."""
        return (
            f"{len(self)} pairs by nearest stamp within {self.limit_s:g} s "
            f"({100.0 * self.share:.1f} % of the shorter trajectory; "
            f"{self.estimate_count} estimated, {self.reference_count} reference poses)"
        )


def pair(estimate: Trajectory, reference: Trajectory, *, limit_s: float = PAIRING_LIMIT_S) -> Pairs:
    """Pair each pose of the shorter trajectory with the nearest in time of the longer one, within the limit.

    A pose stands in one pair only, that with the nearest partner. Stamps need not increase: a log's own order is
    kept and only the search is done on sorted stamps.
    """
    for name, trajectory in (("estimate", estimate), ("reference", reference)):
        if not len(trajectory):
            raise InputError(f"the {name} has no pose; nothing to compare")
    few, many = (estimate, reference) if len(estimate) <= len(reference) else (reference, estimate)
    partner, difference_ns = nearest(few.stamps_ns, many.stamps_ns)
    numbers = np.arange(len(few))
    close = difference_ns <= round(limit_s * 1e9)
    best = np.lexsort((numbers, difference_ns, partner))
    first = np.append(True, np.diff(partner[best]) != 0)
    keep = np.zeros(len(few), np.bool_)
    keep[best[first]] = True
    keep &= close
    chosen = np.stack([numbers[keep], partner[keep]], axis=1)
    indices = chosen if few is estimate else chosen[:, ::-1]
    indices = indices[np.argsort(indices[:, 0], kind="stable")]
    if not len(indices):
        raise InputError(_no_pairs(estimate, reference, limit_s))
    return Pairs(
        stamps_ns=estimate.stamps_ns[indices[:, 0]],
        estimate=lie.lift(estimate.poses[indices[:, 0]]),
        reference=lie.lift(reference.poses[indices[:, 1]]),
        indices=indices,
        estimate_count=len(estimate),
        reference_count=len(reference),
        limit_s=limit_s,
    )


def nearest(
    wanted_ns: NDArray[np.int64], stamps_ns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Index of the stamp nearest each wanted one, and the distance in ns.

    Of equal stamps the first in the given order is taken, of two equally far ones the earlier.
    """
    order = np.argsort(stamps_ns, kind="stable")
    ordered = stamps_ns[order]
    after = np.searchsorted(ordered, wanted_ns, side="left")
    upper = np.minimum(after, len(ordered) - 1)
    before = np.maximum(after - 1, 0)
    lower = np.searchsorted(ordered, ordered[before], side="left")
    to_upper, to_lower = np.abs(ordered[upper] - wanted_ns), np.abs(ordered[lower] - wanted_ns)
    chosen = np.where(to_lower <= to_upper, lower, upper)
    return order[chosen], np.minimum(to_lower, to_upper)


def _no_pairs(estimate: Trajectory, reference: Trajectory, limit_s: float) -> str:
    spans = [
        f"{trajectory.stamps_ns.min() / 1e9:.3f} to {trajectory.stamps_ns.max() / 1e9:.3f} s"
        for trajectory in (estimate, reference)
    ]
    return (
        f"no pose of the estimate ({spans[0]}) lies within {limit_s:g} s of one of the reference ({spans[1]}); "
        "check that both keep the same clock, or allow a larger difference"
    )
