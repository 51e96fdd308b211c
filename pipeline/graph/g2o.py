"""Pose graphs as g2o text: SE2 and SE3:QUAT vertices and edges, FIX; other lines are kept as they are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.data import Matrix
from pipeline.errors import InputError
from pipeline.graph.g2o_lines import EDGES, POSE_NUMBERS, TRIANGLE, VERTICES, G2oLines, Rows, sort_lines
from pipeline.graph.initialise import follow_odometry
from pipeline.graph.pose_graph import PoseGraph
from pipeline.graph.soundness import positive_semidefinite


@dataclass(frozen=True, slots=True)
class G2oFile:
    """A pose graph as read.

    Attributes
    ----------
    graph : the poses in the order of their ids; the stamp of each is its id
    ids : (K,) the file's vertex ids
    other_lines : lines that say nothing about poses and edges, kept to be written again
    has_guess : whether the file holds vertices; else the graph's poses follow its odometry
    """

    graph: PoseGraph
    ids: NDArray[np.int64]
    other_lines: tuple[str, ...]
    has_guess: bool

    @property
    def other_tags(self) -> tuple[tuple[str, int], ...]:
        """Tags that were not understood, with how many lines of each."""
        return tuple(Counter(line.split(maxsplit=1)[0] for line in self.other_lines).items())


def read_g2o(path: Path | str, *, loops: Literal["trusted", "suspect"] = "trusted") -> G2oFile:
    """Read a graph; "suspect" marks edges between poses that do not follow each other for the robust loss."""
    path = Path(path)
    lines = sort_lines(path)
    dimension = lines.dimension
    ids, poses = _vertices(path, lines)
    pairs = _places(path, lines.edges, 2, ids)
    measurements, information = _measurements(path, lines.edges, dimension)
    fixed = _places(path, lines.fixed, 1, ids)[:, 0]
    if not lines.vertices.ids:
        held = np.isin(np.arange(len(ids)), fixed if len(fixed) else 0)
        poses = follow_odometry(poses, held, pairs, measurements)
    graph = PoseGraph(dimension)
    for pose, stamp in zip(poses, ids.tolist(), strict=True):
        graph.add_pose(pose, stamp)
    suspect = (loops == "suspect") & (np.abs(pairs[:, 0] - pairs[:, 1]) != 1)
    graph.add_edges(pairs, measurements, information, suspect)
    for index in fixed.tolist():
        graph.fix(index)
    return G2oFile(graph, ids, tuple(lines.others), bool(lines.vertices.ids))


def write_graph(path: Path, graph: PoseGraph, *, ids: NDArray[np.int64], other_lines: Iterable[str] = ()) -> None:
    """Write a g2o file, or a TORO one where the name ends in .graph or .toro."""
    try:
        write_g2o(path, graph, ids=ids, other_lines=other_lines)
    except OSError as error:
        raise InputError(f"{path}: not writable ({error.strerror}); choose another place") from error


def write_g2o(
    path: Path | str,
    graph: PoseGraph,
    *,
    ids: NDArray[np.int64] | None = None,
    other_lines: Iterable[str] = (),
) -> None:
    """Write poses and edges with full information matrices, every number to its last digit.

    ids (K,) are the vertex ids, by default 0, 1, …; FIX is written for poses that were held by name.
    """
    d = graph.dimension
    names = (np.arange(len(graph)) if ids is None else ids).tolist()
    upper = np.triu_indices(graph.freedom)
    numbers = np.hstack([_numbers(graph.measurements), graph.information[:, upper[0], upper[1]]])
    lines = [f"{VERTICES[d]} {name} {_text(row)}" for name, row in zip(names, _numbers(graph.poses), strict=True)]
    lines += [f"FIX {names[index]}" for index in graph.held]
    for (i, j), row in zip(graph.edges.tolist(), numbers, strict=True):
        lines.append(f"{EDGES[d]} {names[i]} {names[j]} {_text(row)}")
    lines += other_lines
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _vertices(path: Path, lines: G2oLines) -> tuple[NDArray[np.int64], Matrix]:
    """Return ids, ascending, and poses; without vertex lines the ids of the edges, at the identity."""
    if not lines.vertices.ids:
        ids = np.unique(lines.edges.ids_array(2))
        return ids, np.tile(lie.identity(lines.dimension), (len(ids), 1, 1))
    ids, first = np.unique(lines.vertices.ids_array(1)[:, 0], return_index=True)
    again = np.setdiff1d(np.arange(len(lines.vertices.ids)), first)
    if len(again):
        line, name = lines.vertices.lines[again[0]], lines.vertices.ids[again[0]][0]
        raise InputError(f"{path}:{line}: vertex {name} stands in the file twice; remove one")
    return ids, _poses(path, lines.vertices, lines.vertices.numbers_array(POSE_NUMBERS[lines.dimension]))[first]


def _places(path: Path, rows: Rows, width: int, ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pose indices (n, width) of the vertices that these lines name."""
    names = rows.ids_array(width)
    places = np.minimum(np.searchsorted(ids, names), len(ids) - 1)
    unknown = np.argwhere(ids[places] != names)
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
    for bad in np.flatnonzero(~positive_semidefinite(information))[:1]:
        i, j = rows.ids[bad]
        raise InputError(
            f"{path}:{rows.lines[bad]}: information matrix of edge {i}-{j} is not positive semidefinite;"
            " give the upper triangle of an inverse covariance"
        )
    for i, j in rows.ids_array(2)[rows.ids_array(2)[:, 0] == rows.ids_array(2)[:, 1]][:1]:
        line = rows.lines[rows.ids.index([i, j])]
        raise InputError(f"{path}:{line}: edge {i}-{j} joins a vertex to itself; remove it")
    return _poses(path, rows, numbers[:, :values]), information


def _poses(path: Path, rows: Rows, numbers: Matrix) -> Matrix:
    """Poses of rows x y θ, or x y z qx qy qz qw; quaternions are normalised."""
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


def _numbers(poses: Matrix) -> Matrix:
    """Poses as rows x y θ, or x y z qx qy qz qw."""
    d = poses.shape[-1] - 1
    if d == 2:
        return np.column_stack([poses[:, :2, 2], lie.yaw(poses)])
    return np.hstack([poses[:, :3, 3], lie.to_quaternion(poses[:, :3, :3])])


def _text(row: NDArray[np.float64]) -> str:
    """Shortest decimals that read back as the same numbers."""
    return " ".join(map(repr, row.tolist()))
