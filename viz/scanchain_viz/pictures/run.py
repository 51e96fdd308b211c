"""A run, a localized log or a merged map as one picture: trajectories over the map, seen from above."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.evaluation import on_the_estimate
from scanchain.maps import open_saved_map, read_map, read_ply
from scanchain.runs.directory import TRUTH_FILE
from scanchain.trajectory import read_tum
from scanchain.verdict import Kind, Stretch
from scanchain_viz.pictures.figure import write_figure
from scanchain_viz.pictures.map_figures import extent, map_points
from scanchain_viz.pictures.trajectory_figures import TRUTH, color_of
from scanchain_viz.stretch_colors import STRETCH_COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH_INCHES = 8.0
_MAX_POINTS = 400_000
_ODOMETRY, _OPTIMIZED = "#e07b00", "#1f5fd0"
_POINTS = "#8a8f98"
_FREE, _OCCUPIED = 35, 65  # per cent of occupancy below which a cell is drawn white, and above which dark
_UNKNOWN = 0.90


@dataclass(frozen=True, slots=True)
class GridPicture:
    """An occupancy grid: cells (H, W) from 0 free to 100 occupied, −1 unknown; row 0 at the lowest y.

    ``origin_m`` : x, y of the outer corner of cells[0, 0]
    """

    cells: NDArray[np.int8]
    resolution_m: float
    origin_m: tuple[float, float]


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
    grid: GridPicture | None = None,
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
    figure, axes = _figure(low, high)
    if grid is not None:
        _draw_grid(axes, grid)
    if points is not None and len(points):
        _draw_points(axes, points)
    _draw_path(axes, odometry, "odometry", _ODOMETRY, "-", 1.0)
    _draw_path(axes, optimized, "optimized", _OPTIMIZED, "-", 1.8)
    _draw_path(axes, ground_truth, "ground truth", TRUTH, (0, (4, 3)), 1.2)
    for number, (name, poses) in enumerate(sessions):
        _draw_path(axes, poses, name, color_of(number), "-", 1.4)
    _mark_stretches(axes, optimized, stretches)
    _mark_ends(axes, optimized)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_title(title, loc="left", fontsize=11)
    if len(paths):
        axes.figure.legend(loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    write_figure(path, figure, dpi=150)


def _frame(
    paths: list[Matrix], points: NDArray[np.floating] | None, grid: GridPicture | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of the required view: every trajectory, the map without outliers, and a margin."""
    corners: list[NDArray[np.floating]] = [path[:, :2, -1] for path in paths]
    if points is not None and len(points):
        corners.append(np.array(extent(points[:, :2])))
    elif grid is not None:
        rows, columns = np.nonzero(grid.cells >= _OCCUPIED)
        if len(rows):
            seen = np.array(extent(np.stack([columns, rows], axis=-1).astype(np.float64)))
            corners.append(np.array(grid.origin_m) + grid.resolution_m * seen)
    known = np.concatenate(corners) if corners else np.zeros((1, 2))
    low, high = known.min(axis=0), known.max(axis=0)
    margin = max(0.04 * float((high - low).max()), 1.0)
    return low - margin, high + margin


def _figure(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[Figure, Axes]:
    """A figure in the proportions of the map."""
    from matplotlib.figure import Figure

    width, height = high - low
    figure = Figure(
        figsize=(_WIDTH_INCHES, float(np.clip(_WIDTH_INCHES * height / width, 3.0, 12.0))), layout="constrained"
    )
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.tick_params(labelsize=9, color="#999999")
    for spine in axes.spines.values():
        spine.set_color("#cccccc")
    return figure, axes


def _draw_grid(axes: Axes, grid: GridPicture) -> None:
    """Free white, occupied dark, unknown a light gray, like the paper around the grid."""
    share = np.clip((grid.cells - float(_FREE)) / (_OCCUPIED - _FREE), 0.0, 1.0)
    shade = np.where(grid.cells < 0, _UNKNOWN, 1.0 - 0.85 * share)
    axes.set_facecolor((_UNKNOWN, _UNKNOWN, _UNKNOWN))
    rows, columns = grid.cells.shape
    (x, y), size_m = grid.origin_m, grid.resolution_m
    extent = (x, x + size_m * columns, y, y + size_m * rows)
    axes.imshow(shade, cmap="gray", vmin=0.0, vmax=1.0, origin="lower", extent=extent, interpolation="antialiased")


def _draw_points(axes: Axes, points: NDArray[np.floating]) -> None:
    shown = points[:: max(1, -(-len(points) // _MAX_POINTS))]
    size = float(np.clip(60_000.0 / len(shown), 0.15, 2.0))
    if points.shape[1] == 2:
        axes.scatter(shown[:, 0], shown[:, 1], s=size, c=_POINTS, linewidths=0, rasterized=True)
        return
    low, high = np.percentile(shown[:, 2], (2.0, 98.0))
    order = np.argsort(shown[:, 2])
    axes.scatter(
        shown[order, 0], shown[order, 1], s=size, c=shown[order, 2], cmap="bone_r",
        vmin=low - 0.6 * (high - low), vmax=high, linewidths=0, rasterized=True,
    )  # fmt: skip


def _draw_path(
    axes: Axes, poses: Matrix | None, name: str, color: str, style: str | tuple[int, tuple[int, int]], width: float
) -> None:
    """Draw one line, its length in the legend."""
    if poses is None or not len(poses):
        return
    x, y = poses[:, 0, -1], poses[:, 1, -1]
    length_m = float(np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1).sum())
    axes.plot(x, y, color=color, linestyle=style, linewidth=width, label=f"{name} ({length_m:.0f} m)")


def _mark_stretches(axes: Axes, poses: Matrix, stretches: Sequence[Stretch]) -> None:
    """Draw stretches over their trajectory, each kind once in the legend."""
    for kind, color in STRETCH_COLORS.items():
        chosen = [each for each in stretches if each.kind is kind and each.kind is not Kind.LOOPS]
        parts = [poses[max(each.first - 1, 0) : each.last + 1, :2, -1] for each in chosen]
        for place, part in enumerate(parts):
            label = str(kind) if place == 0 else None
            axes.plot(*part.T, color=color, linewidth=3.0, solid_capstyle="round", label=label)


def _mark_ends(axes: Axes, poses: Matrix) -> None:
    if not len(poses):
        return
    marks = {"color": _OPTIMIZED, "linestyle": "none", "markersize": 7, "markerfacecolor": "none"}
    axes.plot(*poses[0, :2, -1], marker="o", label="start", **marks)
    axes.plot(*poses[-1, :2, -1], marker="s", label="end", **marks)


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
    return {"points": points} if points[:, 2].any() else {"grid": GridPicture(*read_map(directory))}
