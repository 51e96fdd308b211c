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
from scanchain.errors import InputError, counted
from scanchain.graph.edge_checks import nearest_semidefinite, positive_semidefinite
from scanchain.graph.files.g2o_lines import G2oLines, Rotation, Rows, sort_lines
from scanchain.graph.initialize import follow_odometry
from scanchain.graph.pose_graph import PoseGraph

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
    edges, dimension = lines.edges, lines.dimension
    ids, is_point, poses = _vertices(path, lines)
    pairs = _indices(path, edges.lines, edges.ids, ids)
    sees_none = np.stack([is_point[pairs[:, 0]], is_point[pairs[:, 1]] != edges.is_point], axis=1)
    _refuse_unknown(path, edges.lines, edges.ids, sees_none)
    for bad in np.flatnonzero(pairs[:, 0] == pairs[:, 1])[:1]:
        i, j = edges.ids[bad]
        raise InputError(f"{path}:{edges.lines[bad]}: edge {i}-{j} joins a vertex to itself; remove it")
    held = np.array(lines.fixed, np.int64).reshape(-1, 2)
    fixed = _indices(path, held[:, 0], held[:, 1:], ids)[:, 0]
    measurements, information = _poses(path, edges, dimension), _information(edges, dimension)
    if dimension == 3 and (rotation or lines.rotation) == "quaternion":
        units = lie.by_component(6, 1.0, 0.5)
        information *= np.outer(units, units)
    projection = _project(path, edges, information, indefinite)
    has_guess = bool(len(lines.vertices.ids))
    if not has_guess:
        chain, to_points = ~edges.is_point, edges.is_point
        is_held = np.isin(np.arange(len(ids)), fixed if len(fixed) else 0)
        poses = follow_odometry(poses, is_held, pairs[chain], measurements[chain])
        i, j = pairs[to_points].T
        poses[j, :-1, -1] = (poses[i] @ measurements[to_points])[:, :-1, -1]
    graph = PoseGraph(dimension, ids)
    for pose, point, stamp in zip(poses, is_point.tolist(), ids.tolist(), strict=True):
        graph.add_point(pose[:-1, -1], stamp) if point else graph.add_pose(pose, stamp)
    is_robust = (loops == "robust") & (np.abs(pairs[:, 0] - pairs[:, 1]) != 1) & ~edges.is_point
    graph.add_edges(pairs, measurements, information, is_robust)
    for index in fixed.tolist():
        graph.fix(index)
    note = _degrees_note(lines.turns)
    if note:
        warnings.warn(f"{path}: {note}", stacklevel=2)
    return G2oFile(graph, ids, tuple(lines.others), has_guess, projection, note)


def _degrees_note(turns: list[tuple[int, float]]) -> str:
    """That angles lie beyond a whole turn, by the largest; empty where none does."""
    if not turns:
        return ""
    line, largest = max(turns, key=lambda turn: turn[1])
    return (
        f"{counted(len(turns), 'line has', 'lines have')} an angle beyond a whole turn, up to {largest:.6g} in "
        f"line {line}; degrees? they are taken as radians"
    )


def _project(path: Path, edges: Rows, information: Matrix, indefinite: Indefinite) -> Projection | None:
    """Replace indefinite matrices (E, k, k) by the nearest semidefinite ones, and warn of the change."""
    bad = np.flatnonzero(~positive_semidefinite(information))
    if not len(bad):
        return None
    (i, j), line = edges.ids[bad[0]], edges.lines[bad[0]]
    if indefinite == "refuse":
        raise InputError(
            f"{path}:{line}: information matrix of edge {i}-{j} is not positive semidefinite, the first of "
            f"{len(bad):,}; give the upper triangle of an inverse covariance, or have it projected"
        )
    before, nearest = information[bad], nearest_semidefinite(information[bad])
    information[bad] = nearest
    off = np.linalg.norm(nearest - before, axis=(1, 2)) / np.linalg.norm(before, axis=(1, 2))
    first = f"{i}-{j} in line {line}"
    projection = Projection(len(bad), len(edges.ids), float(np.median(off)), float(off.max()), first)
    warnings.warn(projection.text, stacklevel=3)
    return projection


