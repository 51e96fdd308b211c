"""Alignment of a map to another: its keyframes enter the back end like those of a log in ``localize``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np

from scanchain import lie
from scanchain.back_end import BackEnd, Constraint
from scanchain.config import Config
from scanchain.data import Closure, ClosureVerdict, Keyframe, KeyframeErrors, Matrix, Pose
from scanchain.errors import InputError, counted
from scanchain.graph.factors import Odometry
from scanchain.loops import refined
from scanchain.maps import Edges, SavedMap, open_saved_map

_LATE = 10  # least number of keyframes before the first matched one for which these are matched backward, too
_FOUND = 0.5, 0.05  # m and rad, standard deviations of the pose that they start from


@dataclass(frozen=True, slots=True)
class Alignment:
    """Keyframes localized among those of a map, which stay fixed.

    poses : (K, d+1, d+1) T_target_lidar of the keyframes, meaningless where not ``is_found``
    closures : tried with the map; ``source`` is the number of the map's keyframes plus that of the keyframe
    loops : number of them in force
    is_found : whether they join all keyframes to the map, with the evidence that ``localize`` requires
    """

    poses: Matrix
    closures: tuple[Closure, ...]
    loops: int
    is_found: bool

    @property
    def accepted(self) -> tuple[Closure, ...]:
        """The closures that were accepted."""
        return tuple(each for each in self.closures if each.verdict is ClosureVerdict.ACCEPTED)


def opened_maps(runs: Sequence[Path], out: Path) -> list[SavedMap]:
    """The maps of run directories or map folders, of one dimension; none of them is the output directory.

    Raises InputError for a map that cannot be read, or has no keyframe.
    """
    maps = [open_saved_map(run) for run in runs]
    for run, saved in zip(runs, maps, strict=True):
        if saved.dimension != maps[0].dimension:
            raise InputError(
                f"{run}: is a {saved.dimension}D map, {runs[0]} a {maps[0].dimension}D one; give maps of the same "
                "kind"
            )
        if not saved.keyframes:
            raise InputError(f"{run}: its map has no keyframe; give another one")
        if out.resolve() in (run.resolve(), saved.folder.resolve()):
            raise InputError(f"{out}: is one of the maps; choose another --out")
    return maps


def align_maps(target: SavedMap, source: SavedMap, config: Config) -> Alignment:
    """The keyframes of ``source`` in the frame of ``target``, without an initial guess.

    Raises InputError where the source is not found in the target.
    """
    found = align(target, source.keyframes, source.edges, config, is_final=True)
    if not found.is_found:
        raise InputError(
            f"{source.name}: is not found in {target.name} ({counted(len(found.closures), 'closure')} tried, "
            f"{len(found.accepted)} accepted); give maps of one place, or the transform between them"
        )
    return found


def align(
    target: SavedMap, keyframes: Sequence[Keyframe], edges: Edges, config: Config, *, is_final: bool
) -> Alignment:
    """Keyframes with the edges between them, localized in the target along their path.

    If the path is found late, it is also tracked backward from there to its start.

    is_final : whether the poses of the target's keyframes are final
    """
    path_m = keyframes[-1].traveled_m - keyframes[0].traveled_m
    loops = msgspec.structs.replace(config.loops, min_travel_m=max(path_m, config.loops.min_travel_m) + 1.0)
    between = msgspec.structs.replace(config, loops=loops)  # so that no loop lies within the path
    walked = partial(_walked, target, keyframes, edges, config=between, is_final=is_final)
    old = len(target.keyframes)
    found = walked(range(len(keyframes)))
    begun = min((each.source - old for each in found.accepted), default=0)
    if begun < _LATE:
        return found
    back = walked(range(begun, -1, -1), T_target_first=found.poses[begun])
    found.poses[:begun] = back.poses[:begun]
    return replace(found, closures=found.closures + back.closures, loops=found.loops + back.loops)


def _walked(
    target: SavedMap,
    keyframes: Sequence[Keyframe],
    edges: Edges,
    order: Sequence[int],
    *,
    config: Config,
    is_final: bool,
    T_target_first: Pose | None = None,
) -> Alignment:
    """Some keyframes, localized in the target one after the other in the given ``order``.

    config, is_final : as of ``align``, except that no loop is closed within the path
    T_target_first : pose of the first of them, where it is known
    """
    back_end, old = BackEnd(config, target.dimension, prior=target, prior_is_final=is_final), len(target.keyframes)
    information, traveled_m = _information(keyframes, edges, order, config), back_end.start_m
    motion: list[Constraint] = []
    errors = KeyframeErrors(1.0, np.zeros_like(information[0]), 0.0)
    for n, number in enumerate(order):
        if n:
            T_last, T_next = back_end.keyframes[-1].T_odom_lidar, keyframes[number].T_odom_lidar
            traveled_m += lie.apart(T_last, T_next)[0]
            motion = [Constraint(Odometry(), old + n - 1, lie.between(T_last, T_next), information[n])]
        keyframe = replace(keyframes[number], index=old + n, scan_index=n, traveled_m=traveled_m, noise_m=0.0)
        back_end.add(keyframe, motion, errors)
        back_end.advance(is_keyframe=True)
        if n == 0 and T_target_first is not None:
            back_end.placement.begin_at(T_target_first, _FOUND)
    state = back_end.finish()
    placed, segments = state.poses[old:], back_end.closer.segments.components(back_end.graph)
    if target.dimension == 2 and config.loops.refine:
        path = back_end.keyframes[old:]
        placed = refined(placed, lambda n: path[n].points, target.keyframes, state.poses[:old], config)
    i, j = state.edges[state.is_loop & ~state.is_rejected].T
    begin = old if T_target_first is None else old + 1  # the walk that found this pose has its closures
    loops = int(((i < old) & (j >= begin)).sum())
    poses = np.array([keyframe.T_odom_lidar for keyframe in keyframes])
    poses[list(order)] = placed
    closures = (
        replace(c, source=old + order[c.source - old])
        for c in back_end.placement.closures
        if c.target < old and c.source >= begin
    )
    return Alignment(poses, tuple(closures), loops, bool(loops and segments[0] == segments[-1]))


def _information(keyframes: Sequence[Keyframe], edges: Edges, order: Sequence[int], config: Config) -> Matrix:
    """(N, k, k) of an edge to each keyframe from the one before in this order: that of the map if there is one.

    T_ji = T_ij⁻¹: where the order is against the path, a twist ξ on it is one of −Ad(T_ji) ξ on T_ij.
    """
    k = lie.twist_size(keyframes[0].T_odom_lidar)
    sigmas = config.odometry.edge_sigma_m, config.odometry.edge_sigma_rad
    result = np.tile(np.diag(lie.by_component(k, *sigmas) ** -2.0), (len(order), 1, 1))
    odometry = edges.where(~edges.is_loop)
    known = dict(zip(map(tuple, odometry.pairs.tolist()), odometry.information, strict=True))
    for n, (i, j) in enumerate(pairwise(order), 1):
        result[n] = known.get((i, j), result[n])
        if (j, i) in known:
            Ad = lie.adjoint(lie.between(keyframes[i].T_odom_lidar, keyframes[j].T_odom_lidar))
            result[n] = Ad.T @ known[j, i] @ Ad
    return result
