"""Expected error of a trajectory, from the uncertainty of its pose graph."""

from __future__ import annotations

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from scanchain.graph.between import turns
from scanchain.graph.pose_graph import PoseGraph

_BATCHES, _BATCH = 50, 10  # of samples, which together would fill the memory
_BOUNDS = (2.5, 97.5)  # percentiles
_RANK_TOLERANCE = 1e-9  # of the largest singular value, below which positions leave a rotation free


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
    positions = graph.poses[:, :-1, -1]
    count, d = positions.shape
    weight = np.ones(count) if scans is None else scans.astype(np.float64)
    root = np.sqrt(weight / weight.sum())[:, None]
    moved = np.concatenate(
        [np.broadcast_to(np.eye(d), (count, d, d)), turns(positions - positions.mean(axis=0))], axis=2
    )
    basis, size, _ = np.linalg.svd((root[..., None] * moved).reshape(count * d, -1), full_matrices=False)
    basis = basis[:, size > _RANK_TOLERANCE * size[0]]
    ates_m = []
    for seed in range(_BATCHES):
        weighted = (root * graph.position_errors(_BATCH, seed)).reshape(_BATCH, -1)
        ates_m.extend(np.linalg.norm(weighted - weighted @ basis @ basis.T, axis=1).tolist())
    low, high = np.percentile(ates_m, _BOUNDS).tolist()
    return ExpectedError(float(np.mean(ates_m)), low, high)
