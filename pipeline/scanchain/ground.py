"""Ground: vehicles on wheels move in planes where the lidar does not contradict it; this corrects their height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scanchain import lie
from scanchain.config import Config, GraphConfig
from scanchain.data import Integers, KeyframeErrors, Matrix, Pose, Vector
from scanchain.evaluation.consistency import with_map_errors
from scanchain.graph.consistency import is_bent
from scanchain.graph.factors import Prior
from scanchain.graph.pose_graph import PoseGraph
from scanchain.gravity import MOUNTED_RAD, hold_first, upright

_UNEVEN = (0.02, 0.01)  # m and rad, largest σ of height and tilt in a plane, by the ground and the suspension
_CORRELATED = 4  # number of successive keyframes that share such an error
_PART_M = 50.0  # least length of the parts of the path that are tested, of which a plane has at least two
_DRIFT = 0.001  # largest drift of the height, as a share of the path; more is a hill unless ``on``
_LEAST_SHARE = 0.5  # of the path in planes: parts of a rolling ground are flat by chance


def flattened(
    graph: PoseGraph, errors: Sequence[KeyframeErrors], up: Vector, config: Config, *, levels: bool
) -> tuple[PoseGraph, str]:
    """A graph in space with priors of height and tilt of the poses that lie in planes, and a note on it.

    The planes stay where the lidar has them, relative to each other.

    errors : of the keyframes, which say how precise the edges are
    up : (3,) of the vehicle, in the frame of the lidar
    levels : whether the plane of the first pose becomes horizontal
    """
    at_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(graph.poses[:, :3, 3], axis=0), axis=1)))
    parts = int(at_m[-1] / _PART_M)
    if not parts:
        return graph, ""
    bounds = [*np.searchsorted(at_m, at_m[-1] * np.arange(parts) / parts).tolist(), len(graph)]
    drift = np.inf if config.graph.ground == "on" else _DRIFT
    test = _Test(with_map_errors(graph, errors, config)[0], up, bounds, drift)
    planes = [each for each in test.planes(0, parts) if each and each.parts > 1 and not each.rolls]
    share = sum(each.parts for each in planes) / parts
    if share < _LEAST_SHARE:
        return graph, ""
    ends_m = [at_m[[each.first, each.last - 1]] for each in planes]
    # half a part at those ends of a plane that are not ends of the path, which may lie on a ramp
    margins_m = [0.5 * _PART_M * np.array([each.first > 0, each.last < len(graph)]) for each in planes]
    inside = [
        np.flatnonzero((at_m >= a + before) & (at_m <= b - after))
        for (a, b), (before, after) in zip(ends_m, margins_m, strict=True)
    ]
    note = f"ground: flat over {100.0 * share:.0f} % of the path"
    level, T_level = graph.copy(), lie.identity(3)
    if levels and not planes[0].first:
        T_level[:3, :3] = upright(_fitted(graph.poses[inside[0]], up)[0][:3, 2])
        note += ", which levels the result"
    level.move(0, T_level)
    result = level.copy()
    for chosen in inside:
        _constrain(result, chosen, *_fitted(level.poses[chosen], up))
    state = result.optimize(config.graph, initialize="given").state
    if is_bent(level.state(), state, config.graph.robust_scale):
        return graph, f"{note}, but contradicts the lidar by more than its standard deviations"
    corrected_m = np.abs(state.poses[:, 2, 3] - level.poses[:, 2, 3]).max()
    return result, f"{note}; its height is corrected by up to {corrected_m:.2g} m"


@dataclass(frozen=True, slots=True)
class _Plane:
    """Poses ``first`` to ``last`` − 1, in ``parts`` of the path, that lie in a plane.

    rolls : whether they do not lie in one together with those before or after, which lie in one by themselves
    """

    first: int
    last: int
    parts: int
    rolls: bool = False


@dataclass(frozen=True, slots=True)
class _Test:
    """Test for planes, by a graph with the covariances of its errors.

    bounds : numbers of the poses between which the parts of the path are; drift : largest one, as ``_DRIFT``
    """

    graph: PoseGraph
    up: Vector
    bounds: Sequence[int]
    drift: float

    def planes(self, first: int, last: int) -> list[_Plane | None]:
        """The planes of these parts in order, the largest that pass; None for a part that fails by itself."""
        if last - first == 1:
            return [self._plane(*self.bounds[first : last + 1], parts=1)]
        middle = (first + last) // 2
        *before, one = self.planes(first, middle)
        other, *after = self.planes(middle, last)
        if one is None or other is None:
            return [*before, one, other, *after]
        both = self._plane(one.first, other.last, parts=one.parts + other.parts)
        if both is None:
            return [*before, replace(one, rolls=True), replace(other, rolls=True), *after]
        return [*before, replace(both, rolls=one.rolls or other.rolls), *after]

    def _plane(self, first: int, last: int, *, parts: int) -> _Plane | None:
        """The plane of poses; None where their edges contradict it, with a variance factor by their own misfit."""
        part, poses = self.graph.in_force(first, last), self.graph.poses[first:last]
        T_world_plane, up = _fitted(poses, self.up)
        away_m = (poses[:, :3, 3] - T_world_plane[:3, 3]) @ T_world_plane[:3, 2]
        if np.abs(away_m).max() > 3.0 * _UNEVEN[0] + self.drift * parts * _PART_M:
            return None
        free = part.optimize(GraphConfig(), initialize="given")
        _constrain(part, np.arange(len(part)), T_world_plane, up)
        state = part.optimize(GraphConfig(), initialize="given").state
        variance = max(free.chi2_after / max(free.state.degrees_of_freedom, 1), 1.0)
        is_flat = (state.chi2 - free.chi2_after) / variance < 3.0 * len(part) / _CORRELATED
        return _Plane(first, last, parts) if is_flat else None


def _fitted(poses: Matrix, up: Vector) -> tuple[Pose, Vector]:
    """T_world_plane of poses (N, 4, 4), its z the normal, and upward direction of the vehicle in it on average.

    The normal is that of the positions, and where they are on a line, by the mounting, ``up``.
    """
    T, mean = np.eye(4), (poses[:, :3, :3] @ up).mean(axis=0)
    T[:3, 3], R = poses[:, :3, 3].mean(axis=0), upright(mean / np.linalg.norm(mean))
    away = (poses[:, :3, 3] - T[:3, 3]) @ R.T
    H = away[:, :2].T @ away[:, :2] + np.eye(2) * (_UNEVEN[0] / MOUNTED_RAD) ** 2
    normal = R.T @ np.append(-np.linalg.solve(H, away[:, :2].T @ away[:, 2]), 1.0)
    T[:3, :3] = upright(normal / np.linalg.norm(normal)).T
    up = np.einsum("nji,j->i", poses[:, :3, :3], T[:3, 2])
    return T, up / np.linalg.norm(up)


def _constrain(graph: PoseGraph, chosen: Integers, T_world_plane: Pose, up: Vector) -> None:
    """Add priors of height and tilt of poses in a plane, the first time also of where in it the first pose is."""
    if not graph.is_of_origin.any():
        hold_first(graph, T_world_plane[:3, 2], height=False)
    across, none = np.outer(up, up), np.zeros((3, 3))
    of_plane = np.block([[across / _UNEVEN[0] ** 2, none], [none, (np.eye(3) - across) / _UNEVEN[1] ** 2]])
    Z = lie.inverse(T_world_plane) @ graph.poses[chosen]
    turns = np.zeros((len(Z), 6))
    turns[:, 3:] = np.cross(Z[:, :3, :3] @ up, [0.0, 0.0, 1.0])  # of small angles
    Z[:, :3, :3], Z[:, 2, 3] = lie.exp(turns)[:, :3, :3] @ Z[:, :3, :3], 0.0
    for k, T in zip(chosen.tolist(), T_world_plane @ Z, strict=True):
        graph.add_factor(Prior(), k, of_plane / _CORRELATED, T)
