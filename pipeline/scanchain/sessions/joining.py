"""Joining of maps in one frame: each is localized in those already joined, then all edges are optimized."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.config import Config
from scanchain.data import DOWNWEIGHTED, Closure, Keyframe, Matrix, Pose
from scanchain.errors import counted
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.connectivity import Segments
from scanchain.loops.evidence import SEARCHED_M, SequentialPlaceTest, compared
from scanchain.loops.planar_map_search import AGREE, PlanarMapSearch
from scanchain.loops.upright_search import MEMBERS, UprightMap
from scanchain.maps import Edges, SavedMap
from scanchain.placement import loop_information
from scanchain.sessions.alignment import align

_APART_M = 200.0  # path assumed between the last keyframe of a map and the first of the next: no submap has both
_CLEAR = 0.1  # share of a map's keyframes with a closure in force above which it joins before others are tried
_NEW_M = 5.0  # distance from older keyframes, at full scale, beyond which a keyframe is in a new area
_NEW_KEYFRAMES = 3  # least number of them for which maps that were not found are searched for again
_CHANGE = (0.025, 3.0)  # least share of contradictions that is reported, and its ratio to that within maps
_STEP_M = 2.0  # spacing of paths in 2D that are searched for as a whole
_AGREEING = 0.3  # least share of the keyframes of an agreeing path that agree
_MAX_PATHS = 200  # largest number of such paths; along longer sessions they lie farther apart
_SEARCHED = 8  # largest number of paths that are searched for elsewhere
MAX_REPEATED = 0.25  # largest share of the agreeing paths that may also fit other locations
_MIN_PATHS, _MIN_KEYFRAMES = 2, 5  # least numbers of agreeing paths, and of keyframes
_STORIES = 5.0  # log-odds required in 3D beyond the usual: stories of a building can be similar throughout
_SHORT = "they agree along a short path only"


@dataclass(frozen=True, slots=True)
class Joined:
    """One or several maps in one frame.

    maps : numbers of the maps, in the order in which they joined
    keyframes : of all of them in this order; ``T_odom_lidar`` is the pose in the common frame
    of_map : (K,) number of each keyframe's map
    edges : of the maps, and the closures between them, with their final robust weights
    closures : tried between maps, accepted by matching or not
    """

    maps: tuple[int, ...]
    keyframes: tuple[Keyframe, ...]
    of_map: NDArray[np.int64]
    edges: Edges
    closures: tuple[Closure, ...] = ()

    @classmethod
    def of(cls, number: int, maps: Sequence[SavedMap]) -> Joined:
        """A single one of several maps."""
        saved = maps[number]
        return cls((number,), saved.keyframes, np.full(len(saved.keyframes), number), saved.edges)

    @property
    def poses(self) -> Matrix:
        """(K, d+1, d+1) in the common frame."""
        return np.array([keyframe.T_odom_lidar for keyframe in self.keyframes])

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.keyframes[0].T_odom_lidar.shape[0] - 1

    @property
    def is_between(self) -> NDArray[np.bool_]:
        """True for edges (E,) between two maps."""
        ends = self.of_map[self.edges.pairs]
        return ends[:, 0] != ends[:, 1]

    def placed(self, poses: Matrix) -> Joined:
        """With the keyframes at other poses (K, d+1, d+1)."""
        moved = zip(self.keyframes, poses, strict=True)
        return replace(self, keyframes=tuple(replace(each, T_odom_lidar=pose) for each, pose in moved))


class UncertainJoin(msgspec.Struct, frozen=True):
    """A session that may belong to the frame of another one, but is not joined for lack of evidence.

    position_m, yaw_deg : of its first keyframe there
    reason : why it is not certain
    """

    session: str
    frame: str
    position_m: tuple[float, ...]
    yaw_deg: float
    reason: str

    @property
    def text(self) -> str:
        """The uncertain join as a clause."""
        position = ", ".join(f"{each:.1f}" for each in self.position_m)
        return (
            f"{self.session} might begin at ({position}) m, heading {self.yaw_deg:.0f} deg, in the frame of "
            f"{self.frame}; not certain: {self.reason}"
        )

    @classmethod
    def of(cls, session: str, frame: str, T_frame_session: Pose, reason: str) -> UncertainJoin:
        """The uncertain join of a session at a pose (d+1, d+1)."""
        T = T_frame_session
        position_m, yaw_deg = np.round(T[:-1, -1], 2), np.round(np.degrees(np.arctan2(T[1, 0], T[0, 0])), 1)
        return cls(session, frame, tuple(position_m.tolist()), float(yaw_deg), reason)


def join_all(
    maps: Sequence[SavedMap],
    order: Sequence[int],
    names: Sequence[str],
    config: Config,
    held: int,
    say: Callable[[str], None],
) -> tuple[list[Joined], list[UncertainJoin]]:
    """Groups of maps that belong together, each in the frame of its first map; and uncertain joins.

    Of the maps that are found in a group, the one with the largest overlap joins it. A map that is not found is
    searched for again once the group has grown into a new area.

    order : numbers of the maps; names : of their first sessions
    held : number of a map whose keyframes stay where they are, −1 for none
    """
    groups: list[Joined] = []
    uncertain: dict[int, UncertainJoin] = {}
    waiting = list(order)
    while waiting:
        world = Joined.of(waiting.pop(0), maps)
        searched = dict.fromkeys(waiting, 0)  # size of the world, in keyframes, when each was last not found in it
        joined: Joined | None = world
        while joined is not None:
            world, joined = joined, None
            old, trials = len(world.keyframes), dict[int, Joined]()
            due = [number for number in waiting if _has_grown(world, searched[number])]
            for number in sorted(due, key=lambda number: searched[number] > 0):
                say(f"{maps[number].name}: searching in a map of {old:,} keyframes")
                trial, searched[number] = join(world, Joined.of(number, maps), config, held), old
                if trial is not None:
                    trials[number] = trial
                    if _overlap(trial, old) > _CLEAR:
                        break
            for number, trial in sorted(trials.items(), key=lambda each: -_overlap(each[1], old)):
                if joined is not None:
                    searched[number] = 0
                elif reason := objection_to(trial, old, config):
                    uncertain[number] = UncertainJoin.of(
                        names[number], names[world.maps[0]], trial.poses[old], reason
                    )
                else:
                    joined = trial
                    waiting.remove(number)
                    uncertain.pop(number, None)
        groups.append(world)
    return groups, list(uncertain.values())


def _has_grown(world: Joined, before: int) -> bool:
    """True if several keyframes of the world are far from the first ``before`` ones, or there were none before."""
    positions, reach_m = world.poses[:, :-1, -1], _NEW_M * world.keyframes[0].scale
    away_m = KDTree(positions[:before]).query(positions[before:])[0]
    return bool((away_m > reach_m).sum() >= min(_NEW_KEYFRAMES, len(positions) - before) > 0)


def join(world: Joined, guest: Joined, config: Config, held: int = -1) -> Joined | None:
    """Both in the frame of the world, at the minimum of χ²; None if the guest is not found in it."""
    old = len(world.keyframes)
    with TemporaryDirectory() as folder:  # for what a search stores about the world
        target = SavedMap(Path(folder), world.dimension, world.keyframes, world.of_map, (), world.edges)
        found = align(target, guest.keyframes, guest.edges, config, is_final=False)
    accepted = found.accepted
    if not accepted:
        return None
    count, begin_m = len(accepted), world.keyframes[-1].traveled_m + _APART_M - guest.keyframes[0].traveled_m
    closed = Edges(
        np.array([(closure.target, closure.source) for closure in accepted], np.int64),
        np.array([closure.match.T_target_source for closure in accepted]),
        np.array([loop_information(closure, config.loops) for closure in accepted]),
        np.ones(count, np.bool_),
        np.ones(count),
    )
    moved = (
        replace(each, index=k, traveled_m=begin_m + each.traveled_m, T_odom_lidar=pose)
        for k, (each, pose) in enumerate(zip(guest.keyframes, found.poses, strict=True), old)
    )
    both = Joined(
        maps=world.maps + guest.maps,
        keyframes=(*world.keyframes, *moved),
        of_map=np.concatenate([world.of_map, guest.of_map]),
        edges=Edges.chained(world.edges, replace(guest.edges, pairs=guest.edges.pairs + old), closed),
        closures=(*world.closures, *found.closures),
    )
    best = optimized(both, config, held)
    return best if len(_joining(best, old)) else None


def graph_of(joined: Joined, held: int = -1) -> PoseGraph:
    """The pose graph of all edges; the keyframes of the fixed map, the first one, are a single pose of the graph.

    An edge to one of them becomes an edge to the first, whose measurement includes the pose between the two.
    """
    poses, edges, body = joined.poses, joined.edges, _body(joined, held)
    node = np.maximum(np.arange(len(poses)) - body + 1, 0)
    T_first_held = lie.between(poses[:1], poses[:body])
    pairs, measurements, information = edges.pairs, edges.measurements.copy(), edges.information.copy()
    starts, ends = pairs[:, 0] < body, pairs[:, 1] < body
    measurements[starts] = T_first_held[pairs[starts, 0]] @ measurements[starts]
    T_held_first = lie.inverse(T_first_held[pairs[ends, 1]])
    measurements[ends] = measurements[ends] @ T_held_first
    to_own = lie.adjoint(T_held_first)  # from a twist in the frame of the first to one in that of the other
    information[ends] = np.swapaxes(to_own, 1, 2) @ information[ends] @ to_own
    kept = ~(starts & ends)
    graph = PoseGraph(joined.dimension)
    for keyframe in (joined.keyframes[0], *joined.keyframes[body:]):
        graph.add_pose(keyframe.T_odom_lidar, keyframe.stamp_ns)
    graph.add_edges(node[pairs[kept]], measurements[kept], information[kept], edges.is_loop[kept])
    return graph


def optimized(joined: Joined, config: Config, held: int = -1) -> Joined:
    """All edges at the minimum of χ²; fixed are the keyframes of the fixed map or else the first keyframe."""
    graph, body = graph_of(joined, held), _body(joined, held)
    graph.optimize(config.graph, initialize="given")
    weight = np.ones(len(joined.edges.pairs))
    weight[~(joined.edges.pairs < body).all(axis=1)] = graph.weight
    poses = joined.poses
    poses[body:] = graph.poses[1:]
    return replace(joined.placed(poses), edges=replace(joined.edges, weight=weight))


def _body(joined: Joined, held: int) -> int:
    """Number of leading keyframes that are one pose of the graph."""
    return int((joined.of_map == held).sum()) or 1


def changed(joined: Joined) -> dict[int, float]:
    """Share of contradicting points between each map, by number, and the others, if far above that within maps."""
    parts = {
        number: [joined.keyframes[k] for k in np.flatnonzero(joined.of_map == number)] for number in joined.maps
    }
    # least path between two keyframes of one map
    agreeing, contradicting = sum((compared(part, part, 1.0) for part in parts.values()), np.zeros(2))
    least = max(_CHANGE[0], _CHANGE[1] * contradicting / max(agreeing + contradicting, 1))
    found: dict[int, float] = {}
    for number in joined.maps[1:]:
        others = [k for other, part in parts.items() if other != number for k in part]
        agreeing, contradicting = compared(others, parts[number]) + compared(parts[number], others)
        share = float(contradicting / max(agreeing + contradicting, 1))
        if share > least:
            found[number] = share
    return found


def objection_to(joined: Joined, old: int, config: Config) -> str:
    """Reason why the keyframes from ``old`` on may belong elsewhere, empty if there is none.

    The evidence is tested as for a log in a map, at optimized poses. What agrees is searched for elsewhere.
    """
    in_force, guest, segments = _joining(joined, old), joined.keyframes[old:], Segments()
    segments.start(old)
    evidence = SequentialPlaceTest(segments)
    evidence.record([closure for closure in joined.closures if closure.source >= old])
    evidence.passes_at(range(old, len(joined.keyframes)), joined.keyframes, joined.poses)
    asked = evidence.bound + (_STORIES if joined.dimension == 3 else 0.0)
    if evidence.log_odds < asked:
        agree = f"{counted(len(in_force), 'keyframe')} of it agree"
        return f"{agree}, but all closures tried give log-odds of {evidence.log_odds:.1f}, below {asked:.1f}"
    if len(in_force) < _MIN_KEYFRAMES:
        return _SHORT
    if joined.dimension == 2:
        repeated, paths = repeated_paths(joined.keyframes[:old], guest, in_force - old, config)
    else:
        some = in_force[:: -(-len(in_force) // _SEARCHED)].tolist()
        ends = [joined.keyframes[max(k + 1 - MEMBERS, 0) : k + 1] for k in some]
        everything = UprightMap(joined.keyframes, config)
        repeated, paths = sum(map(everything.is_repeated, ends)), len(some)
    if repeated > MAX_REPEATED * paths:
        return f"{repeated} of {counted(paths, 'path')} that agree also fit other locations"
    return "" if paths >= _MIN_PATHS else _SHORT


def repeated_paths(
    host: Sequence[Keyframe], guest: Sequence[Keyframe], agreeing: NDArray[np.int64], config: Config
) -> tuple[int, int]:
    """Numbers of agreeing paths of the guest that also fit elsewhere in either map, and of those tested.

    agreeing : numbers of the guest's keyframes that agree with the host; both in one frame
    """
    searches = [PlanarMapSearch(part, config.local_map.voxel_size_m) for part in (host, guest)]
    traveled_m = np.array([keyframe.traveled_m for keyframe in guest]) - guest[0].traveled_m
    length_m = max(min(SEARCHED_M[2], 0.5 * traveled_m[-1]), _STEP_M)
    step_m = max(_STEP_M, traveled_m[-1] / _MAX_PATHS)
    begin_m = np.arange(0.0, max(traveled_m[-1] - length_m, 0.0) + step_m, step_m)
    ends = np.unique(np.searchsorted(traveled_m, [begin_m, begin_m + length_m]), axis=1).T.tolist()
    paths = [range(*each) for each in ends if np.isin(range(*each), agreeing).sum() > _AGREEING * np.diff(each)]
    paths, repeated = paths[:: max(-(-len(paths) // _SEARCHED), 1)], 0
    for path in paths:
        members = [guest[index] for index in path]
        fits = [fit for search in searches if (fit := search.likely(members)) is not None]
        T = members[len(members) // 2].T_odom_lidar
        repeated += any(fit.is_ambiguous or not lie.agree(fit.T_map_lidar, T, *AGREE) for fit in fits)
    return repeated, len(paths)


def _joining(joined: Joined, old: int) -> NDArray[np.int64]:
    """Keyframes from ``old`` on that a closure in force joins to those before."""
    pairs = joined.edges.pairs
    return np.unique(pairs[(pairs[:, 0] < old) & (pairs[:, 1] >= old) & (joined.edges.weight > DOWNWEIGHTED), 1])


def _overlap(joined: Joined, old: int) -> float:
    """Share of the keyframes from ``old`` on that closures in force join to those before."""
    return len(_joining(joined, old)) / (len(joined.keyframes) - old)
