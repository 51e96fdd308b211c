"""All places seen so far, to be asked for those that look alike."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain.data import Matrix
from scanchain.loops.place import Place

_GROWTH = 1.25  # of the number of places, before the tree is built anew
_SLACK = 16  # places that may wait outside the tree in any case


class Gallery:
    """Places by their keys, in a tree that is built anew as they become more; those since then are tried in turn.

    To build it again and again takes but a few times as long as to build the last one.
    """

    def __init__(self) -> None:
        self.places: list[Place] = []
        self.waiting: deque[tuple[float, Place]] = deque()
        self.tree: KDTree | None = None
        self.planted = 0

    def add(self, place: Place, traveled_m: float) -> None:
        """Keep a place for later; it was passed after so many meters."""
        self.waiting.append((traveled_m, place))

    def alike(self, place: Place, count: int, before_m: float) -> list[Place]:
        """The places with the most similar keys, of those passed before; what was asked for may only grow."""
        while self.waiting and self.waiting[0][0] <= before_m:
            self.places.append(self.waiting.popleft()[1])
        if len(self.places) > _GROWTH * self.planted + _SLACK:
            self.tree = KDTree([each.key for each in self.places])
            self.planted = len(self.places)
        found = list(range(self.planted, len(self.places)))
        if self.tree is not None:
            found += np.atleast_1d(self.tree.query(place.key, min(count, self.planted))[1]).tolist()
        distance = [_square(self.places[index].key - place.key) for index in found]
        return [self.places[found[rank]] for rank in np.argsort(distance, kind="stable")[:count]]

    def nearest(self, T_world_keyframes: Matrix, position: NDArray[np.float64], count: int) -> list[Place]:
        """The places nearest to a position (3,) in the world, of those that ``alike`` was last asked about."""
        anchors = [place.anchor for place in self.places]
        distance_m = np.linalg.norm(T_world_keyframes[anchors, :3, 3] - position, axis=1)
        return [self.places[index] for index in np.argsort(distance_m, kind="stable")[:count]]


def _square(v: NDArray[np.float32]) -> float:
    return float(v @ v)
