"""A map to localize in and to merge: keyframes with their final poses, and the edges between them, in a folder.

    map.json       version, dimension, number of keyframes and points, the sessions it was made of
    keyframes.npz  poses (K, d+1, d+1) T_map_lidar; stamps_ns, scan_index, session, traveled_m, scale, first,
                   count, step_m and last_seen_ns (K,)
    edges.npz      pairs (E, 2), measurements (E, d+1, d+1), information (E, k, k), is_loop, weight (E,)
    points.i16     int16 (N, d), little-endian: of a keyframe the rows first to first + count, times its step_m

Points stay on disk and are read keyframe by keyframe.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain.data import Keyframe, Matrix, Points
from scanchain.errors import InputError
from scanchain.whole_file import write_whole
from scanchain.words import counted

MAP_FOLDER = "map"
VERSION = 1
_INDEX, _KEYFRAMES, _EDGES, _POINTS = "map.json", "keyframes.npz", "edges.npz", "points.i16"
_NUMBER = np.dtype("<i2")
_LARGEST = 32767
_STEP_M = 0.001  # of coordinates on disk, more where the keyframe reaches farther than 33 m


class Session(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A log that a map was made of: its name, when it began and ended, and its number of keyframes."""

    name: str
    first_stamp_ns: int
    last_stamp_ns: int
    keyframes: int


class _Index(msgspec.Struct, frozen=True):
    """Contents of map.json."""

    version: int
    dimension: int
    keyframes: int
    points: int
    sessions: tuple[Session, ...]


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges of a pose graph.

    Attributes
    ----------
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
        """Those between chosen keyframes, renumbered in this order."""
        number = np.full(max(int(self.pairs.max(initial=-1)), int(chosen.max(initial=-1))) + 1, -1)
        number[chosen] = np.arange(len(chosen))
        pairs = number[self.pairs]
        return replace(self, pairs=pairs).where((pairs[:, 0] >= 0) & (pairs[:, 1] >= 0))

    @classmethod
    def chained(cls, *parts: Edges) -> Edges:
        """Those of several, one after the other."""
        names = ("pairs", "measurements", "information", "is_loop", "weight")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def where(self, kept: NDArray[np.bool_]) -> Edges:
        """Those for which ``kept`` (E,) holds."""
        return Edges(
            self.pairs[kept],
            self.measurements[kept],
            self.information[kept],
            self.is_loop[kept],
            self.weight[kept],
        )


