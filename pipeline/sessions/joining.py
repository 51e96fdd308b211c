"""Maps in one frame: each is sought in those that are joined already, then closed to them all along."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Closure, ClosureVerdict, Keyframe, Matrix, Pose
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops import LoopCloser
from scanchain.loops.evidence import MIN_SHARE, are_enough, compared, contradiction, is_contradicted
from scanchain.loops.planar_map_search import PlanarMapSearch
from scanchain.maps import Edges, SavedMap
from scanchain.slam import loop_information
from scanchain.words import counted

_APART_M = 200.0  # path between the last keyframe of a map and the first of the next: no submap holds both
_OPTIMIZE_EVERY, _GROWTH = 10, 0.05  # keyframes between two optimizations: at least so many, and such a share
_MAX_TRIES = 5  # largest number of poses at which a map is tried
_SAME = 2.0, 0.2  # m and rad, distance within which two of these are the same
_FOUND_M, _FOUND_RAD = 0.5, 0.05  # standard deviations of a pose that was found, and of one session to the next
_IN_FORCE = 0.5  # least robust weight of a closure that joins two maps
_MIN_CHANGE, _TIMES_WITHIN = 0.025, 3.0  # share of them from which on it is told, and times that within the maps
_WITHIN_M = 1.0  # least path between two keyframes of one map that are compared
_CLEAR = 0.3  # share of a map's keyframes with such a closure from which on it is not sought elsewhere
_RIVAL = 0.5  # share of the most such closures from which on those at another pose make it ambiguous
_PATH_M, _STEP_M = 8.0, 2.0  # length of paths whose points are sought together, in the plane, and between two
_AGREE = 0.5, 0.1  # m and rad, largest difference between poses that confirm each other
_MAX_PATHS = 200  # largest number of these; along longer sessions they lie farther apart
MAX_REPEATED = 0.25  # largest share of the agreeing paths that may look like another place
_MIN_PATHS = 2  # least number of agreeing paths


@dataclass(frozen=True, slots=True)
class Joined:
    """One or several maps in one frame.

    Attributes
    ----------
    maps : numbers of the maps, in the order in which they joined
    keyframes : of all of them in this order; ``T_odom_lidar`` is the pose in the common frame
    of_map : (K,) number of each keyframe's map
    edges : of the maps, and the closures between them, with the weights that the optimizer left to them
    closures : tried between maps, accepted by matching or not
    """

    maps: tuple[int, ...]
    keyframes: tuple[Keyframe, ...]
    of_map: NDArray[np.int64]
    edges: Edges
    closures: tuple[Closure, ...] = ()

    @classmethod
    def of(cls, number: int, maps: Sequence[SavedMap]) -> Joined:
        """One of several maps alone."""
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
    def length_m(self) -> float:
        """Path from the first keyframe to the last."""
        return self.keyframes[-1].traveled_m - self.keyframes[0].traveled_m

    @property
    def is_between(self) -> NDArray[np.bool_]:
        """True for edges (E,) between two maps."""
        ends = self.of_map[self.edges.pairs]
        return ends[:, 0] != ends[:, 1]

    def placed(self, poses: Matrix) -> Joined:
        """With the keyframes at other poses (K, d+1, d+1)."""
        moved = zip(self.keyframes, poses, strict=True)
        return replace(self, keyframes=tuple(replace(each, T_odom_lidar=pose) for each, pose in moved))


@dataclass(frozen=True, slots=True)
class Doubt:
    """A pose at which a map might join others, without enough evidence.

    Attributes
    ----------
    guest : number of the map; host : of that whose frame the pose is given in
    T_host_guest : pose of the guest's first keyframe
    reason : why it is not certain
    """

    guest: int
    host: int
    T_host_guest: Pose
    reason: str


def join_all(
    maps: Sequence[SavedMap], order: Sequence[int], config: Config, held: int, say: Callable[[str], None]
) -> tuple[list[Joined], list[Doubt]]:
    """Maps that belong together, each group in one frame, that of its first map; and what might belong to them.

    order : numbers of the maps; each is tried again whenever its group has grown since
    held : number of a map whose keyframes stay where they are, −1 for none
    """
    groups: list[Joined] = []
    doubts: dict[int, Doubt] = {}
    waiting = list(order)
    while waiting:
        world = Joined.of(waiting.pop(0), maps)
        joined: Joined | None = world
        while joined is not None:
            world, joined = joined, None
            for number in waiting:
                say(f"{maps[number].name}: searching in a map of {len(world.keyframes):,} keyframes")
                trial = join(world, Joined.of(number, maps), config, held)
                if isinstance(trial, Doubt):
                    doubts[number] = trial
                elif trial is not None and (joined is None or _overlap(trial, world) > _overlap(joined, world)):
                    joined = trial
                    if _overlap(joined, world) > _CLEAR:
                        break
            if joined is not None:
                waiting.remove(joined.maps[-1])
                doubts.pop(joined.maps[-1], None)
        groups.append(world)
    return groups, list(doubts.values())


def join(world: Joined, guest: Joined, config: Config, held: int = -1) -> Joined | Doubt | None:
    """Both in the frame of the world; None where too few closures join them, a doubt where they do not suffice.

    Where much of the guest overlaps the world, it is not sought elsewhere.
    """
    apart = msgspec.structs.replace(
        config.loops, min_travel_m=max(guest.length_m, config.loops.min_travel_m) + 1.0
    )
    between = msgspec.structs.replace(config, loops=apart)  # no loop is as short as to lie within the guest
    old, tried, trials = len(world.keyframes), list[Matrix](), list[Joined]()
    for target, source, T_world_source in _sought(world, guest, between):
        if any(_agree(T_world_source, poses[source], _SAME) for poses in tried):
            continue
        T_world_guest = lie.normalize(T_world_source @ lie.inverse(guest.poses[source]))
        trial = _Closing(world, guest, target, T_world_guest, between, held).finish()
        tried.append(T_world_guest @ guest.poses if trial is None else trial.poses[old:])
        if trial is not None:
            trials.append(trial)
        if len(tried) == _MAX_TRIES or (trial is not None and _overlap(trial, world) > _CLEAR):
            break
    if not trials:
        return None
    trials.sort(key=lambda trial: -_overlap(trial, world))
    best, *others = trials
    if others and _overlap(others[0], world) > _RIVAL * _overlap(best, world):
        doubt = "nearly as many closures agree at another pose"
    else:
        doubt = look_alike(best, old, config) if world.dimension == 2 else ""
    return Doubt(guest.maps[0], world.maps[0], best.poses[old], doubt) if doubt else best


def graph_of(joined: Joined, held: int = -1) -> PoseGraph:
    """The pose graph of all edges; keyframes of the held map, its first one, are a single pose of the graph.

    An edge to one of them is an edge to the first, with the pose between the two in its measurement.
    """
    poses, edges, body = joined.poses, joined.edges, _body(joined, held)
    node = np.maximum(np.arange(len(poses)) - body + 1, 0)
    T_first_held = lie.between(poses[:1], poses[:body])
    pairs, measurements, information = edges.pairs, edges.measurements.copy(), edges.information.copy()
    starts, ends = pairs[:, 0] < body, pairs[:, 1] < body
    measurements[starts] = T_first_held[pairs[starts, 0]] @ measurements[starts]
    T_held_first = lie.inverse(T_first_held[pairs[ends, 1]])
    measurements[ends] = measurements[ends] @ T_held_first
    to_own = lie.adjoint(T_held_first)  # a twist in the frame of the first as one in that of the other
    information[ends] = np.swapaxes(to_own, 1, 2) @ information[ends] @ to_own
    kept = ~(starts & ends)
    graph = PoseGraph(joined.dimension)
    for keyframe in (joined.keyframes[0], *joined.keyframes[body:]):
        graph.add_pose(keyframe.T_odom_lidar, keyframe.stamp_ns)
    graph.add_edges(node[pairs[kept]], measurements[kept], information[kept], edges.is_loop[kept])
    return graph


def optimized(joined: Joined, config: Config, held: int = -1) -> Joined:
    """All edges at the minimum of χ²; the keyframes of the held map stay where they are, or else the first one."""
    graph, body = graph_of(joined, held), _body(joined, held)
    graph.optimize(config.graph, initialize="given", rejection="refined")
    weight = np.ones(len(joined.edges.pairs))
    weight[~(joined.edges.pairs < body).all(axis=1)] = graph.weight
    poses = joined.poses
    poses[body:] = graph.poses[1:]
    return replace(joined.placed(poses), edges=replace(joined.edges, weight=weight))


def _body(joined: Joined, held: int) -> int:
    """Number of the first keyframes that are one pose of the graph."""
    return int((joined.of_map == held).sum()) or 1


def _sought(world: Joined, guest: Joined, config: Config) -> Iterator[tuple[int, int, Pose]]:
    """Poses of the guest's keyframes, sought everywhere in the world; in the plane where two paths agree.

    Yields the numbers of a keyframe of the world near by and of the guest's, and T_world_keyframe of that.
    """
    if world.dimension == 3:
        yield from _recognized(world, guest, config)
        return
    search = PlanarMapSearch(world.keyframes, world.poses, config.local_map.voxel_size_m)
    finds: list[Pose] = []
    for path in _paths(guest.keyframes):
        best = search.likely([guest.keyframes[index] for index in path])
        if best is None or best.is_ambiguous:
            continue
        source = path[len(path) // 2]
        T_guest_source = guest.poses[source]
        if any(_agree(T_world_guest @ T_guest_source, best.T_map_lidar) for T_world_guest in finds):
            away_m = np.linalg.norm((world.poses - best.T_map_lidar)[:, :2, 2], axis=1)
            yield int(away_m.argmin()), source, best.T_map_lidar
        finds.append(best.T_map_lidar @ lie.inverse(T_guest_source))


def _recognized(world: Joined, guest: Joined, config: Config) -> Iterator[tuple[int, int, Pose]]:
    """The same in space, by recognized places."""
    old, keyframes, graph = len(world.keyframes), list(world.keyframes), graph_of(world)
    closer = LoopCloser(config, world.dimension)
    begin_m = closer.begin_in(keyframes, is_fixed=False)
    closer.start_segment(old)
    for keyframe in _after(guest.keyframes, old, begin_m):
        keyframes.append(keyframe)
        graph.add_pose(keyframe.T_odom_lidar, keyframe.stamp_ns)
        closures = closer.close(keyframes, graph)
        if len(keyframes) == old + len(guest.keyframes):
            closures += closer.finish(keyframes, graph)
        for closure in closures:
            if closure.verdict is ClosureVerdict.ACCEPTED:
                T_world_source = graph.poses[closure.target] @ closure.match.T_target_source
                yield closure.target, closure.source - old, T_world_source


def _paths(keyframes: Sequence[Keyframe]) -> list[range]:
    """Numbers of the keyframes along overlapping paths of some length."""
    traveled_m = np.array([keyframe.traveled_m for keyframe in keyframes]) - keyframes[0].traveled_m
    length_m = max(min(_PATH_M, 0.5 * traveled_m[-1]), _STEP_M)
    step_m = max(_STEP_M, traveled_m[-1] / _MAX_PATHS)
    begin_m = np.arange(0.0, max(traveled_m[-1] - length_m, 0.0) + step_m, step_m)
    ends = np.searchsorted(traveled_m, [begin_m, begin_m + length_m])
    return [range(first, end) for first, end in np.unique(ends, axis=1).T.tolist() if first < end]


class _Closing:
    """Closures between a world and a guest whose pose in it is known but for a standard deviation."""

    def __init__(
        self, world: Joined, guest: Joined, target: int, T_world_guest: Pose, config: Config, held: int
    ) -> None:
        self.world, self.config, self.held = world, config, held
        self.guest = guest.placed(T_world_guest @ guest.poses)
        self.target = target  # keyframe of the world near the guest
        self.closer = LoopCloser(config, world.dimension)
        self.keyframes = list(world.keyframes)
        self.graph = graph_of(world)
        self.closures: list[Closure] = []
        self.waiting, self.optimized_at = False, len(self.keyframes)
        self.T_world_odom = lie.identity(world.dimension)

    def finish(self) -> Joined | None:
        """Both joined; None where too few closures between them are in force."""
        old, begin_m = len(self.keyframes), self.closer.begin_in(self.keyframes, is_fixed=False)
        for index in range(_body(self.world, self.held)):
            self.graph.fix(index)
        edges = self.guest.edges
        last_end = edges.pairs.max(axis=1, initial=-1)
        for keyframe in _after(self.guest.keyframes, old, begin_m):
            self._add(keyframe, edges.where(last_end == keyframe.index - old))
            self._take(self.closer.close(self.keyframes, self.graph))
            due = max(_OPTIMIZE_EVERY, _GROWTH * len(self.keyframes))
            if self.waiting and len(self.keyframes) - self.optimized_at >= due:
                self._optimize()
        self._take(self.closer.finish(self.keyframes, self.graph))
        if not any(closure.verdict is ClosureVerdict.ACCEPTED for closure in self.closures):
            return None
        joined = optimized(self._joined(), self.config, self.held)
        return joined if _is_joined(joined, old) else None

    def _add(self, keyframe: Keyframe, edges: Edges) -> None:
        """Add a keyframe with its edges to older ones; where it has none, one to the last, for the time being."""
        old = len(self.world.keyframes)
        last = self.keyframes[-1] if keyframe.index > old else self.keyframes[self.target]
        self.keyframes.append(keyframe)
        self.graph.add_pose(lie.normalize(self.T_world_odom @ keyframe.T_odom_lidar), keyframe.stamp_ns)
        self.graph.add_edges(edges.pairs + old, edges.measurements, edges.information, edges.is_loop)
        if not len(edges.pairs):
            T_last_keyframe = lie.between(last.T_odom_lidar, keyframe.T_odom_lidar)
            sigma = lie.by_component(self.graph.freedom, _FOUND_M, _FOUND_RAD)
            self.graph.add_edge(last.index, keyframe.index, T_last_keyframe, np.diag(sigma**-2.0))

    def _take(self, closures: Sequence[Closure]) -> None:
        """Keep closures; those accepted become edges of the graph."""
        self.closures += closures
        for closure in closures:
            if closure.verdict is ClosureVerdict.ACCEPTED:
                self.waiting = True
                information = loop_information(closure, self.config.loops)
                self.graph.add_edge(
                    closure.target, closure.source, closure.match.T_target_source, information, is_loop=True
                )

    def _optimize(self) -> None:
        self.graph.optimize(self.config.graph, initialize="given", rejection="gnc")
        self.waiting, self.optimized_at = False, len(self.keyframes)
        self.T_world_odom = lie.normalize(self.graph.poses[-1] @ lie.inverse(self.keyframes[-1].T_odom_lidar))

    def _joined(self) -> Joined:
        """World and guest with their own edges and all accepted closures, at the poses of now."""
        world, guest, old = self.world, self.guest, len(self.world.keyframes)
        accepted = [closure for closure in self.closures if closure.verdict is ClosureVerdict.ACCEPTED]
        count = len(accepted)
        closed = Edges(
            np.array([(closure.target, closure.source) for closure in accepted], np.int64),
            np.array([closure.match.T_target_source for closure in accepted]),
            np.array([loop_information(closure, self.config.loops) for closure in accepted]),
            np.ones(count, np.bool_),
            np.ones(count),
        )
        joined = Joined(
            maps=world.maps + guest.maps,
            keyframes=(*world.keyframes, *_after(guest.keyframes, old, world.keyframes[-1].traveled_m + _APART_M)),
            of_map=np.concatenate([world.of_map, guest.of_map]),
            edges=Edges.chained(world.edges, replace(guest.edges, pairs=guest.edges.pairs + old), closed),
            closures=(*world.closures, *self.closures),
        )
        return joined.placed(self.graph.poses.copy())


def _after(keyframes: Sequence[Keyframe], index: int, begin_m: float) -> Iterator[Keyframe]:
    """Keyframes numbered from an index on, on a path that begins there."""
    first_m = keyframes[0].traveled_m
    for number, keyframe in enumerate(keyframes, start=index):
        yield replace(keyframe, index=number, traveled_m=begin_m + keyframe.traveled_m - first_m)


def _is_joined(joined: Joined, old: int) -> bool:
    """True if enough closures in force join the keyframes before ``old`` to the others, and free space agrees."""
    tried = len({closure.source for closure in joined.closures if closure.source >= old})
    is_enough = are_enough(len(_joining(joined, old)), tried)
    return is_enough and not is_contradicted(joined.keyframes[:old], joined.keyframes[old:])


def changed(joined: Joined) -> dict[int, float]:
    """Contradiction of maps with those they joined, by number, where it is far more than within them."""
    parts = {
        number: [joined.keyframes[k] for k in np.flatnonzero(joined.of_map == number)] for number in joined.maps
    }
    agreeing, contradicting = sum((compared(part, part, _WITHIN_M) for part in parts.values()), np.zeros(2))
    least = max(_MIN_CHANGE, _TIMES_WITHIN * contradicting / max(agreeing + contradicting, 1))
    found: dict[int, float] = {}
    for number in joined.maps[1:]:
        others = [k for other, part in parts.items() if other != number for k in part]
        share = contradiction(others, parts[number])
        if share > least:
            found[number] = share
    return found


def look_alike(joined: Joined, old: int, config: Config) -> str:
    """Reason why the keyframes from ``old`` on may agree with those of a look-alike, empty if there is none."""
    guest, agreeing = joined.keyframes[old:], _joining(joined, old) - old
    repeated, paths = repeated_paths(joined.keyframes[:old], guest, agreeing, config)
    if repeated > MAX_REPEATED * paths:
        return f"{repeated} of {counted(paths, 'path')} that agree look like other places, too"
    return "" if paths >= _MIN_PATHS else "they agree along a short path only"


def repeated_paths(
    host: Sequence[Keyframe],
    guest: Sequence[Keyframe],
    agreeing: NDArray[np.int64],
    config: Config,
    most: int = _MAX_PATHS,
) -> tuple[int, int]:
    """Number of paths of the guest that fit elsewhere in one of both maps, too, and of all that agree.

    agreeing : numbers of the guest's keyframes that agree with the host; both in one frame
    most : largest number of paths, evenly spread over those that agree
    """
    searches = [
        PlanarMapSearch(part, np.array([each.T_odom_lidar for each in part]), config.local_map.voxel_size_m)
        for part in (host, guest)
    ]
    paths = [path for path in _paths(guest) if np.isin(path, agreeing).mean() >= MIN_SHARE]
    paths, repeated = paths[:: max(-(-len(paths) // most), 1)], 0
    for path in paths:
        members = [guest[index] for index in path]
        fits = [fit for search in searches if (fit := search.likely(members)) is not None]
        repeated += any(
            fit.is_ambiguous or not _agree(fit.T_map_lidar, members[len(members) // 2].T_odom_lidar)
            for fit in fits
        )
    return repeated, len(paths)


def _joining(joined: Joined, old: int) -> NDArray[np.int64]:
    """Keyframes from ``old`` on that a closure in force joins to those before."""
    pairs = joined.edges.pairs
    return np.unique(pairs[(pairs[:, 0] < old) & (pairs[:, 1] >= old) & (joined.edges.weight > _IN_FORCE), 1])


def _overlap(joined: Joined, world: Joined) -> float:
    """Share of the keyframes that joined a world that closures in force join to it."""
    old = len(world.keyframes)
    return len(_joining(joined, old)) / (len(joined.keyframes) - old)


def _agree(T_a: Pose, T_b: Pose, within: tuple[float, float] = _AGREE) -> bool:
    away_m, away_rad = lie.apart(T_a, T_b)
    return away_m < within[0] and away_rad < within[1]
