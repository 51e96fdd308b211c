"""Import of point clouds and occupancy grids as maps to localize in, by simulating what a lidar would see."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.checks import LARGEST
from scanchain.config import Config
from scanchain.data import Keyframe, Matrix, Points, Scan
from scanchain.errors import InputError, counted, shown
from scanchain.kernels.free_space import nearest_ranges
from scanchain.logs.formats.clouds import SUFFIXES, CloudFileError, read_cloud_file
from scanchain.maps import MAP_FOLDER, Edges, SavedMap, SavedPoints, Session, write_saved_map
from scanchain.maps.files import read_las
from scanchain.maps.occupancy_grid import MAX_CELLS
from scanchain.maps.saved_map import COARSE_M
from scanchain.preprocess import Resolution
from scanchain.runs.directory import RunDirectory
from scanchain.settings import load_settings

LAS_SUFFIXES, GRID_SUFFIXES = (".laz", ".las"), (".yaml", ".yml")
SPACING_M = {2: 1.5, 3: 6.0}  # between the positions of virtual scans
VIEW_M = {2: 30.0, 3: 50.0}  # range of virtual scans
_CLEARANCE_M = 0.4  # least distance of a position from any point
_GROUND = (2.0, 5.0)  # radius in m, and percentile of the heights in it that is the ground
_BINS = {2: (1, 720), 3: (180, 360)}  # of elevation and azimuth, in which nearer points occlude others
_HIDDEN_M = 0.5  # distance behind the nearest point of its bin beyond which a point is occluded
_LEAST_POINTS = 100  # least number of points in view of a position
_MAX_POSITIONS, _MAX_CELLS = 20_000, 2_000_000  # largest numbers of positions, and of those that are tried
_PERCENTILE, _OUTLIER = 99.0, 10.0  # of distances from the median; multiple of it beyond which points are outliers
_MODES = ("trinary", "scale", "raw")  # of map_server


@dataclass(frozen=True, slots=True)
class Imported:
    """An imported map: dimension, numbers of points used and of keyframes made, and spacing of these in meters.

    notes : what was left out of the file, and how coarse its coordinates are
    """

    dimension: int
    points: int
    keyframes: int
    spacing_m: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Surfaces:
    """Points (N, d) of a map, free positions (P, d) if the file contains them, and notes as of ``Imported``."""

    points: Points
    free: Points | None = None
    notes: tuple[str, ...] = ()


def import_map(
    file: Path,
    out: Path,
    *,
    spacing_m: float | None = None,
    height_m: float = 1.6,
    force: bool = False,
    say: Callable[[str], None] = lambda stage: None,
    command: Sequence[str] = (),
) -> Imported:
    """A cloud (PLY, PCD, LAZ, LAS, .npy) or an occupancy grid (.yaml of nav2's or ROS 1's map_server) as a map.

    spacing_m : between the virtual keyframes; SPACING_M where left out
    height_m : of the lidar above the ground, in space; command : the command line, for run.json
    Raises InputError for a file that cannot be read, or has no position from which a lidar sees enough.
    """
    say(f"reading {file.name}")
    surfaces = _read(file, spacing_m)
    dimension = surfaces.points.shape[1]
    spacing_m = SPACING_M[dimension] if spacing_m is None else spacing_m
    config = load_settings(dimension).config
    with RunDirectory(out, force=force, sources=[file], command=command) as directory:
        directory.begin()
        positions = _positions(surfaces, spacing_m, height_m)
        say(f"{counted(len(surfaces.points), 'point')} seen from {counted(len(positions), 'position')}")
        keyframes = tuple(_keyframes(surfaces.points, positions, config))
        if not keyframes:
            raise InputError(
                f"{file}: nowhere does a lidar {height_m:g} m above the ground see {_LEAST_POINTS} points; give a "
                "cloud in meters with z up, or another --height"
            )
        count, d, k = len(keyframes), dimension + 1, 3 * (dimension - 1)
        session = Session(file.name, 0, count - 1, count)
        none = Edges(
            np.empty((0, 2), int), np.empty((0, d, d)), np.empty((0, k, k)), np.empty(0, bool), np.empty(0)
        )
        folder = directory.path / MAP_FOLDER
        write_saved_map(SavedMap(folder, dimension, keyframes, np.zeros(count, np.int64), (session,), none))
        directory.end()
        directory.complete()
    return Imported(dimension, len(surfaces.points), len(keyframes), spacing_m, surfaces.notes)


def _read(file: Path, spacing_m: float | None) -> _Surfaces:
    suffix, notes, columns = file.suffix.lower(), list[str](), list[NDArray[Any]]()
    if suffix in GRID_SUFFIXES:
        return _read_grid(file)
    try:
        if suffix in LAS_SUFFIXES:
            points = read_las(file)
        elif suffix in SUFFIXES:
            rows = read_cloud_file(file)
            columns = [rows[name] for name in "xyz"]
            points = np.column_stack([column.astype(np.float64) for column in columns])
        else:
            known = ", ".join((*SUFFIXES, *LAS_SUFFIXES, *GRID_SUFFIXES))
            raise InputError(f"{file}: is no map that can be read; give one of {known}")
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror or error})") from error
    except CloudFileError as error:
        raise InputError(f"{file}: {error}") from error
    count = len(points)
    points = points[(np.abs(points) < LARGEST).all(axis=1)]
    if not len(points):
        raise InputError(f"{file}: has no points")
    points = _without_outliers(points, spacing_m or SPACING_M[3])
    if len(points) < count:
        notes.append(
            f"{file}: {counted(count - len(points), 'point')} of {count:,} are left out: coordinates that are not "
            f"finite, or more than {_OUTLIER:g} times as far out as {_PERCENTILE:g} % of the points"
        )
    step_m = max(map(_step_m, columns, points.T), default=0.0)
    if step_m > COARSE_M:
        notes.append(
            f"{file}: its coordinates reach {np.abs(points).max():,.0f} m and come in steps of {step_m:g} m "
            "there: the map and all poses in it are no more accurate; subtract an offset before they are stored, "
            "or store float64 from the beginning"
        )
    return _Surfaces(points[:, :2] if np.ptp(points[:, 2]) < 1e-6 else points, notes=tuple(notes))


def _without_outliers(points: Points, spacing_m: float) -> Points:
    """Points (N, 3); without outliers if the extent is too large for positions at this spacing."""
    if np.ptp(points[:, :2], axis=0).max() < math.sqrt(_MAX_CELLS) * spacing_m:
        return points
    away_m = np.abs(points - np.median(points, axis=0)).max(axis=1)
    return points[away_m <= _OUTLIER * np.percentile(away_m, _PERCENTILE)]


def _step_m(column: NDArray[Any], values: NDArray[np.float64]) -> float:
    """Largest rounding step of a column, in the precision it was stored with, at the values (N,) that are used."""
    if column.dtype.kind != "f":
        return 1.0
    with np.errstate(over="ignore"):
        is_single = np.array_equal(values.astype(np.float32), values)
    kind = np.float32 if is_single else column.dtype.type
    return float(np.spacing(kind(np.abs(values).max())))


def _read_grid(file: Path) -> _Surfaces:
    """Centers of occupied and free cells of a map for map_server; modes and thresholds as nav2 reads them.

    In modes trinary and scale, cells that are not opaque are unknown; in raw, a pixel is the occupancy in percent,
    unknown above 100, and ``negate`` is ignored.
    """
    from PIL import Image
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        stated: dict[str, Any] = YAML(typ="safe").load(file)
        with Image.open(file.parent / stated["image"]) as picture:
            if picture.width * picture.height > MAX_CELLS:
                raise ValueError(f"its image has {picture.width} x {picture.height} cells, over {MAX_CELLS:,}")
            is_deep = picture.mode.startswith("I")  # of 16 bits, which convert("L") would cut off
            gray = np.asarray(picture) / 257.0 if is_deep else np.asarray(picture.convert("L"))
            image = np.rint(gray).astype(np.uint8)
            has_alpha = "A" in picture.getbands() or "transparency" in picture.info
            is_opaque = np.asarray(picture.convert("RGBA").getchannel("A")) == 255 if has_alpha else np.True_
        resolution_m, (x, y, yaw_rad) = float(stated["resolution"]), map(float, stated["origin"])
        occupied_from, free_to = float(stated["occupied_thresh"]), float(stated["free_thresh"])
        is_negated, mode = bool(int(stated.get("negate", 0))), stated.get("mode", "trinary")
        if mode not in _MODES:
            raise ValueError(f"mode is {shown(mode)}, wanted one of {', '.join(_MODES)}")
        if not (1e-3 <= resolution_m <= 1e2 and np.isfinite([x, y, yaw_rad]).all()):
            raise ValueError(f"resolution {resolution_m:g} m, origin {x:g}, {y:g}, {yaw_rad:g}")
    except OSError as error:
        raise InputError(f"{error.filename or file}: cannot be read ({error.strerror or error})") from error
    except (
        YAMLError, KeyError, TypeError, ValueError, AttributeError, RecursionError, Image.DecompressionBombError
    ) as error:  # fmt: skip
        raise InputError(
            f"{file}: is no map of map_server ({type(error).__name__}: {error}); wanted image, resolution, "
            "origin, occupied_thresh, free_thresh"
        ) from error
    levels = np.arange(256)
    if mode == "raw":
        probability, is_known = levels / 100.0, (levels <= 100)[image]
    else:
        probability, is_known = np.abs(levels / 255.0 - (not is_negated)), is_opaque
    T_map_image = lie.pose_2d(x, y, yaw_rad)

    def centers(cells: NDArray[np.bool_]) -> Points:
        rows, columns = np.nonzero((cells & is_known)[::-1])
        return lie.transform(T_map_image, (np.column_stack([columns, rows]) + 0.5) * resolution_m)

    points = centers((probability >= occupied_from)[image])
    if not len(points):
        raise InputError(f"{file}: has no occupied cells; look at occupied_thresh, mode and negate")
    return _Surfaces(points, centers((probability <= free_to)[image]))


def _positions(surfaces: _Surfaces, spacing_m: float, height_m: float) -> Points:
    """Positions (P, d) on a grid where a lidar could be; rows alternate in direction, so that neighbors follow."""
    points = surfaces.points
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    if np.prod((high - low) / spacing_m + 1.0) > _MAX_CELLS:
        raise InputError(
            f"the map is {high[0] - low[0]:,.6g} x {high[1] - low[1]:,.6g} m large; give a larger --spacing, or a "
            "part of it"
        )
    axes = [np.arange(a + 0.5 * min(spacing_m, b - a), b, spacing_m) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    if points.shape[1] == 3:
        grid = _above_ground(points, grid, height_m)
    elif surfaces.free is not None and len(surfaces.free):
        grid = grid[KDTree(surfaces.free).query(grid)[0] < 0.5 * _CLEARANCE_M]
    clear = KDTree(points).query(grid)[0] > _CLEARANCE_M if len(grid) else np.zeros(0, bool)
    if clear.sum() > _MAX_POSITIONS:
        raise InputError(f"the map needs {int(clear.sum()):,} virtual scans; give a larger --spacing")
    positions = grid[clear]
    row = np.floor(positions[:, 1] / spacing_m)
    along = np.where(row % 2 == 0, positions[:, 0], -positions[:, 0])
    return positions[np.lexsort((along, row))]


def _above_ground(points: Points, grid: Matrix, height_m: float) -> Points:
    """Positions (P, 3) above the ground around positions in the plane, where there is any."""
    around = KDTree(points[:, :2]).query_ball_point(grid, _GROUND[0])
    rows = [
        (x, y, float(np.percentile(points[found, 2], _GROUND[1])) + height_m)
        for (x, y), found in zip(grid.tolist(), around, strict=True)
        if found
    ]
    return np.array(rows).reshape(-1, 3)


def _keyframes(points: Points, positions: Points, config: Config) -> Iterator[Keyframe]:
    """Virtual keyframes with the points in view of each, downsampled like scans."""
    dimension = points.shape[1]
    tree, resolution = KDTree(points), Resolution(config.preprocess, config.local_map.voxel_size_m)
    index, traveled_m, last = 0, 0.0, None
    for position in positions:
        near = tree.query_ball_point(position, VIEW_M[dimension])
        seen = _in_view(points[near] - position)
        if len(seen) < _LEAST_POINTS or (dimension == 2 and not _is_inside(seen)):
            continue
        sweep, _ = resolution.downsampled(Scan.of(seen.astype(np.float32), 1e-9 * index, index=index))
        traveled_m += 0.0 if last is None else float(np.linalg.norm(position - last))
        last, pose = position, lie.identity(dimension)
        pose[:-1, -1] = position
        yield Keyframe(index, index, index, SavedPoints(sweep.points, 1.0), pose, traveled_m, resolution.scale)
        index += 1


def _in_view(points: Points) -> Points:
    """Points (M, d) around a lidar that nearer ones do not occlude."""
    rows, columns = _BINS[points.shape[1]]
    ranges_m = np.empty((rows, columns))
    in_space = lie.lift_points(points)
    nearest_ranges(in_space, ranges_m)
    range_m = np.linalg.norm(in_space, axis=1)
    elevation = np.arcsin(in_space[:, 2] / np.maximum(range_m, 1e-9)) / np.pi + 0.5
    azimuth = np.arctan2(in_space[:, 1], in_space[:, 0]) / (2.0 * np.pi) + 0.5
    row = np.minimum((elevation * rows).astype(int), rows - 1)
    column = np.minimum((azimuth * columns).astype(int), columns - 1)
    return points[range_m < ranges_m[row, column] + _HIDDEN_M]


def _is_inside(seen: Points) -> bool:
    """True if 2D points surround the lidar: 60 % of 36 sectors of azimuth have some."""
    sectors = np.floor((np.arctan2(seen[:, 1], seen[:, 0]) / (2.0 * np.pi) + 0.5) * 36).astype(int)
    return len(np.unique(np.minimum(sectors, 35))) >= 0.6 * 36
