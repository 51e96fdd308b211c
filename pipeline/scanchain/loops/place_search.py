"""Search for the newest keyframes in a map, or in older segments of a log, until they are joined to it."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Closure, ClosureVerdict, Keyframe, Matrix, Pose
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.connectivity import Segments
from scanchain.registration.search import Found, Search

_BACKOFF = 0.2  # path between two searches, as a share of the path searched without result
_TRACKED_M = 20.0  # path since the last match with the map, up to which it is not searched

Map = TypeVar("Map")  # older keyframes, preprocessed for a search
Result = TypeVar("Result")
Underway = Generator[None, None, Sequence[Closure]]


class Finder(Protocol[Map]):
    """Search for keyframes of a path among older ones, in the plane or in space.

    first_m, least_m, most_m : path of a segment before its first search, and least and largest between two
    match_m : path between two matches with a map that a log is tracked in, at full scale
    searches, ambiguous : numbers of searches so far, and of those whose result was ambiguous
    """

    first_m: float
    least_m: float
    most_m: float
    match_m: float
    searches: int
    ambiguous: int

    def draw(self, keyframes: Sequence[Keyframe], folder: Path | None = None) -> Map:
        """Preprocess older keyframes, whose ``T_odom_lidar`` is T_world_lidar; a map's folder may cache it."""
        ...

    def find(self, keyframes: Sequence[Keyframe], start: int, target: Map) -> Underway:
        """Closures of the newest keyframes, of the segment from ``start`` on, with preprocessed older ones.

        Yields when the work for one scan is done: by counts and not by the clock, so that results are the same on
        any machine.
        """
        ...


class PlaceSearch(Generic[Map]):
    """Schedule of searches for the newest segment in a map or in older segments, one after the other.

    In a large map a search is spread over several scans.
    """

    def __init__(self, finder: Finder[Map], segments: Segments) -> None:
        self.finder, self.segments = finder, segments
        self.of_map = 0  # number of the first keyframes that belong to a map
        self.turn = 0
        self.next_m = 0.0
        self.matched_m = -math.inf  # path up to the last match with a map that the log is tracked in
        self.underway: Underway | None = None
        self.drawn: dict[bool, tuple[Matrix, Map]] = {}  # poses, preprocessed: of the map, of the last others

    def add_map(self, keyframes: Sequence[Keyframe], folder: Path | None) -> None:
        """Add the keyframes of a map, and preprocess them before the first search."""
        self.of_map = len(keyframes)
        T_world = np.array([each.T_odom_lidar for each in keyframes])
        self.drawn[True] = T_world, self.finder.draw(keyframes, folder)

    def search_again(self) -> None:
        """Forget the last match: the newest segment is not there, or has just begun."""
        self.matched_m = -math.inf

    def has_just_matched(self, keyframes: Sequence[Keyframe]) -> bool:
        """True while the last match with the map is so recent that no other one is due."""
        return self._since_m(keyframes) < self.finder.match_m * keyframes[-1].scale

    def is_tracking(self, keyframes: Sequence[Keyframe]) -> bool:
        """True while the last match with the map is recent."""
        return self._since_m(keyframes) <= _TRACKED_M

    def record(self, keyframes: Sequence[Keyframe], closures: Sequence[Closure]) -> None:
        """Record whether the newest keyframe, which has these closures, matches the map."""
        accepted = (each for each in closures if each.verdict is ClosureVerdict.ACCEPTED)
        if any(each.target < self.of_map for each in accepted):
            self.matched_m = keyframes[-1].traveled_m

    def skip(self) -> None:
        """Cancel the search in progress, if any: the newest keyframe matches the map."""
        self.underway = None

    def close(
        self, keyframes: Sequence[Keyframe], graph: PoseGraph, components: NDArray[np.int64]
    ) -> tuple[Closure, ...]:
        """Closures by a search for the newest keyframe, if one is due.

        components : (K,) of ``Segments.components``
        """
        newest, start = keyframes[-1], self.segments.starts[-1]
        if newest.index == start:
            self.underway, self.next_m = None, newest.traveled_m + self.finder.first_m
        old = self._search_targets(components, keyframes)
        if not len(old):
            self.underway = None
        if not len(old) or self.underway is not None or newest.traveled_m < self.next_m:
            return ()
        is_joined = components[-1] == components[old[0]]
        begun_m = self.matched_m if is_joined else keyframes[start].traveled_m
        step_m = max(_BACKOFF * (newest.traveled_m - begun_m), self.finder.least_m)
        self.next_m = newest.traveled_m + min(step_m, self.finder.most_m)
        self.turn += 1
        target = self._preprocessed(old, keyframes, graph.poses[old])
        self.underway = self.finder.find(keyframes[: newest.index + 1], start, target)
        return self.advance()

    def advance(self) -> tuple[Closure, ...]:
        """Continue the search in progress by the work for one scan; returns its closures once it is done."""
        if self.underway is None:
            return ()
        try:
            next(self.underway)
        except StopIteration as over:
            self.underway = None
            return tuple(over.value)
        return ()

    def finish(self) -> tuple[Closure, ...]:
        """Complete the search in progress, if any."""
        underway, self.underway = self.underway, None
        return () if underway is None else tuple(completed(underway))

    def _search_targets(self, components: NDArray[np.int64], keyframes: Sequence[Keyframe]) -> NDArray[np.int64]:
        """Keyframes to search for the newest: those of one of the components that they are not joined to.

        Components take turns: two may show the same location. Keyframes that are joined to all others but have not
        matched the map for a while are searched for in it again: they may have been joined at a wrong pose.
        """
        unknown = np.flatnonzero(components != components[-1])
        if not len(unknown):
            return np.arange(0 if self.is_tracking(keyframes) else self.of_map)
        numbers = np.unique(components[unknown])
        return unknown[components[unknown] == numbers[self.turn % len(numbers)]]

    def _preprocessed(self, old: NDArray[np.int64], keyframes: Sequence[Keyframe], T_world: Matrix) -> Map:
        """Older keyframes, preprocessed at these poses; cached as long as the poses stay the same."""
        for T_drawn, target in self.drawn.values():
            if np.array_equal(T_drawn, T_world):
                return target
        placed = [replace(keyframes[k], T_odom_lidar=T) for k, T in zip(old.tolist(), T_world, strict=True)]
        self.drawn[False] = T_world, self.finder.draw(placed)
        return self.drawn[False][1]

    def _since_m(self, keyframes: Sequence[Keyframe]) -> float:
        return keyframes[-1].traveled_m - self.matched_m


def candidates(
    search: Search, refine: Callable[[Pose], Sequence[Found]]
) -> Generator[None, None, Sequence[Found]]:
    """The poses that a search finds, each refined, the best first; yields after slices of equal work."""
    search.advance()
    while not search.is_done:
        yield
        search.advance()
    refined = [fit for each in search.poses() for fit in refine(each.T_target_source)]
    return sorted(refined, key=lambda each: -each.share)


def completed(underway: Generator[None, None, Result]) -> Result:
    """The result of a search that is completed at once."""
    while True:
        try:
            next(underway)
        except StopIteration as over:
            return over.value
