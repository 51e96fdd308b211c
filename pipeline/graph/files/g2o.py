"""Pose graphs read from g2o text (SE2, SE3:QUAT, XY, SE2_XY, FIX) or TORO's; other lines are retained."""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanchain import checks, lie
from scanchain.data import Matrix, brief
from scanchain.errors import InputError
from scanchain.graph.edge_checks import nearest_semidefinite, positive_semidefinite
from scanchain.graph.files.g2o_lines import POSE_NUMBERS, TRIANGLE, G2oLines, Rotation, Rows, sort_lines
from scanchain.graph.initialize import follow_odometry
from scanchain.graph.pose_graph import PoseGraph
from scanchain.words import counted

Indefinite = Literal["project", "refuse"]


@dataclass(frozen=True, slots=True)
class Projection:
    """Edges of a file with an indefinite information matrix, and the change by projecting it.

    Attributes
    ----------
    edges, of : how many edges, of how many
    median, most : ‖Ω − Ω₊‖ / ‖Ω‖ of these, Frobenius
    first : the first of them, by its vertices and its line
    """

    edges: int
    of: int
    median: float
    most: float
    first: str

    @property
    def text(self) -> str:
        """The projection as one line of text."""
        return (
            f"{self.edges:,} of {self.of:,} edges have an indefinite information matrix, which is no inverse "
            "covariance; each was projected to the nearest positive semidefinite one, which changed it by "
            f"{100.0 * self.median:.3g} % of its norm (median), {100.0 * self.most:.3g} % at most; "
            f"first {self.first}"
        )


@dataclass(frozen=True, slots=True)
class G2oFile:
    """A pose graph as read.

    Attributes
    ----------
    graph : the poses in the order of their ids, then the points in that of theirs; the stamp of each is its id
    ids : (K,) the file's vertex ids
    other_lines : lines about neither poses nor edges, retained to be written again
    has_guess : whether the file holds vertices; else the graph's poses follow its odometry
    projection : of the indefinite information matrices; None without any
    note : warning that angles may be degrees; empty where they are radians
    """

    __repr__ = brief
    graph: PoseGraph
    ids: NDArray[np.int64]
    other_lines: tuple[str, ...]
    has_guess: bool
    projection: Projection | None
    note: str = ""

    @property
    def other_tags(self) -> tuple[tuple[str, int], ...]:
        """Tags that are not supported, with the number of lines of each."""
        return tuple(Counter(line.split(maxsplit=1)[0] for line in self.other_lines).items())


def read_g2o(
    path: Path | str,
    *,
    loops: Literal["quadratic", "robust"] = "quadratic",
    indefinite: Indefinite = "project",
    rotation: Rotation | None = None,
) -> G2oFile:
    """Read a graph.

    loops : "robust" marks edges between poses that do not follow each other for the robust loss
    indefinite : what to do about indefinite information matrices: "project" each to the nearest positive
        semidefinite one and warn, or "refuse" the file
    rotation : of what the information is in 3D, as in ``write_g2o``; as the file says, else "vector"
    """
    path = checks.path(path, "path")
    lines = sort_lines(path)
    dimension = lines.dimension
    pose_ids, poses = _vertices(path, lines)
    point_ids, points = _points(path, lines, pose_ids)
    ids = np.concatenate([pose_ids, point_ids])
    pairs = _places(path, lines.edges, 2, pose_ids)
    measurements, information = _measurements(path, lines.edges, dimension)
    if dimension == 3 and (rotation or lines.rotation) == "quaternion":
        units = lie.by_component(6, 1.0, 0.5)
        information *= np.outer(units, units)
    sightings, seen, certainty = _sightings(path, lines.sightings, pose_ids, point_ids)
    bad = [
        _indefinite(path, *rows, indefinite) for rows in ((lines.edges, information), (lines.sightings, certainty))
    ]
    projection = _project(bad, len(pairs) + len(sightings))
    fixed = _places(path, lines.fixed, 1, ids)[:, 0]
    if not lines.vertices.ids:
        held = np.isin(np.arange(len(pose_ids)), fixed if len(fixed) else 0)
        poses = follow_odometry(poses, held, pairs, measurements)
        from_i = poses[sightings[:, 0]]
        points[sightings[:, 1] - len(poses)] = (from_i[:, :2, :2] @ seen[..., None])[..., 0] + from_i[:, :2, 2]
    graph = PoseGraph(dimension, ids)
    for pose, stamp in zip(poses, pose_ids.tolist(), strict=True):
        graph.add_pose(pose, stamp)
    for point, stamp in zip(points, point_ids.tolist(), strict=True):
        graph.add_point(point, stamp)
    is_robust = (loops == "robust") & (np.abs(pairs[:, 0] - pairs[:, 1]) != 1)
    graph.add_edges(pairs, measurements, information, is_robust)
    if len(sightings):
        graph.add_sightings(sightings, seen, certainty)
    for index in fixed.tolist():
        graph.fix(index)
    note = _degrees_note(lines.turns)
    if note:
        warnings.warn(f"{path}: {note}", stacklevel=2)
    return G2oFile(graph, ids, tuple(lines.others), bool(lines.vertices.ids), projection, note)


