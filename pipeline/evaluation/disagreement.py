"""How far several odometries of one log are from each other, where there is no ground truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix


def disagreement(trajectories: Sequence[Matrix]) -> NDArray[np.float64]:
    """(M, M) meters: median over the scans of the distance between the motions that two methods find for a scan.

    trajectories : M times poses (N, d+1, d+1) of the same scans, (0, d+1, d+1) of a method that has failed
    NaN where one of the two has failed.
    """
    motions = [lie.between(poses[:-1], poses[1:]) for poses in trajectories]
    result = np.full((len(motions), len(motions)), np.nan)
    for row, first in enumerate(motions):
        for column, second in enumerate(motions):
            if len(first) and len(second):
                error = lie.between(first, second)
                result[row, column] = float(np.median(np.linalg.norm(error[:, :-1, -1], axis=1)))
    return result
