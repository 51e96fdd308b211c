"""The recognizer for 3D logs: a database of descriptors, searched by similarity and near the expected pose."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.config import Config, LoopsConfig
from scanchain.data import Matrix, Pose, Proposal
from scanchain.errors import InputError
from scanchain.loops.descriptor import Alignment, Descriptor, compare, describe, level_frame
from scanchain.loops.recognizer import Candidate, Query
from scanchain.loops.submaps import Submap

_MAX_COMPARED = 10  # number of descriptors with the most similar keys that are compared in full
_MAX_NEAREST = 3  # number of descriptors nearest to the expected pose that are compared in full
_MAX_HEADING_ERROR_RAD = 0.5  # largest error of odometry's heading in the search near the expected pose
_MIN_SIMILARITY = 0.45  # least similarity of a candidate that is verified by matching
_RIVAL = 0.9  # share of the best similarity, from which on a candidate elsewhere makes it ambiguous
_MIN_APART = 0.25  # least distance in radii of a submap between two poses that are not the same
_GROWTH = 1.25  # factor by which the database grows between two builds of its tree
_SLACK = 16  # number of descriptors that may lie outside the tree however small it is


class DescriptorRecognizer:
    """Proposes the most similar submap, and the most similar of those near the expected pose.

    Submaps are compared with those of the same voxel scale only.
    """

    def __init__(self, config: Config, dimension: int) -> None:
        if dimension != 3:
            raise InputError("loops.recognizer descriptor is for 3D logs; leave it at auto in a 2D log")
        self.config = config
        self.databases: dict[float, DescriptorDatabase] = {}
        self.newest: Descriptor | None = None

    def add(self, submap: Submap) -> None:
        """Describe a submap and keep its descriptor."""
        self.newest = describe(submap, level_frame(submap.anchor, self.config.local_map))
        database = self.databases.setdefault(submap.anchor.scale, DescriptorDatabase())
        database.add(self.newest, submap.anchor.traveled_m)

    def query(self, query: Query) -> list[Candidate]:
        """At most two candidates: the most similar submap, and the most similar one near the expected pose."""
        descriptor, database = self.newest, self.databases[query.submap.anchor.scale]
        assert descriptor is not None and descriptor.anchor == query.submap.anchor.index
        similar = database.most_similar(descriptor, _MAX_COMPARED, query.max_traveled_m)
        if not similar:
            return []
        best = self._best(descriptor, similar, query)
        candidates = [best] if best.score >= _MIN_SIMILARITY else []
        near = database.nearest(query.T_world, query.T_world_anchor[:3, 3], _MAX_NEAREST)
        return candidates + self._best_nearby(descriptor, near, query)

    def _best(self, descriptor: Descriptor, similar: Sequence[Descriptor], query: Query) -> Candidate:
        """The most similar of several descriptors, ambiguous where another one contradicts it.

        Two at the same position, up to the possible drift of the map between them, do not contradict.
        """
        ranked = sorted(
            ((compare(descriptor, other), other.anchor) for other in similar), key=lambda each: -each[0].similarity
        )
        best, target = ranked[0]
        position = _position(query.T_world, target, best)
        rival = -1
        for alignment, other in ranked[1:]:
            if alignment.similarity < _RIVAL * best.similarity:
                break
            between_m = abs(query.keyframes[other].traveled_m - query.keyframes[target].traveled_m)
            apart_m = float(np.linalg.norm(_position(query.T_world, other, alignment) - position))
            if apart_m > max(_MIN_APART * query.submap.radius_m, self.config.loops.drift * between_m):
                rival = other
                break
        return Candidate(target, best.T_target_source, best.similarity, Proposal.PLACE, rival)

    def _best_nearby(self, descriptor: Descriptor, near: Sequence[Descriptor], query: Query) -> list[Candidate]:
        """The most similar of the nearest descriptors that align close to the expected pose, if any does."""
        found: list[Candidate] = []
        for other in near:
            T_expected = (
                lie.inverse(query.T_world[other.anchor] @ other.T_anchor_level)
                @ query.T_world_anchor
                @ descriptor.T_anchor_level
            )
            alignment = compare(
                descriptor, other, expected_rad=_yaw(T_expected), within_rad=_MAX_HEADING_ERROR_RAD
            )
            position = _position(query.T_world, other.anchor, alignment)
            moved_m = np.linalg.norm(position - query.T_world_anchor[:3, 3])
            traveled_m = query.submap.anchor.traveled_m - query.keyframes[other.anchor].traveled_m
            if moved_m <= search_radius_m(self.config.loops, traveled_m):
                found.append(
                    Candidate(other.anchor, alignment.T_target_source, alignment.similarity, Proposal.POSITION)
                )
        return sorted(found, key=lambda each: -each.score)[:1]


class DescriptorDatabase:
    """Descriptors by their keys, in a k-d tree that is rebuilt as they become more; the rest is searched linearly.

    All rebuilds together take but a few times as long as the last one.
    """

    def __init__(self) -> None:
        self.descriptors: list[Descriptor] = []
        self.waiting: deque[tuple[float, Descriptor]] = deque()
        self.tree: KDTree | None = None
        self.in_tree = 0

    def add(self, descriptor: Descriptor, traveled_m: float) -> None:
        """Keep a descriptor for later; its anchor was passed after so many meters."""
        self.waiting.append((traveled_m, descriptor))

    def most_similar(self, descriptor: Descriptor, count: int, max_traveled_m: float) -> list[Descriptor]:
        """Those with the most similar keys, passed after at most so many meters; that limit may only grow."""
        while self.waiting and self.waiting[0][0] <= max_traveled_m:
            self.descriptors.append(self.waiting.popleft()[1])
        if len(self.descriptors) > _GROWTH * self.in_tree + _SLACK:
            self.tree = KDTree([each.key for each in self.descriptors])
            self.in_tree = len(self.descriptors)
        found = list(range(self.in_tree, len(self.descriptors)))
        if self.tree is not None:
            found += np.atleast_1d(self.tree.query(descriptor.key, min(count, self.in_tree))[1]).tolist()
        distance = [_square(self.descriptors[index].key - descriptor.key) for index in found]
        return [self.descriptors[found[rank]] for rank in np.argsort(distance, kind="stable")[:count]]

    def nearest(self, T_world: Matrix, position: NDArray[np.float64], count: int) -> list[Descriptor]:
        """Those nearest to a position (3,) in the world, of those that ``most_similar`` last searched."""
        anchors = [descriptor.anchor for descriptor in self.descriptors]
        distance_m = np.linalg.norm(T_world[anchors, :3, 3] - position, axis=1)
        return [self.descriptors[index] for index in np.argsort(distance_m, kind="stable")[:count]]


def search_radius_m(config: LoopsConfig, traveled_m: float) -> float:
    """Radius of the search around the expected pose, for a loop of so many meters."""
    return float(np.clip(config.drift * traveled_m, config.min_radius_m, config.max_radius_m))


def _position(T_world: Matrix, target: int, alignment: Alignment) -> Matrix:
    """Position (3,) of the source in the world."""
    return (T_world[target] @ alignment.T_target_source)[:3, 3]


def _yaw(T: Pose) -> float:
    return float(np.arctan2(T[1, 0], T[0, 0]))


def _square(v: NDArray[np.float32]) -> float:
    return float(v @ v)