def _degrees_note(turns: list[tuple[int, float]]) -> str:
    """That angles lie beyond a whole turn, by the largest; empty where none does."""
    if not turns:
        return ""
    line, largest = max(turns, key=lambda turn: turn[1])
    return (
        f"{counted(len(turns), 'line has', 'lines have')} an angle beyond a whole turn, up to {largest:.6g} in "
        f"line {line}; degrees? they are taken as radians"
    )


@dataclass(frozen=True, slots=True)
class _Indefinite:
    """Indefinite information matrices: all of their kind (E, k, k), which of them, and where the first stands."""

    information: Matrix
    which: NDArray[np.int64]
    first: str


def _indefinite(path: Path, rows: Rows, information: Matrix, indefinite: Indefinite) -> _Indefinite:
    which = np.flatnonzero(~positive_semidefinite(information))
    first = ""
    if len(which):
        (i, j), line = rows.ids[which[0]], rows.lines[which[0]]
        first = f"{i}-{j} in line {line}"
        if indefinite == "refuse":
            raise InputError(
                f"{path}:{line}: information matrix of edge {i}-{j} is not positive semidefinite, the first of "
                f"{len(which):,}; give the upper triangle of an inverse covariance, or have it projected"
            )
    return _Indefinite(information, which, first)


def _project(kinds: list[_Indefinite], edges: int) -> Projection | None:
    """Replace indefinite matrices by the nearest semidefinite ones, with a warning; returns the changes."""
    off = []
    for kind in kinds:
        before = kind.information[kind.which]
        kind.information[kind.which] = nearest_semidefinite(before)
        difference = np.linalg.norm(kind.information[kind.which] - before, axis=(1, 2))
        off += (difference / np.linalg.norm(before, axis=(1, 2))).tolist()
    if not off:
        return None
    first = next(kind.first for kind in kinds if kind.first)
    projection = Projection(len(off), edges, float(np.median(off)), max(off), first)
    warnings.warn(projection.text, stacklevel=3)
    return projection


def _vertices(path: Path, lines: G2oLines) -> tuple[NDArray[np.int64], Matrix]:
    """Return ids, ascending, and poses; without vertex lines the ids of the edges, at the identity."""
    if not lines.vertices.ids:
        ids = np.unique(np.append(lines.edges.ids_array(2), lines.sightings.ids_array(2)[:, 0]))
        return ids, np.tile(lie.identity(lines.dimension), (len(ids), 1, 1))
    ids, first = np.unique(lines.vertices.ids_array(1)[:, 0], return_index=True)
    again = np.setdiff1d(np.arange(len(lines.vertices.ids)), first)
    if len(again):
        line, name = lines.vertices.lines[again[0]], lines.vertices.ids[again[0]][0]
        raise InputError(f"{path}:{line}: vertex {name} stands in the file twice; remove one")
    return ids, _poses(path, lines.vertices, lines.vertices.numbers_array(POSE_NUMBERS[lines.dimension]))[first]


