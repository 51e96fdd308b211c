"""A run, a localized log or a merged map as one picture: trajectories over the map, seen from above."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.evaluation import on_the_estimate
from scanchain.evaluation.absolute import path_length
from scanchain.maps import open_saved_map, read_map, read_ply
from scanchain.runs.directory import TRUTH_FILE
from scanchain.trajectory import read_tum
from scanchain.verdict import Kind, Stretch
from scanchain_viz.colors import STRETCH_COLORS, TRUTH, color_of, palette_of
from scanchain_viz.pictures.figure import Floats, Plot, write_png
from scanchain_viz.pictures.maps import draw_points, extent, map_points

_WIDTH_INCHES = 8.0
_ODOMETRY, _OPTIMIZED = "#e07b00", "#1f5fd0"
_SHADES = ("#a9b1bd", "#747c88", "#14171b")  # of points in space, by height
Grid = tuple[NDArray[np.int8], float, tuple[float, float]]  # as ``read_map`` returns it


def draw_map(
    path: Path,
    *,
    title: str,
    optimized: Matrix,
    odometry: Matrix | None = None,
    ground_truth: Matrix | None = None,
    sessions: Sequence[tuple[str, Matrix]] = (),
    stretches: Sequence[Stretch] = (),
    points: NDArray[np.floating] | None = None,
    grid: Grid | None = None,
) -> None:
    """Draw trajectories (N, d+1, d+1) over a map, all in the world frame, to a PNG.

    sessions : names and poses of those of a merged map, instead of one trajectory
    stretches : to check, of the optimized trajectory
    points : (M, d) of the map; of a 3D one the height is the shade
    ground_truth : already aligned to the estimate
    """
    drawn = (optimized, odometry, ground_truth, *(poses for _, poses in sessions))
    paths = [path for path in drawn if path is not None and len(path)]
    low, high = _frame(paths, points, grid)
    figure = Plot.of_plan(low, high)
    if grid is not None:
        _draw_grid(figure, grid, low, high)
    if points is not None and len(points):
        draw_points(figure, lie.lift_points(points), low, high, _SHADES)
    _draw_path(figure, odometry, "odometry", _ODOMETRY, 1.0)
    _draw_path(figure, optimized, "optimized", _OPTIMIZED, 1.8)
    _draw_path(figure, ground_truth, "ground truth", TRUTH, 1.2, (4.0, 3.0))
    for number, (name, poses) in enumerate(sessions):
        _draw_path(figure, poses, name, color_of(number), 1.4)
    for each in stretches:
        if each.kind is not Kind.LOOPS:
            part = optimized[max(each.first - 1, 0) : each.last + 1, :2, -1]
            figure.line(part, STRETCH_COLORS[each.kind], 3.0, name=str(each.kind))
    for place, shape, name in ((0, "o", "start"), (-1, "s", "end")):
        if len(optimized):
            figure.marks(optimized[place, None, :2, -1], shape, _OPTIMIZED, 7.0, line=1.0, name=name)
    write_png(path, [(title, figure)], width_inches=_WIDTH_INCHES)


def _frame(paths: list[Matrix], points: NDArray[np.floating] | None, grid: Grid | None) -> tuple[Floats, Floats]:
    """Corners of the required view: every trajectory, the map without outliers, and a margin."""
    corners: list[NDArray[np.floating]] = [path[:, :2, -1] for path in paths]
    if points is not None and len(points):
        corners.append(np.array(extent(points[:, :2])))
    elif grid is not None:
        cells, resolution_m, origin_m = grid
        rows, columns = np.nonzero(cells > 0)
        if len(rows):
            seen = np.array(extent(np.stack([columns, rows], axis=-1).astype(np.float64)))
            corners.append(np.array(origin_m) + resolution_m * seen)
    known = np.concatenate(corners) if corners else np.zeros((1, 2))
    low, high = known.min(axis=0), known.max(axis=0)
    margin = max(0.04 * float((high - low).max()), 1.0)
    return low - margin, high + margin


def _draw_grid(figure: Plot, grid: Grid, low: Floats, high: Floats) -> None:
    """Free white, occupied dark, unknown a light gray, like the paper around the grid."""
    cells, resolution_m, origin_m = grid
    palette = np.vstack([palette_of((color,), 1) for color in ("#ffffff", "#262626", "#e6e6e6")])
    shades = np.where(cells < 0, 2, cells > 0).astype(np.uint8)
    figure.image(np.full((1, 1), 2, np.uint8), palette, low, high)
    first = np.array(origin_m)
    figure.image(shades, palette, first, first + resolution_m * np.array(shades.shape[::-1]))


def _draw_path(
    figure: Plot, poses: Matrix | None, name: str, color: str, width: float, dashes: Sequence[float] = ()
) -> None:
    """Draw one line, its length in the legend."""
    if poses is not None and len(poses):
        figure.line(poses[:, :2, -1], color, width, dashes, name=f"{name} ({path_length(poses)[-1]:.0f} m)")


def draw_evaluated(picture: Path, evaluated: Mapping[str, tuple[Matrix, Matrix]]) -> None:
    """Draw estimates (N, 4, 4), aligned, over the true poses (N, 4, 4) beside them, those of the longest one."""
    paths = [(name, aligned) for name, (aligned, _) in evaluated.items()]
    truth = max((reference for _, reference in evaluated.values()), key=len)
    draw_map(picture, title="Estimates and ground truth", optimized=truth[:0], sessions=paths, ground_truth=truth)


def draw_run(directory: Path, picture: Path) -> None:
    """Draw trajectories, ground truth and map to a PNG: the occupancy grid in 2D, the cloud in 3D.

    directory : of a run, a localized log or a merged map
    Raises InputError where it is none of these, or the picture cannot be written.
    """
    try:
        metrics = json.loads((directory / "metrics.json").read_bytes())
    except (OSError, ValueError):
        metrics = {}
    if "stretches" in metrics:
        drawn = _run(directory, metrics)
    elif "placed" in metrics:
        drawn = _localized(directory, metrics)
    elif "sessions" in metrics:
        names = [each["name"] for each in metrics["sessions"]]
        sessions = [(name, read_tum(directory / f"{name}.tum").poses) for name in names]
        drawn = {"optimized": np.empty((0, 4, 4)), "sessions": sessions, **_map(directory)}
    else:
        raise InputError(
            f"{directory}: holds no trajectory to draw; give the directory of a run, of localize or of merge, or "
            "open report.html"
        )
    try:
        draw_map(picture, title=directory.resolve().name, **drawn)
    except OSError as error:
        raise InputError(f"{picture}: not writable ({error.strerror}); choose another place") from error


def _run(directory: Path, metrics: dict[str, Any]) -> dict[str, Any]:
    """Arguments of ``draw_map`` for a run."""
    optimized, truth_file = read_tum(directory / "trajectory.tum"), directory / TRUTH_FILE
    truth = None
    if truth_file.exists():
        accuracy = metrics["ground_truth"] or {}
        truth = on_the_estimate(optimized, read_tum(truth_file), gap_s=accuracy.get("max_gap_s"))
    return {
        "optimized": optimized.poses,
        "odometry": read_tum(directory / "odometry.tum").poses,
        "ground_truth": None if truth is None else truth.poses,
        "stretches": msgspec.convert(metrics["stretches"], tuple[Stretch, ...]),
        **_map(directory),
    }


def _localized(directory: Path, metrics: dict[str, Any]) -> dict[str, Any]:
    """Arguments of ``draw_map`` for a localized log, over the map that it was sought in."""
    if not metrics["placed"]:
        raise InputError(f"{directory}: {metrics['reason']}; there is no trajectory to draw")
    prior = open_saved_map(Path(metrics["map"]))
    points = map_points(prior)[:, : prior.dimension]
    return {"optimized": read_tum(directory / "trajectory.tum").poses, "points": points}


def _map(directory: Path) -> dict[str, Any]:
    points = read_ply(directory / "map.ply")
    return {"points": points} if points[:, 2].any() else {"grid": read_map(directory)}
