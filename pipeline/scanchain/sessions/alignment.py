"""Alignment of a map to another: its keyframes pass through the SLAM chain like scans of a log in ``localize``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import (
    Closure,
    ClosureVerdict,
    Keyframe,
    KeyframeErrors,
    Matrix,
    Points,
    Pose,
    Prior,
    RawPoints,
    Scan,
    State,
)
from scanchain.errors import InputError, counted
from scanchain.maps import Edges, SavedMap, open_saved_map
from scanchain.odometry.front_end import Located
from scanchain.odometry.odometry import Tracked, first_match
from scanchain.slam import Slam

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
    slam = Slam(config, dimension=target.dimension, prior=target, prior_is_final=is_final)
    information, first_points = _information(keyframes, edges, order, config), keyframes[order[0]].points
    for n, number in enumerate(order):
        slam.place(_located(keyframes[number], information[n], first_points, config))
        if n == 0 and T_target_first is not None:
            slam.placement.begin_at(T_target_first, _FOUND)
    result, old = slam.finish(), len(target.keyframes)
    i, j = result.state.edges[result.state.is_loop & ~result.state.is_rejected].T
    loops = int(((i < old) & (j >= old)).sum())
    is_found = loops > 0 and result.components[0] == result.components[-1]
    poses = np.array([keyframe.T_odom_lidar for keyframe in keyframes])
    poses[list(order)] = result.trajectory.poses
    closures = (replace(c, source=old + order[c.source - old]) for c in result.closures if c.target < old)
    return Alignment(poses, tuple(closures), loops, bool(is_found))


def _information(keyframes: Sequence[Keyframe], edges: Edges, order: Sequence[int], config: Config) -> Matrix:
    """(N, k, k) of the motion to each keyframe from the one before in this order, by the edge between them if any.

    T_ji = T_ij⁻¹: where the order is against the path, a twist ξ on it is one of −Ad(T_ji) ξ on T_ij.
    """
    k = lie.twist_size(keyframes[0].T_odom_lidar)
    usual = lie.by_component(k, config.odometry.edge_sigma_m, config.odometry.edge_sigma_rad) ** -2.0
    result = np.tile(np.diag(usual), (len(order), 1, 1))
    odometry = edges.where(~edges.is_loop)
    known = dict(zip(map(tuple, odometry.pairs.tolist()), odometry.information, strict=True))
    for n, (i, j) in enumerate(pairwise(order), 1):
        result[n] = known.get((i, j), result[n])
        if (j, i) in known:
            Ad = lie.adjoint(lie.between(keyframes[i].T_odom_lidar, keyframes[j].T_odom_lidar))
            result[n] = Ad.T @ known[j, i] @ Ad
    return result


def _located(keyframe: Keyframe, information: Matrix, first_points: Points, config: Config) -> Located:
    """A keyframe of a map as odometry would output it, with its final pose in place of that of odometry."""
    points, T = keyframe.points, keyframe.T_odom_lidar
    raw: RawPoints = points.astype(np.float32)
    scan = Scan(keyframe.scan_index, keyframe.stamp_ns, keyframe.stamp_ns, raw, np.empty(0, np.float32), 0, None)
    match = first_match(T, points, config.matching)
    covariance = np.linalg.inv(information).astype(np.float64)
    prior = Prior(T, covariance, np.zeros(len(information)))
    tracked = Tracked(scan, points, points, T, match, State.OK, "", prior, 0.0, 0.0, 0.0)
    errors = KeyframeErrors(1.0, np.zeros_like(information), 0.0)
    return Located(tracked, True, keyframe.scale, points[:0], information, errors, first_points)