@dataclass(frozen=True, slots=True)
class SavedPoints:
    """The points of one keyframe of a saved map; ``rows`` (M, d) int16 lie on disk."""

    rows: NDArray[np.int16]
    step_m: float

    def read(self) -> Points:
        """(M, d) meters."""
        return self.rows.astype(np.float64) * self.step_m


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A map on disk.

    Attributes
    ----------
    folder : where it lies
    dimension : 2 or 3
    keyframes : their ``T_odom_lidar`` is the final pose, T_map_lidar
    session : (K,) number of the session that each keyframe comes from
    sessions : in the order they joined
    edges : in force between the keyframes
    last_seen_ns : (K,) stamp of the newest keyframe known to have seen the surroundings of each, its own at least
    """

    folder: Path
    dimension: int
    keyframes: tuple[Keyframe, ...]
    session: NDArray[np.int64]
    sessions: tuple[Session, ...]
    edges: Edges
    last_seen_ns: NDArray[np.int64]

    @property
    def poses(self) -> Matrix:
        """(K, d+1, d+1) T_map_lidar of the keyframes."""
        return np.array([keyframe.T_odom_lidar for keyframe in self.keyframes])

    @property
    def name(self) -> str:
        """Name of the run it belongs to."""
        return self.folder.parent.name if self.folder.name == MAP_FOLDER else self.folder.name


def write_saved_map(
    folder: Path,
    keyframes: Sequence[Keyframe],
    poses: Matrix,
    session: NDArray[np.int64],
    sessions: Sequence[Session],
    edges: Edges,
    last_seen_ns: NDArray[np.int64] | None = None,
) -> None:
    """Write a map of keyframes at these poses (K, d+1, d+1) into a new folder; map.json comes last.

    session : (K,) number of each keyframe's session
    last_seen_ns : (K,) as in ``SavedMap``; the keyframes' own stamps where left out
    """
    folder.mkdir(parents=True)
    steps_m, counts = [], []
    with (folder / _POINTS).open("wb") as file:
        for keyframe in keyframes:
            points = keyframe.points
            step_m = max(float(np.abs(points).max(initial=0.0)) / _LARGEST, _STEP_M)
            file.write(np.rint(points / step_m).astype(_NUMBER).tobytes())
            steps_m.append(step_m)
            counts.append(len(points))
    count = np.array(counts, np.int64)
    stamps_ns = np.array([keyframe.stamp_ns for keyframe in keyframes], np.int64)
    np.savez(
        folder / _KEYFRAMES,
        poses=poses,
        session=session,
        first=np.cumsum(count) - count,
        count=count,
        step_m=np.array(steps_m),
        stamps_ns=stamps_ns,
        last_seen_ns=stamps_ns if last_seen_ns is None else last_seen_ns,
        scan_index=np.array([keyframe.scan_index for keyframe in keyframes], np.int64),
        traveled_m=np.array([keyframe.traveled_m for keyframe in keyframes]),
        scale=np.array([keyframe.scale for keyframe in keyframes]),
    )
    np.savez(
        folder / _EDGES,
        pairs=edges.pairs,
        measurements=edges.measurements,
        information=edges.information,
        is_loop=edges.is_loop,
        weight=edges.weight,
    )
    index = _Index(VERSION, poses.shape[-1] - 1, len(keyframes), int(count.sum()), tuple(sessions))
    write_whole(folder / _INDEX, msgspec.json.format(msgspec.json.encode(index)))


def open_saved_map(path: Path) -> SavedMap:
    """The map of a run directory, or in a folder itself. Raises InputError where there is none that is whole."""
    folder = path / MAP_FOLDER if (path / MAP_FOLDER).is_dir() else path
    if not (folder / _INDEX).is_file():
        raise InputError(f"{path}: holds no map ({MAP_FOLDER}/{_INDEX}); give the directory of a finished run")
    index = _index(folder / _INDEX)
    rows = _arrays(folder / _KEYFRAMES)
    try:
        keyframes = _keyframes(rows, _points(folder / _POINTS, index))
        edges = Edges(**_arrays(folder / _EDGES))
        session, last_seen_ns = rows["session"], rows.get("last_seen_ns", rows["stamps_ns"])
        if any(len(each) != index.keyframes for each in (keyframes, session, last_seen_ns)):
            raise ValueError(f"{len(keyframes)} keyframes of {index.keyframes}")
        if edges.pairs.max(initial=-1) >= len(keyframes):
            raise ValueError("edges of keyframes that are not there")
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise _damaged(folder, error) from error
    return SavedMap(folder, index.dimension, keyframes, session, index.sessions, edges, last_seen_ns)


def _keyframes(rows: dict[str, Any], points: NDArray[np.int16]) -> tuple[Keyframe, ...]:
    poses, scan_index, stamps_ns, traveled_m, scale = (
        rows[name] for name in ("poses", "scan_index", "stamps_ns", "traveled_m", "scale")
    )
    first, count, step_m = rows["first"].tolist(), rows["count"].tolist(), rows["step_m"].tolist()
    return tuple(
        Keyframe(
            index=k,
            scan_index=int(scan_index[k]),
            stamp_ns=int(stamps_ns[k]),
            stored=SavedPoints(points[first[k] : first[k] + count[k]], step_m[k]),
            T_odom_lidar=poses[k],
            traveled_m=float(traveled_m[k]),
            scale=float(scale[k]),
        )
        for k in range(len(poses))
    )


def _index(path: Path) -> _Index:
    try:
        version = msgspec.json.decode(path.read_bytes())["version"]
        if version != VERSION:
            raise InputError(f"{path}: is of version {version}, this scanchain reads {VERSION}; run the log again")
        return msgspec.json.decode(path.read_bytes(), type=_Index)
    except (msgspec.MsgspecError, KeyError, TypeError, OSError) as error:
        raise _damaged(path.parent, error) from error


def _arrays(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise _damaged(path.parent, error, path.name) from error


def _points(path: Path, index: _Index) -> NDArray[np.int16]:
    """(N, d) all points, mapped into memory."""
    wanted = index.points * index.dimension * _NUMBER.itemsize
    size = path.stat().st_size if path.is_file() else 0
    if size != wanted:
        raise InputError(f"{path}: has {counted(size, 'byte')} of {wanted:,}; run the log again")
    if not index.points:
        return np.empty((0, index.dimension), np.int16)
    return np.memmap(path, _NUMBER, "r", shape=(index.points, index.dimension))


def _damaged(folder: Path, error: Exception, name: str = "") -> InputError:
    what = f"{name} cannot be read" if name else "is damaged"
    return InputError(f"{folder}: {what} ({type(error).__name__}: {error}); run the log again")
