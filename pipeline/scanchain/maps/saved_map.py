"""A map to localize in and to merge: keyframes with their final poses, and the edges between them, in a folder.

    map.json       version, dimension, number of keyframes and points, the sessions it was made of, and the CRC-32
                   of each of the other files
    keyframes.npz  poses (K, d+1, d+1) T_map_lidar; stamps_ns, scan_index, session, traveled_m, scale, count,
                   step_m and is_wide (K,); spans (S, 2 + d) number of a keyframe, of points, origin of their rays:
                   none where all rays start at the origin of the keyframe's frame
    edges.npz      pairs (E, 2), measurements (E, d+1, d+1), information (E, k, k), is_loop, weight (E,)
    points.i16     coordinates (count, d) of one keyframe after the other, in units of its step_m; little-endian
                   int16, or int32 where it is_wide

Points stay on disk and are read keyframe by keyframe. Maps of versions 1 and 2 are refused.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain.data import Keyframe, Matrix, Points, RaySpan
from scanchain.errors import InputError, one_line, printable, shown
from scanchain.files import BLOCK_BYTES, write_whole
from scanchain.maps.files import STEP_M

MAP_FOLDER = "map"
VERSION = 3  # of the format; older ones are refused
_INDEX, _KEYFRAMES, _EDGES, _POINTS = "map.json", "keyframes.npz", "edges.npz", "points.i16"
_NUMBER, _WIDE = np.dtype("<i2"), np.dtype("<i4")
_ROW = np.dtype([
    ("count", np.int64), ("step_m", np.float64), ("is_wide", np.bool_), ("stamps_ns", np.int64),
    ("scan_index", np.int64), ("traveled_m", np.float64), ("scale", np.float64),
])  # fmt: skip
_WHOLE = ("session", "count", "stamps_ns", "scan_index", "pairs")  # arrays of whole numbers
_MOST_STEP_M = 1e6  # largest step in a map whose points are not damaged
COARSE_M = 0.01  # step of coordinates, above which rounding adds to a sensor noise of 3 cm


class Session(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A log that a map was made of: its printable name, when it began and ended, and its number of keyframes."""

    name: str
    first_stamp_ns: int
    last_stamp_ns: int
    keyframes: int

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "name", printable(self.name))


class _Index(msgspec.Struct, frozen=True):
    """Contents of map.json."""

    version: int
    dimension: Annotated[int, msgspec.Meta(ge=2, le=3)]
    keyframes: int
    points: int
    sessions: tuple[Session, ...]
    crc32: dict[str, int]


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges of a pose graph.

    pairs : (E, 2) int64 keyframes (i, j)
    measurements : (E, d+1, d+1) T_ij; information : (E, k, k) of a right twist on it
    is_loop : (E,) bool; weight : (E,) robust weight
    """

    pairs: NDArray[np.int64]
    measurements: Matrix
    information: Matrix
    is_loop: NDArray[np.bool_]
    weight: NDArray[np.float64]

    def among(self, chosen: NDArray[np.int64]) -> Edges:
        """The edges between chosen keyframes, which are renumbered in this order."""
        number = np.full(max(int(self.pairs.max(initial=-1)), int(chosen.max(initial=-1))) + 1, -1)
        number[chosen] = np.arange(len(chosen))
        pairs = number[self.pairs]
        return replace(self, pairs=pairs).where((pairs[:, 0] >= 0) & (pairs[:, 1] >= 0))

    @classmethod
    def chained(cls, *parts: Edges) -> Edges:
        """The edges of several parts, concatenated."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in _EDGE_ARRAYS))

    def where(self, kept: NDArray[np.bool_]) -> Edges:
        """The edges for which ``kept`` (E,) is true."""
        return Edges(*(getattr(self, name)[kept] for name in _EDGE_ARRAYS))


_EDGE_ARRAYS = Edges.__match_args__