def _vertices(path: Path, lines: G2oLines) -> tuple[NDArray[np.int64], NDArray[np.bool_], Matrix]:
    """Ids (K,), those of poses and then those of points, ascending, which are points, and poses (K, d+1, d+1).

    Without vertex lines those of the edges, at the identity.
    """
    vertices, edges = lines.vertices, lines.edges
    if not len(vertices.ids):
        seen = edges.ids[edges.is_point]
        of_poses, of_points = np.unique(np.append(edges.ids[~edges.is_point], seen[:, 0])), np.unique(seen[:, 1])
        ids, is_point = np.append(of_poses, of_points), np.arange(len(of_poses) + len(of_points)) >= len(of_poses)
        poses = np.tile(lie.identity(lines.dimension), (len(ids), 1, 1))
    else:
        order = np.lexsort((vertices.ids[:, 0], vertices.is_point))
        ids, is_point, poses = (
            vertices.ids[order, 0],
            vertices.is_point[order],
            _poses(path, vertices, lines.dimension)[order],
        )
        again = order[1:][(ids[1:] == ids[:-1]) & (is_point[1:] == is_point[:-1])]
        for row in np.sort(again)[:1]:
            raise InputError(
                f"{path}:{vertices.lines[row]}: vertex {vertices.ids[row, 0]} stands in the file twice; remove one"
            )
    for name in np.intersect1d(ids[is_point], ids[~is_point])[:1]:
        raise InputError(f"{path}: vertex {name} is a pose and a point; give each an id of its own")
    return ids, is_point, poses


def _indices(
    path: Path, lines: NDArray[np.int64], names: NDArray[np.int64], ids: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Indices (n, w) of vertices by their names among ``ids`` (K,), of lines (n,) that name them."""
    order = np.argsort(ids)
    indices = order[np.minimum(np.searchsorted(ids, names, sorter=order), len(ids) - 1)]
    _refuse_unknown(path, lines, names, ids[indices] != names)
    return indices


def _refuse_unknown(
    path: Path, lines: NDArray[np.int64], names: NDArray[np.int64], unknown: NDArray[np.bool_]
) -> None:
    for row, column in np.argwhere(unknown)[:1]:
        raise InputError(
            f"{path}:{lines[row]}: vertex {names[row, column]} is not in the file; add its VERTEX line"
        )


def _information(edges: Rows, dimension: int) -> Matrix:
    """Information matrices (E, k, k) of the upper triangles that the rows end with."""
    k = 3 if dimension == 2 else 6
    information = np.zeros((len(edges.ids), k, k))
    a, b = np.triu_indices(k)
    information[:, a, b] = information[:, b, a] = edges.numbers[:, -len(a) :]
    return information


def _poses(path: Path, rows: Rows, d: int) -> Matrix:
    """Poses (n, d+1, d+1) that rows x y θ, or x y z qx qy qz qw, begin with; quaternions are normalized."""
    numbers = rows.numbers
    result = np.tile(lie.identity(d), (len(numbers), 1, 1))
    result[:, :d, d] = numbers[:, :d]
    if d == 2:
        result[:, 0, 0] = result[:, 1, 1] = np.cos(numbers[:, 2])
        result[:, 1, 0] = np.sin(numbers[:, 2])
        result[:, 0, 1] = -result[:, 1, 0]
        return result
    for bad in np.flatnonzero(np.linalg.norm(numbers[:, 3:7], axis=1) < 1e-6)[:1]:
        raise InputError(f"{path}:{rows.lines[bad]}: quaternion of length 0; write qx qy qz qw, 0 0 0 1 for none")
    result[:, :3, :3] = lie.from_quaternion(numbers[:, 3:7])
    return result