def _points(
    path: Path, lines: G2oLines, pose_ids: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return ids, ascending, and positions (L, 2) of the points; without vertex lines those seen, at 0."""
    if not lines.vertices.ids:
        ids = np.unique(lines.sightings.ids_array(2)[:, 1])
        first, points = np.arange(len(ids)), np.zeros((len(ids), 2))
    else:
        names, points = lines.points.ids_array(1)[:, 0], lines.points.numbers_array(2)
        ids, first = np.unique(names, return_index=True)
        for again in np.setdiff1d(np.arange(len(names)), first)[:1]:
            raise InputError(f"{path}:{lines.points.lines[again]}: vertex {names[again]} stands in the file twice")
    for name in np.intersect1d(ids, pose_ids)[:1]:
        raise InputError(f"{path}: vertex {name} is a pose and a point; give each an id of its own")
    return ids, points[first]


def _sightings(
    path: Path, rows: Rows, pose_ids: NDArray[np.int64], point_ids: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], Matrix]:
    """Pose and point indices (S, 2), positions (S, 2) in the pose's frame and information (S, 2, 2)."""
    names, numbers = rows.ids_array(2), rows.numbers_array(5)
    single = [Rows(rows.lines, [[name] for name in names[:, end].tolist()]) for end in (0, 1)]
    i, j = _places(path, single[0], 1, pose_ids)[:, 0], _places(path, single[1], 1, point_ids)[:, 0]
    information = numbers[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    return np.stack([i, j + len(pose_ids)], axis=1), numbers[:, :2], information


def _places(path: Path, rows: Rows, width: int, ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pose indices (n, width) of the vertices that these lines name."""
    names, order = rows.ids_array(width), np.argsort(ids)
    if not names.size:
        return names
    places = order[np.minimum(np.searchsorted(ids, names, sorter=order), len(ids) - 1)] if len(ids) else names * 0
    unknown = np.argwhere(ids[places] != names if len(ids) else np.ones_like(names))
    if len(unknown):
        row, column = unknown[0]
        raise InputError(
            f"{path}:{rows.lines[row]}: vertex {names[row, column]} is not in the file; add its VERTEX line"
        )
    return places


def _measurements(path: Path, rows: Rows, dimension: int) -> tuple[Matrix, Matrix]:
    """Relative poses (E, d+1, d+1) and information matrices (E, k, k) of the edges."""
    values, k = POSE_NUMBERS[dimension], 3 if dimension == 2 else 6
    numbers = rows.numbers_array(values + TRIANGLE[dimension])
    information = np.zeros((len(numbers), k, k))
    upper = np.triu_indices(k)
    information[:, upper[0], upper[1]] = information[:, upper[1], upper[0]] = numbers[:, values:]
    for i, j in rows.ids_array(2)[rows.ids_array(2)[:, 0] == rows.ids_array(2)[:, 1]][:1]:
        line = rows.lines[rows.ids.index([i, j])]
        raise InputError(f"{path}:{line}: edge {i}-{j} joins a vertex to itself; remove it")
    return _poses(path, rows, numbers[:, :values]), information


def _poses(path: Path, rows: Rows, numbers: Matrix) -> Matrix:
    """Poses of rows x y θ, or x y z qx qy qz qw; quaternions are normalized."""
    d = 2 if numbers.shape[1] == 3 else 3
    result = np.tile(lie.identity(d), (len(numbers), 1, 1))
    result[:, :d, d] = numbers[:, :d]
    if d == 2:
        result[:, 0, 0] = result[:, 1, 1] = np.cos(numbers[:, 2])
        result[:, 1, 0] = np.sin(numbers[:, 2])
        result[:, 0, 1] = -result[:, 1, 0]
        return result
    for bad in np.flatnonzero(np.linalg.norm(numbers[:, 3:], axis=1) < 1e-6)[:1]:
        raise InputError(f"{path}:{rows.lines[bad]}: quaternion of length 0; write qx qy qz qw, 0 0 0 1 for none")
    result[:, :3, :3] = lie.from_quaternion(numbers[:, 3:])
    return result
