"""The town without parked cars: its streets are driven twice, in the same and the opposite direction and lane."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from scanchain.data import Matrix
from scanchain.simulation.solids import Solids
from scanchain.simulation.worlds import town

CAR = replace(town.CAR, corner_m=4.0)  # tighter bends, so that it keeps its lane

_LANE_M = 2.0  # from the middle of the street, to the right
_FREE_M = 1.8  # on either side of the middle of a lane

# Crossings in the order they are passed, and the lane taken from there: 1 is the right one, −1 the left one.
_WAY = (
    ((0, 0), 1), ((100, 0), 1), ((100, 40), 1), ((0, 40), 1),  # new
    ((0, 0), 1), ((0, -40), 1), ((-50, -40), 1), ((-50, 40), 1),  # new
    ((0, 40), 1), ((100, 40), 1), ((100, 0), 1),  # the first block again, the other way round
    ((0, 0), 1), ((0, 40), 1), ((0, 80), 1), ((50, 80), 1), ((50, 40), 1),  # partly new
    ((50, 0), 1), ((100, 0), 1), ((100, 40), -1), ((0, 40), -1),  # as the first time, at last in the other lane
)  # fmt: skip


def rounds(rng: np.random.Generator) -> Solids:
    """The town, its kerbs empty and its hedges cut where they reach into the lanes."""
    solids = town.town(rng, parked=0.0)
    lanes = np.vstack([np.linspace(a, b, 100) for a, b in pairwise([*ROUTE, ROUTE[0]])])
    gap = np.abs(lanes[:, None] - solids.boxes[:, :2]) - solids.boxes[:, 2:4]
    distance_m = np.linalg.norm(np.maximum(gap, 0.0), axis=2).min(axis=0)
    return replace(solids, boxes=solids.boxes[distance_m > _FREE_M])


def _lanes() -> Matrix:
    """The route (W, 2): the lane of each street, and where it meets that of the next one."""
    legs = [*_WAY, _WAY[0]]
    lines = []
    for (start, lane), (end, _) in pairwise(legs):
        along = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
        lines.append((np.array(start) + lane * _LANE_M * np.array([along[1], -along[0]]), along))
    return np.array([_meeting(*lines[k - 1], *lines[k]) for k in range(len(lines))])


def _meeting(p: Matrix, u: Matrix, q: Matrix, v: Matrix) -> Matrix:
    """Where the lines p + s u and q + t v meet, or q where they run the same way."""
    cross = u[0] * v[1] - u[1] * v[0]
    if abs(cross) < 1e-9:
        return q
    d = q - p
    return p + (d[0] * v[1] - d[1] * v[0]) / cross * u


ROUTE = _lanes()
