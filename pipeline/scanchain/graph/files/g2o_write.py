"""Pose graphs written as g2o or TORO text."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from scanchain import checks, lie
from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.files import write_whole
from scanchain.graph.files.g2o_lines import ROTATION_COMMENT, Rotation, write_lines
from scanchain.graph.pose_graph import PoseGraph

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
    names = np.arange(len(graph)) if ids is None else ids
    has_quaternions = d == 3 and not is_toro
    chosen = graph.is_rejected if edges == "rejected" else ~graph.is_rejected
    pairs = graph.edges[chosen]
    units = lie.by_component(graph.freedom, 1.0, 2.0 if has_quaternions and rotation == "quaternion" else 1.0)
    weight = np.ones(len(pairs)) if edges == "rejected" else graph.weight[chosen]
    information = weight[:, None, None] * (graph.information[chosen] * np.outer(units, units))
    triangles = information[:, *np.triu_indices(graph.freedom)]
    of_edges = np.hstack([_numbers(graph.measurements[chosen]), triangles])
    lines = [ROTATION_COMMENT[rotation]] if has_quaternions else []
    lines += write_lines(d, names[:, None], _numbers(graph.poses), graph.is_point, is_toro=is_toro)
    lines += [f"FIX {names[index]}" for index in graph.held]
    lines += write_lines(d, names[pairs], of_edges, graph.is_point[pairs[:, 1]], is_toro=is_toro)
    with checks.writing(path, force=force):
        write_whole(path, "\n".join([*lines, *other_lines, ""]).encode())


def _numbers(poses: Matrix) -> Matrix:
    """Poses as rows x y θ, or x y z qx qy qz qw."""
    d = poses.shape[-1] - 1
    if d == 2:
        return np.column_stack([poses[:, :2, 2], lie.yaw(poses)])
    return np.hstack([poses[:, :3, 3], lie.to_quaternion(poses[:, :3, :3])])
