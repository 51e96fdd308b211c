"""Maps seen from above with trajectories over them: as figures of a page, or as a PNG file of a run or a merge."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Points
from scanchain.errors import InputError
from scanchain.evaluation import on_the_estimate, path_length
from scanchain.maps import SavedMap, open_saved_map, read_map, read_ply
from scanchain.runs.directory import TRUTH_FILE
from scanchain.trajectory import read_tum
from scanchain.verdict import Kind, Segment
from scanchain_viz.colors import ODOMETRY, OPTIMIZED, TRUTH, color_of, color_of_kind, height_shares, palette_of
from scanchain_viz.pictures.axis import MARGIN
from scanchain_viz.pictures.figure import DASHED, INK, MIDDLE, Floats, Line, Plot, around, write_png

Grid = tuple[NDArray[np.int8], float, tuple[float, float]]  # as ``read_map`` returns it

GRAY = "#808893"  # of points of a map beneath lines
VIRIDIS = (
    "440154", "48186a", "472d7b", "424086", "3b528b", "33638d", "2c728e", "26828e", "21918c", "1fa088", "28ae80",
    "3fbc73", "5ec962", "84d44b", "addc30", "d8e219", "fde725",
)  # fmt: skip
_REACH = 0.5  # share of the range of ``MIDDLE`` beyond which a point of a map is an outlier
_NO_POINTS = np.empty((0, 3))
_INKS = ("#a9b1bd", "#747c88", "#14171b")  # of 3D points, by height
_MOST_POINTS = 120_000  # drawn of a map; further ones are left out


def surroundings(positions: NDArray[np.floating], clouds: Sequence[Points]) -> tuple[Floats, Floats]:
    """Corners (3,) around positions (N, 3) and, except for outliers, the points of maps (M, 3) with a margin."""
    boxes = np.array([extent(points) for points in clouds if len(points)]).reshape(-1, 2, 3)
    boxes += MARGIN * np.ptp(boxes, axis=1, keepdims=True) * np.array([[-1.0], [1.0]])
    held = np.concatenate([positions, *boxes])
    return held.min(axis=0), held.max(axis=0)


def extent(points: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Corners (d,) of a map (M, d) without outliers: few points, far outside of the middle 99 % along any axis."""
    low, high = np.percentile(points, MIDDLE, axis=0)
    size = high - low
    size[:2] = size[:2].max()
    inside = points[((points >= low - _REACH * size) & (points <= high + _REACH * size)).all(axis=1)]
    low, high = np.percentile(inside, (0.05, 99.95), axis=0)  # all but few
    return low, high


