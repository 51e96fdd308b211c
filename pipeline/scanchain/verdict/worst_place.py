"""The place where a trajectory is contradicted most."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scanchain.verdict.checks import Floats
from scanchain.verdict.stretches import Evidence, Kind, Stretch

_SHORT_M = 10.0  # largest path of a stretch that is shown by what lies before and behind it


class WorstPlace(NamedTuple):
    """The worst stretch, and two scans of the same place: before and after the contradiction, or of two passes."""

    stretch: Stretch
    before: int
    after: int


def worst_place(stretches: Sequence[Stretch], evidence: Evidence) -> WorstPlace | None:
    """The stretch of the largest contradiction, of equal ones that of most scans; None without any.

    Of a long one that no loop closures contradict, the scan that its check contradicts most, and the one before.
    """
    stretch = max(stretches, key=lambda each: (each.size_m or 0.0, each.scans), default=None)
    if stretch is None:
        return None
    first, last = max(stretch.first - 1, 0), stretch.last
    if stretch.kind is Kind.LOOPS:
        return WorstPlace(stretch, stretch.first, stretch.last)
    steps_m = np.linalg.norm(np.diff(evidence.poses[first : last + 1, :-1, -1], axis=0), axis=1)
    if steps_m.sum() > _SHORT_M:
        last = max(stretch.first + int(np.argmax(_contradiction(evidence, stretch))), 1)
        first = last - 1
    return WorstPlace(stretch, first, last)


def _contradiction(evidence: Evidence, stretch: Stretch) -> Floats:
    """Size of the contradiction at each scan of a stretch; the length of the step where no check measures it."""
    part = slice(stretch.first, stretch.last + 1)
    if stretch.kind is Kind.WHEELS:
        return np.nan_to_num(evidence.wheels.innovation[part])
    if stretch.kind is Kind.ACCELERATION:
        return np.nan_to_num(evidence.velocity[part])
    if stretch.kind is Kind.CONTRADICTED:
        return 1.0 - np.nan_to_num(evidence.fit[part], nan=1.0)
    if stretch.kind is Kind.OVERLAP:
        return 1.0 - np.nan_to_num(evidence.overlap[part], nan=1.0)
    steps_m = np.linalg.norm(np.diff(evidence.poses[:, :-1, -1], axis=0), axis=1)
    return np.concatenate([[0.0], steps_m])[part]