@dataclass(frozen=True, slots=True)
class SavedPoints:
    """The points of one keyframe: ``rows`` (M, d) times ``step_m``; memory-mapped in a map that was opened."""

    rows: NDArray[np.number]
    step_m: float
    spans: tuple[RaySpan, ...] = ()

    def read(self) -> Points:
        """(M, d) meters."""
        return self.rows.astype(np.float64) * self.step_m


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A map as it is stored on disk.

    folder : its directory
    dimension : 2 or 3
    keyframes : their ``T_odom_lidar`` is the final pose, T_map_lidar
    session : (K,) number of the session that each keyframe comes from
    sessions : in chronological order
    edges : in force between the keyframes
    """

    folder: Path
    dimension: int
    keyframes: tuple[Keyframe, ...]
    session: NDArray[np.int64]
    sessions: tuple[Session, ...]
    edges: Edges

    @property
    def poses(self) -> Matrix:
        """(K, d+1, d+1) T_map_lidar of the keyframes."""
        size = self.dimension + 1
        return np.array([keyframe.T_odom_lidar for keyframe in self.keyframes]).reshape(-1, size, size)

    @property
    def name(self) -> str:
        """Name of the run it belongs to."""
        return self.folder.parent.name if self.folder.name == MAP_FOLDER else self.folder.name


def write_saved_map(saved: SavedMap) -> None:
    """Write a map into its folder, which must not exist; map.json is written last."""
    folder, keyframes = saved.folder, saved.keyframes
    folder.mkdir(parents=True)
    rows, spans = np.empty(len(keyframes), _ROW), []
    with (folder / _POINTS).open("wb") as file:
        for place, each in enumerate(keyframes):
            points = each.points
            reach_m = float(np.abs(points).max(initial=0.0))
            is_wide = reach_m > COARSE_M * np.iinfo(_NUMBER).max  # one far return must not make all points coarse
            number = _WIDE if is_wide else _NUMBER
            step_m = max(reach_m / np.iinfo(number).max, STEP_M)
            file.write(np.rint(points / step_m).astype(number).tobytes())
            stored = len(points), step_m, is_wide
            rows[place] = *stored, each.stamp_ns, each.scan_index, each.traveled_m, each.scale
            spans += [(place, span.rays, *span.origin) for span in each.stored.spans]
    columns: dict[str, Any] = {name: rows[name] for name in _ROW.names or ()}
    columns["spans"] = np.array(spans, float).reshape(-1, 2 + saved.dimension)
    np.savez(folder / _KEYFRAMES, poses=saved.poses, session=saved.session, **columns)
    np.savez(folder / _EDGES, **{name: getattr(saved.edges, name) for name in _EDGE_ARRAYS})
    crc32 = {name: _crc32(folder / name) for name in (_KEYFRAMES, _EDGES, _POINTS)}
    points = int(rows["count"].sum())
    index = _Index(VERSION, saved.dimension, len(keyframes), points, saved.sessions, crc32)
    write_whole(folder / _INDEX, msgspec.json.format(msgspec.json.encode(index)))


def open_saved_map(path: Path) -> SavedMap:
    """The map of a run directory, or of a map folder. Raises InputError if there is none or it is damaged."""
    folder = path / MAP_FOLDER if (path / MAP_FOLDER).is_dir() else path
    if not (folder / _INDEX).is_file():
        raise InputError(f"{path}: holds no map ({MAP_FOLDER}/{_INDEX}); give the directory of a finished run")
    index = _index(folder / _INDEX)
    for name in (_KEYFRAMES, _EDGES, _POINTS):
        try:
            found = _crc32(folder / name)
        except OSError as error:
            raise _damaged(folder / name, f"cannot be read: {error.strerror}") from error
        if found != index.crc32.get(name):
            raise _damaged(folder / name, f"is damaged or cut off: its checksum is not that in {_INDEX}")
    rows, edges = read_arrays(folder / _KEYFRAMES), read_arrays(folder / _EDGES)
    K, d = index.keyframes, index.dimension
    try:
        if rows["poses"].shape != (K, d + 1, d + 1) or rows["count"].sum() != index.points:
            raise _damaged(folder / _KEYFRAMES, f"holds other keyframes and points than {_INDEX} says")
        E, k, pose = len(edges["pairs"]), 3 * (d - 1), (d + 1, d + 1)
        of_edges = ((2,), pose, (k, k), (), ())
        shapes = {"poses": (K, *pose), "session": (K,), "spans": (len(rows["spans"]), 2 + d)}
        _check(rows, shapes | dict.fromkeys(_ROW.names or (), (K,)))
        _check(edges, {name: (E, *shape) for name, shape in zip(_EDGE_ARRAYS, of_edges, strict=True)})
        _check_range(rows["session"], "session", len(index.sessions))
        _check_range(edges["pairs"], "pairs", K)
        _check_range(rows["count"], "count", index.points + 1)
        _check_range(rows["spans"][:, 1], "spans", index.points + 1)
        if (np.abs(rows["step_m"]) > _MOST_STEP_M).any():
            raise ValueError(
                f"step_m reaches {np.abs(rows['step_m']).max():.3g} m; wanted at most {_MOST_STEP_M:g}"
            )
        keyframes = _keyframes(rows, folder / _POINTS, d)
        return SavedMap(folder, d, keyframes, rows["session"], index.sessions, Edges(**edges))
    except (LookupError, ValueError, TypeError) as error:  # written by another program, checksums included
        raise _damaged(folder, f"is not as scanchain writes it ({one_line(error)})") from error


def _check(arrays: dict[str, NDArray[Any]], shapes: dict[str, tuple[int, ...]]) -> None:
    """Raise ValueError where an array has another shape or kind of numbers, or is not finite."""
    for name, shape in shapes.items():
        kind = {"is_loop": "b", "is_wide": "b", **dict.fromkeys(_WHOLE, "iu")}.get(name, "f")
        array = arrays[name]
        if array.shape != shape or array.dtype.kind not in kind or not np.isfinite(array).all():
            raise ValueError(f"{name} is {array.dtype} {array.shape}, or not finite; wanted {shape}")


def _check_range(array: NDArray[np.int64], name: str, limit: int) -> None:
    if len(array) and not 0 <= int(array.min()) <= int(array.max()) < limit:
        raise ValueError(f"{name} reaches from {array.min()} to {array.max()}; wanted 0 to {limit - 1}")


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz file. Raises InputError where it cannot be read."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name].view(np.ndarray) for name in file}  # bytes, which have no view, are no array
    except Exception as error:  # whatever a damaged file makes NumPy, its parser and the decoders raise
        raise _damaged(path, f"cannot be read ({type(error).__name__}: {one_line(error)})") from error


def _keyframes(rows: dict[str, Any], path: Path, d: int) -> tuple[Keyframe, ...]:
    """The keyframes, whose points stay in a file that is mapped into memory."""
    sizes = rows["count"] * d * np.where(rows["is_wide"], 2, 1)
    ends = np.cumsum(sizes)
    points = np.memmap(path, _NUMBER, "r") if sizes.any() else np.empty(0, _NUMBER)
    keyframes = []
    columns = zip(*(rows[name].tolist() for name in _ROW.names or ()), strict=True)
    for k, (_, step_m, is_wide, stamp_ns, scan_index, traveled_m, scale) in enumerate(columns):
        numbers = points[ends[k] - sizes[k] : ends[k]].view(_WIDE if is_wide else _NUMBER).reshape(-1, d)
        spans = tuple(RaySpan(row[2:], int(row[1])) for row in rows["spans"][rows["spans"][:, 0] == k])
        if spans and sum(span.rays for span in spans) != len(numbers):
            raise ValueError(f"the spans of keyframe {k} are not those of its {len(numbers)} points")
        stored = SavedPoints(numbers, step_m, spans)
        keyframes.append(Keyframe(k, scan_index, stamp_ns, stored, rows["poses"][k], traveled_m, scale))
    return tuple(keyframes)


def _index(path: Path) -> _Index:
    try:
        data = path.read_bytes()
        version = msgspec.json.decode(data)["version"]
        if version != VERSION:
            raise InputError(
                f"{path}: is of version {shown(version)}, this scanchain reads {VERSION}; make the map again"
            )
        return msgspec.json.decode(data, type=_Index)
    except (msgspec.MsgspecError, KeyError, TypeError, OSError, UnicodeDecodeError) as error:
        raise _damaged(path, f"cannot be read ({type(error).__name__}: {one_line(error)})") from error


def _crc32(path: Path) -> int:
    """CRC-32 of a file, which detects any few flipped bits."""
    crc = 0
    with path.open("rb") as file:
        while block := file.read(BLOCK_BYTES):
            crc = zlib.crc32(block, crc)
    return crc


def _damaged(path: Path, how: str) -> InputError:
    return InputError(f"{path}: {how}; make the map again")