def map_points(prior: SavedMap) -> list[Points]:
    """Points (M, 3) sampled from each keyframe of a map, in its frame."""
    each = max(_MOST_POINTS // max(len(prior.keyframes), 1), 1)
    clouds = []
    for keyframe in prior.keyframes:
        points = keyframe.points
        some = lie.transform(keyframe.T_odom_lidar, points[:: max(1, -(-len(points) // each))])
        clouds.append(lie.lift_points(some))
    return clouds


def over_map(
    lines: Sequence[Line],
    points: Points,
    low: Floats,
    high: Floats,
    *,
    grid: Grid | None = None,
    colors: Sequence[str] = (GRAY,),
    path: Floats | None = None,
    is_wide: bool = False,
) -> Plot:
    """Lines over a map, seen from above, within corners.

    points : (M, 3) of the map, in one color or, if they differ in height, in several from low to high
    path : (N, 3) its start is outlined by a circle, its end by a square; a short path stays visible over them
    """
    figure = Plot.of_plan(low, high, is_wide=is_wide)
    if grid is not None:
        _draw_grid(figure, grid, low, high)
    draw_points(figure, points, low, high, colors)
    for place, shape, name in ((slice(1), "o", "start"), (slice(-1, None), "s", "end")):
        if path is not None and len(path):
            figure.marks(path[place], shape, INK, 7.0, line=1.0, name=name)
    for line in lines:
        figure.line(line.positions, line.color, line.width, DASHED if line.is_dashed else (), name=line.name)
    return figure


def draw_points(
    figure: Plot, points: Points, low: Floats, high: Floats, colors: Sequence[str], grain_m: float = 0.0
) -> None:
    """Draw points (M, 3) seen from above, within corners, in one color or, if they differ in height, in several.

    A pixel has the color of its highest point and is more opaque the more points it has.

    grain_m : distance of neighboring points and least edge of a pixel; 0 if unknown
    """
    points = points[:: max(1, -(-len(points) // _MOST_POINTS))]
    points = points[((points[:, :2] > low[:2]) & (points[:, :2] < high[:2])).all(axis=1)]
    if not len(points):
        return
    colors = colors if len(colors) == 1 or np.ptp(points[:, 2]) else (GRAY,)
    size_m = float(high[0] - low[0])
    widest = 700.0  # pixels
    width = float(np.clip(2.0 * np.sqrt(len(points)), 200.0, widest))
    edge_m = max(grain_m, size_m / widest) if grain_m else size_m / width
    columns, rows = np.ceil((high[:2] - low[:2]) / edge_m).astype(int)
    column, row = ((points[:, :2] - low[:2]) / edge_m).astype(int).T
    pixel = row * columns + column
    opacity = float(np.clip(40_000 / len(points), 0.4, 1.0))  # of one point
    most = 6  # points of a pixel that are told apart
    counts = np.minimum(np.bincount(pixel, minlength=rows * columns), most)
    shades, highest = palette_of(colors, 36 if len(colors) > 1 else 1), np.zeros(rows * columns, int)  # 256 in all
    if len(shades) > 1:
        np.maximum.at(highest, pixel, np.rint((len(shades) - 1) * height_shares(points[:, 2])).astype(int))
    palette = np.repeat(shades, most + 1, axis=0)
    palette[:, 3] = np.tile(np.rint(255.0 * (1.0 - (1.0 - opacity) ** np.arange(most + 1))), len(shades))
    pixels = (highest * (most + 1) + counts).reshape(rows, columns).astype(np.uint8)
    figure.image(pixels, palette, low, low[:2] + edge_m * np.array(pixels.shape[::-1]))


@dataclass(frozen=True, slots=True)
class DrawnMerge:
    """Positions (K, 3) of a merged map's keyframes, its sessions, and ends (E, 2, 3) of closures between them."""

    positions: Floats
    sessions: tuple[Line, ...]
    closures: Floats
    dimension: int


def read_merge(directory: Path) -> DrawnMerge:
    """The sessions of a merge's directory."""
    saved = open_saved_map(directory)
    positions = lie.lift(saved.poses)[:, :3, 3]
    sessions = tuple(
        Line(each.name, positions[saved.session == number], color_of(number))
        for number, each in enumerate(saved.sessions)
    )
    ends: NDArray[np.int64] = saved.session[saved.edges.pairs]
    between = saved.edges.pairs[ends[:, 0] != ends[:, 1]]
    return DrawnMerge(positions, sessions, positions[between], saved.dimension)


def draw_map(
    picture: Path,
    title: str,
    lines: Sequence[Line],
    *,
    points: Points = _NO_POINTS,
    grid: Grid | None = None,
    path: Floats | None = None,
) -> None:
    """Draw lines over a map, all in the world frame, to a PNG; points (M, 3) of the map are shaded by height.

    path : as for ``over_map``. Raises OSError.
    """
    seen = points[:, :2]
    if grid is not None:
        cells, resolution_m, origin_m = grid
        seen = np.array(origin_m) + resolution_m * np.argwhere(cells > 0)[:, ::-1]
    corners = [line.positions[:, :2] for line in lines] + ([np.array(extent(seen))] if len(seen) else [])
    low, high = around(np.concatenate(corners))
    figure = over_map(lines, points, low, high, grid=grid, colors=_INKS, path=path)
    write_png(picture, [(title, figure)], width_inches=8.0)


def _draw_grid(figure: Plot, grid: Grid, low: Floats, high: Floats) -> None:
    """Draw free cells white, occupied ones dark, unknown ones light gray like the area around the grid."""
    cells, resolution_m, origin_m = grid
    palette = np.vstack([palette_of((color,), 1) for color in ("#ffffff", "#262626", "#e6e6e6")])
    shades = np.where(cells < 0, 2, cells > 0).astype(np.uint8)
    figure.image(np.full((1, 1), 2, np.uint8), palette, low, high)
    first = np.array(origin_m)
    figure.image(shades, palette, first, first + resolution_m * np.array(shades.shape[::-1]))


def draw_evaluated(picture: Path, evaluated: Mapping[str, tuple[Matrix, Matrix]]) -> None:
    """Draw the aligned estimates (N, 4, 4) by name, and of the true poses (N, 4, 4) of each the longest."""
    truth = max((reference for _, reference in evaluated.values()), key=len)
    draw_map(picture, "Estimates and ground truth", [*_sessions(evaluated), _line("ground truth", truth, TRUTH)])


def draw_run(directory: Path, picture: Path) -> None:
    """Draw trajectories, ground truth and map to a PNG: the occupancy grid in 2D, the cloud in 3D.

    directory : of a run, a localized log or a merged map
    Raises InputError where it is none of these, or the picture cannot be written.
    """
    try:
        metrics = json.loads((directory / "metrics.json").read_bytes())
    except (OSError, ValueError):
        metrics = {}
    path, grid = None, None
    if "segments" in metrics:
        lines, path = _lines_of_run(directory, metrics)
    elif "placed" in metrics:
        if not metrics["placed"]:
            raise InputError(f"{directory}: {metrics['reason']}; there is no trajectory to draw")
        lines = [_line("optimized", read_tum(directory / "trajectory.tum").poses, OPTIMIZED, 1.8)]
        path = lines[0].positions
    elif "sessions" in metrics:
        names = [each["name"] for each in metrics["sessions"]]
        lines = _sessions({name: (read_tum(directory / f"{name}.tum").poses,) for name in names})
    else:
        raise InputError(
            f"{directory}: holds no trajectory to draw; give the directory of a run, of localize or of merge, or "
            "open report.html"
        )
    if "placed" in metrics:  # over the map that it was localized in
        points = np.vstack(map_points(open_saved_map(Path(metrics["map"]))))
    else:
        points = read_ply(directory / "map.ply")
        if not points[:, 2].any():
            points, grid = _NO_POINTS, read_map(directory)
    try:
        draw_map(picture, directory.resolve().name, lines, points=points, grid=grid, path=path)
    except OSError as error:
        raise InputError(f"{picture}: not writable ({error.strerror}); choose another path") from error


def _lines_of_run(directory: Path, metrics: dict[str, Any]) -> tuple[list[Line], Floats]:
    """Trajectories, truth and segments to check of a run, and its path (N, 3)."""
    optimized, truth_file = read_tum(directory / "trajectory.tum"), directory / TRUTH_FILE
    odometry, path = read_tum(directory / "odometry.tum").poses, optimized.poses[:, :3, 3]
    lines = [_line("odometry", odometry, ODOMETRY, 1.0), _line("optimized", optimized.poses, OPTIMIZED, 1.8)]
    if truth_file.exists():
        accuracy = metrics["ground_truth"] or {}
        truth = on_the_estimate(optimized, read_tum(truth_file), gap_s=accuracy.get("max_gap_s"))
        lines.append(_line("ground truth", truth.poses, TRUTH))
    for each in msgspec.convert(metrics["segments"], tuple[Segment, ...]):
        if each.kind is not Kind.LOOPS:
            part = path[max(each.first - 1, 0) : each.last + 1]
            lines.append(Line(str(each.kind), part, color_of_kind(each.kind), 3.0))
    return lines, path


def _sessions(poses: Mapping[str, Sequence[Matrix]]) -> list[Line]:
    """A line for each name, through the first of its arrays of poses (N, 4, 4)."""
    return [_line(name, each[0], color_of(place)) for place, (name, each) in enumerate(poses.items())]


def _line(name: str, poses: Matrix, color: str, width: float = 1.4) -> Line:
    """The line through poses (N, 4, 4), with its length in the legend; the ground truth is dashed."""
    length_m = path_length(poses)[-1]
    return Line(f"{name} ({length_m:.0f} m)", poses[:, :3, 3], color, width, is_dashed=color == TRUTH)
