"""Pose graphs written as g2o or TORO text, every number to its last digit."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from scanchain import checks, lie
from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.graph.files.g2o_lines import (
    EDGES,
    POINT,
    ROTATION_COMMENT,
    SIGHTING,
    TORO_EDGES,
    TORO_VERTICES,
    VERTICES,
    Rotation,
    to_toro_angles,
    to_toro_triangle,
)
from scanchain.graph.pose_graph import PoseGraph
from scanchain.whole_file import write_whole

TORO_SUFFIXES = (".graph", ".toro")
GRAPH_SUFFIXES = (".g2o", *TORO_SUFFIXES)

Chosen = Literal["in force", "rejected"]


def rejected_path(path: Path) -> Path:
    """The file beside a graph that holds its rejected edges: graph_rejected.g2o beside graph.g2o."""
    return path.with_name(f"{path.stem}_rejected{path.suffix}")


def write_g2o(
    path: Path | str,
    graph: PoseGraph,
    *,
    ids: NDArray[np.int64] | None = None,
    other_lines: Iterable[str] = (),
    edges: Chosen = "in force",
    rotation: Rotation = "vector",
    force: bool = False,
) -> None:
    """Write poses, points and edges with full information matrices; to .graph or .toro as TORO has them.

    ids : (K,) the vertex ids, by default 0, 1, …; FIX is written for poses that were held by name
    edges : those "in force" with their robust weight in Ω, so that the poses are the minimum of the file's own χ²
    rotation : of what Ω is in 3D, which the first line of the file says: "vector" for a rotation vector, as this
        package, GTSAM and published graphs have it, or "quaternion" for the vector part of the unit quaternion,
        half as long, as g2o itself has it
    force : whether a file that is there is replaced; else InputError, as for a graph with points in TORO
    """
    checks.instance(graph, PoseGraph, "graph", "read_g2o(path).graph")
    checks.one_of(rotation, get_args(Rotation), "rotation")
    path, d = checks.path(path, "path"), graph.dimension
    is_toro = path.suffix in TORO_SUFFIXES
    if is_toro and graph.is_point.any():
        raise InputError(f"{path}: TORO has no points, and the graph has {graph.is_point.sum()}; write .g2o")
    vertex, edge, rows_of = (
        (TORO_VERTICES[d], TORO_EDGES[d], _toro) if is_toro else (VERTICES[d], EDGES[d], _numbers)
    )
    names = (np.arange(len(graph)) if ids is None else ids).tolist()
    has_quaternions = d == 3 and not is_toro
    lines = [ROTATION_COMMENT[rotation]] if has_quaternions else []
    for name, row, is_point in zip(names, rows_of(graph.poses), graph.is_point.tolist(), strict=True):
        lines.append(f"{POINT} {name} {_text(row[:2])}" if is_point else f"{vertex} {name} {_text(row)}")
    lines += [f"FIX {names[index]}" for index in graph.held]
    chosen, triangles = _triangles(graph, edges, 2.0 if has_quaternions and rotation == "quaternion" else 1.0)
    pairs = graph.edges[chosen]
    sees = graph.is_point[pairs[:, 1]].tolist()
    rows = zip(pairs.tolist(), rows_of(graph.measurements[chosen]), triangles, sees, strict=True)
    for (i, j), row, upper, is_sighting in rows:
        tag, numbers = edge, [*row, *(to_toro_triangle(upper) if is_toro else upper)]
        if is_sighting:
            tag, numbers = SIGHTING, [*row[:2], upper[0], upper[1], upper[3]]
        lines.append(f"{tag} {names[i]} {names[j]} {_text(numbers)}")
    with checks.writing(path, force=force):
        write_whole(path, "\n".join([*lines, *other_lines, ""]).encode())


def _numbers(poses: Matrix) -> list[list[float]]:
    """Poses as rows x y θ, or x y z qx qy qz qw."""
    d = poses.shape[-1] - 1
    if d == 2:
        return np.column_stack([poses[:, :2, 2], lie.yaw(poses)]).tolist()
    return np.hstack([poses[:, :3, 3], lie.to_quaternion(poses[:, :3, :3])]).tolist()


def _toro(poses: Matrix) -> list[list[float]]:
    """Poses as rows x y θ, or x y z roll pitch yaw."""
    if poses.shape[-1] == 3:
        return _numbers(poses)
    return [[*T[:3, 3].tolist(), *to_toro_angles(T[:3, :3])] for T in poses]


def _triangles(graph: PoseGraph, edges: Chosen, per_turn: float) -> tuple[NDArray[np.bool_], list[list[float]]]:
    """Chosen edges, (E,), and Ω of these, upper triangle row by row; w Ω of those in force.

    per_turn : radians in a unit of rotation
    """
    upper = np.triu_indices(graph.freedom)
    units = lie.by_component(graph.freedom, 1.0, per_turn)
    triangles = (graph.information * np.outer(units, units))[:, upper[0], upper[1]]
    if edges == "rejected":
        return graph.is_rejected, triangles[graph.is_rejected].tolist()
    return ~graph.is_rejected, (graph.weight[:, None] * triangles)[~graph.is_rejected].tolist()


def _text(row: list[float]) -> str:
    """Shortest decimals that read back as the same numbers."""
    return " ".join(map(repr, row))
