"""Expected error of a trajectory, from the uncertainty of its pose graph."""

from __future__ import annotations

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from scanchain.graph.between import turns
from scanchain.graph.pose_graph import PoseGraph

_SAMPLES = 200
_BOUNDS = (2.5, 97.5)  # percentiles


class ExpectedError(Struct, frozen=True):
    """Mean of an error, and the bounds that contain it with a probability of 95 %; meters."""

    mean: float
    low: float
    high: float

    @property
    def text(self) -> str:
        """The mean and the bounds."""
        return f"{self.mean:.3f} m ({self.low:.3f} to {self.high:.3f} with 95 %)"


def expected_ate(graph: PoseGraph, scans: NDArray[np.int64] | None = None) -> ExpectedError:
    """ATE (rmse after rigid alignment) of the poses of a graph, if the covariances of its edges are right.

    The distribution is that of samples of the position errors δ. To first order the alignment takes from them what
    one twist of all positions explains:
        ATE² = min over ξ of Σ wᵢ ‖δᵢ − ρ − φ × tᵢ‖² / Σ wᵢ
    scans : (K,) wᵢ, number of scans that each pose stands for, 1 where left out
    Raises InputError where the edges leave poses free.
    """
    errors, positions = graph.position_errors(_SAMPLES), graph.poses[:, :-1, -1]
    count, d = positions.shape
    weight = np.ones(count) if scans is None else scans.astype(np.float64)
    lever = turns(positions - positions.mean(axis=0))
    rigid = np.concatenate([np.broadcast_to(np.eye(d), (count, d, d)), lever], axis=2)
    root = np.sqrt(weight / weight.sum())[:, None, None]
    A, B = (root * rigid).reshape(count * d, -1), (root * errors.transpose(1, 2, 0)).reshape(count * d, -1)
    left = B - A @ np.linalg.lstsq(A, B)[0]
    ates_m = np.linalg.norm(left, axis=0)
    low, high = np.percentile(ates_m, _BOUNDS).tolist()
    return ExpectedError(float(ates_m.mean()), low, high)
