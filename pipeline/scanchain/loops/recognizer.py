"""Place recognition: the protocol of recognizers, and loop closures from their verified proposals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scanchain import lie, plugins
from scanchain.config import Config
from scanchain.data import Closure, ClosureVerdict, Keyframe, Matrix, Pose, Problem, Proposal
from scanchain.errors import InputError, shown
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.submaps import RADII_BEHIND, Submap, VoxelSubmaps, submap_around
from scanchain.loops.verification import Verification, Verifier

RECOGNIZERS = {"outline": "scanchain.loops.upright_search:OutlineRecognizer"}
PLACE_DRIFT = 0.1  # largest error of the position by odometry, as a share of the path between
_PLACE_SIGMAS = 3.0  # the same in standard deviations of the prediction by the graph, where these allow more
_SPACING = 1.0 / 3.0  # radii of a submap between the anchors of two submaps along the path


@dataclass(frozen=True, slots=True)
class Query:
    """The keyframe to recognize, with its submap and its expected pose.

    submap : around the keyframe, its ``anchor``; the one that was added last
    max_traveled_m : candidates have at most this ``traveled_m``, so that no scan belongs to both submaps
    T_world_anchor : (d+1, d+1) expected pose of the anchor
    keyframes : all so far, by index
    T_world : (K, d+1, d+1) their best known poses
    """

    submap: Submap
    max_traveled_m: float
    T_world_anchor: Pose
    keyframes: Sequence[Keyframe]
    T_world: Matrix


@dataclass(frozen=True, slots=True)
class Candidate:
    """An older keyframe whose surroundings the queried one may revisit.

    target : index of the older keyframe
    T_target_source : (d+1, d+1) initial pose of the queried keyframe in the target's frame, which verification
        refines; it converges from about two voxels or 10° off
    score : similarity, comparable between candidates of one recognizer; the larger the better
    proposed_by : appearance alone (``PLACE``) or together with the expected pose (``POSITION``); the latter is not
        tried where the target lies in another segment than the queried keyframe
    rival : keyframe elsewhere that is as similar, which makes the candidate ambiguous, or −1
    """

    target: int
    T_target_source: Pose
    score: float
    proposed_by: Proposal = Proposal.PLACE
    rival: int = -1


class Recognizer(Protocol):
    """Database of submaps that proposes which of them a new one revisits.

    A checkpoint does not hold it: a resumed run makes a new one from its name and adds the same submaps again, in
    the same order. It reaches the same result if ``query`` changes nothing that a later result depends on.
    """

    def __init__(self, config: Config, dimension: int) -> None:
        """``dimension`` is 2 or 3."""
        ...

    def add(self, submap: Submap) -> None:
        """Store a submap by its anchor; called once each, in the order of the log."""
        ...

    def query(self, query: Query) -> Sequence[Candidate]:
        """Candidates for the submap added last, verified in this order until one is accepted."""
        ...


def create_recognizer(config: Config, dimension: int) -> Recognizer | None:
    """The recognizer that ``loops.recognizer`` names; None where place recognition is off.

    Raises InputError for a name that is neither in the registry nor a class that can be loaded.
    """
    name = config.loops.recognizer
    if name == "auto":
        name = "outline" if dimension == 3 else "none"
    if name == "none" or not config.loops.enabled:
        return None
    if name not in RECOGNIZERS and ":" not in name:
        known = ", ".join(("auto", "none", *RECOGNIZERS))
        raise InputError(f"loops.recognizer is {name!r}; it must be one of {known}, or module:Class for your own")
    return plugins.load(RECOGNIZERS.get(name, name), "add", "query")(config, dimension)


class PlaceCloser:
    """Loop closures from the recognizer, which is queried for one of every few keyframes.

    A submap is complete once the lidar has moved on by its radius.
    """

    def __init__(self, config: Config, dimension: int, submaps: VoxelSubmaps, verifier: Verifier) -> None:
        """Scans are aligned to the ``submaps`` in 2D; in 3D two submaps are aligned."""
        self.config = config
        self.dimension = dimension
        self.submaps = submaps
        self.segments = submaps.segments
        self.verifier = verifier
        self.recognizer = create_recognizer(config, dimension)
        self.added: list[int] = []
        self.examined = 0
        self.next_m = 0.0
        self.last: Closure | None = None

    def add_map(self, keyframes: Sequence[Keyframe], *, are_added: bool = True) -> float:
        """Start after the keyframes of a map; returns the path, in meters, beyond which all are candidates.

        are_added : whether the submaps of the map are added to the recognizer
        """
        if self.recognizer is not None and are_added:
            for anchor in self._anchors(keyframes, finish=True):
                self.recognizer.add(self._submap(anchor, keyframes))
                self.added.append(anchor.index)
        self.examined = len(keyframes)
        last, limits = keyframes[-1], self.config.loops
        apart_m = max((RADII_BEHIND + 1.0) * self._radius_m(last), limits.min_travel_m)
        self.next_m = last.traveled_m + 2.0 * apart_m
        return self.next_m

    def skip(self, keyframes: Sequence[Keyframe]) -> None:
        """Make no submaps around the keyframes so far."""
        self.examined = len(keyframes)

    def close(
        self,
        keyframes: Sequence[Keyframe],
        graph: PoseGraph,
        connected: NDArray[np.bool_],
        *,
        finish: bool = False,
    ) -> tuple[Closure, ...]:
        """Closures of the submaps that are complete by now, accepted or not; with ``finish``, of all others, too.

        keyframes : all so far; graph : their best known poses, with covariances
        connected : (K,) keyframes in the component of the newest
        """
        recognizer = self._recognizer(keyframes)
        if recognizer is None:
            return ()
        closures: list[Closure] = []
        for anchor in self._anchors(keyframes, finish):
            closures += self._closures(recognizer, anchor, keyframes, graph, connected)
        return tuple(closures)

    def _recognizer(self, keyframes: Sequence[Keyframe]) -> Recognizer | None:
        """The recognizer; after a checkpoint, which does not hold it, a new one with the same submaps."""
        if self.recognizer is None:
            self.recognizer = create_recognizer(self.config, self.dimension)
            if self.recognizer is not None:
                for index in self.added:
                    self.recognizer.add(self._submap(keyframes[index], keyframes))
        return self.recognizer

    def _anchors(self, keyframes: Sequence[Keyframe], finish: bool) -> Iterator[Keyframe]:
        """Keyframes that submaps are made around, each once."""
        while self.examined < len(keyframes):
            keyframe = keyframes[self.examined]
            radius_m = self._radius_m(keyframe)
            if keyframes[-1].traveled_m < keyframe.traveled_m + radius_m and not finish:
                return
            self.examined += 1
            if keyframe.traveled_m >= self.next_m:
                self.next_m = keyframe.traveled_m + _SPACING * radius_m
                yield keyframe

    def _closures(
        self,
        recognizer: Recognizer,
        anchor: Keyframe,
        keyframes: Sequence[Keyframe],
        graph: PoseGraph,
        connected: NDArray[np.bool_],
    ) -> Iterator[Closure]:
        """Closures of the candidates, up to the first one that is accepted."""
        submap, T_world = self._submap(anchor, keyframes), graph.poses
        recognizer.add(submap)
        self.added.append(anchor.index)
        apart_m = max((RADII_BEHIND + 1.0) * submap.radius_m, self.config.loops.min_travel_m)
        T_expected = self._expected(anchor, keyframes, T_world)
        query = Query(submap, anchor.traveled_m - apart_m, T_expected, keyframes, T_world)
        candidates = recognizer.query(query)
        if not isinstance(candidates, Iterable):
            raise InputError(f"{self._named}: query returned {shown(candidates)}; wanted a list of candidates")
        for candidate in candidates:
            self._check(candidate, query)
            is_connected = bool(connected[candidate.target] == connected[anchor.index])
            if not is_connected and candidate.proposed_by is Proposal.POSITION:
                continue
            verified = self._verify(submap, candidate, keyframes)
            problem = self._problem(candidate, verified, query, graph if is_connected else None)
            closure = verified.closure(candidate.target, anchor.index, candidate.proposed_by, problem=problem)
            yield closure
            if closure.verdict is ClosureVerdict.ACCEPTED:
                self.last = closure
                return

    def _submap(self, anchor: Keyframe, keyframes: Sequence[Keyframe]) -> Submap:
        return submap_around(keyframes, anchor.index, self._radius_m(anchor), self.segments)

    def _radius_m(self, anchor: Keyframe) -> float:
        return self.config.loops.place_radius_m * anchor.scale

    def _expected(self, anchor: Keyframe, keyframes: Sequence[Keyframe], T_world: Matrix) -> Pose:
        """T_world_anchor by odometry since the last closure, which may not have corrected the graph yet."""
        if self.last is None:
            return T_world[anchor.index]
        T_last_anchor = lie.between(keyframes[self.last.source].T_odom_lidar, anchor.T_odom_lidar)
        return T_world[self.last.target] @ self.last.match.T_target_source @ T_last_anchor

    @property
    def _named(self) -> str:
        return f"loops.recognizer {self.config.loops.recognizer}"

    def _check(self, candidate: Candidate, query: Query) -> None:
        """Raise InputError for an object that is no candidate, or a candidate out of range."""
        if not isinstance(candidate, Candidate):
            raise InputError(
                f"{self._named}: query returned {shown(candidate)} among its candidates; wanted "
                "scanchain.loops.recognizer.Candidate"
            )
        target = candidate.target
        is_old = 0 <= target < len(query.keyframes) and query.keyframes[target].traveled_m <= query.max_traveled_m
        if not is_old:
            raise InputError(
                f"{self._named}: candidate {target} for keyframe {query.submap.anchor.index} is not "
                "older; wanted one whose traveled_m is at most query.max_traveled_m"
            )
        T, size = np.asarray(candidate.T_target_source), self.dimension + 1
        if T.shape != (size, size) or not np.isfinite(T).all():
            raise InputError(
                f"{self._named}: T_target_source of candidate {target} has the shape {T.shape}; wanted "
                f"a finite pose ({size}, {size})"
            )

    def _verify(self, source: Submap, candidate: Candidate, keyframes: Sequence[Keyframe]) -> Verification:
        T_first = candidate.T_target_source
        if self.dimension == 2:
            voxels = self.submaps.around(candidate.target, keyframes, len(keyframes) - 1)
            return self.verifier.scan(source.anchor, voxels, T_first, alone=True)
        target = submap_around(keyframes, candidate.target, source.radius_m, self.segments)
        return self.verifier.submap(source, target, T_first)

    def _problem(
        self, candidate: Candidate, verified: Verification, query: Query, graph: PoseGraph | None
    ) -> Problem | None:
        """Why an aligned candidate is rejected, None if it is accepted.

        graph : None between unconnected keyframes, whose distance by odometry is meaningless
        """
        limits, anchor = self.config.loops, query.submap.anchor
        if candidate.rival >= 0:
            return Problem("another keyframe is as similar", f"keyframe {candidate.rival} is as similar")
        if graph is None or verified.problem:
            return None
        T_world_i, T_world_j = query.T_world[candidate.target], query.T_world[anchor.index]
        moved = lie.inverse(T_world_j) @ T_world_i @ verified.match.T_target_source
        moved_m = float(np.linalg.norm(moved[:-1, -1]))
        traveled_m = anchor.traveled_m - query.keyframes[candidate.target].traveled_m
        if moved_m <= max(PLACE_DRIFT * traveled_m, limits.min_radius_m):
            return None
        d = self.dimension
        covariance = graph.relative_covariance(candidate.target, anchor.index)[:d, :d]
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        if moved_m <= _PLACE_SIGMAS * sigma_m:
            return None
        return Problem(
            "far from the prediction",
            f"{moved_m:.1f} m from the prediction, more than {100.0 * PLACE_DRIFT:g} % of the path between and "
            f"more than {_PLACE_SIGMAS:g} standard deviations ({sigma_m:.1f} m)",
        )
