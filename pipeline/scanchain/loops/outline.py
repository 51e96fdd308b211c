"""The outline of a 3D map: its upright structure as seen from above, stored beside the map."""

from __future__ import annotations

import io
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import LocalMapConfig
from scanchain.data import Keyframe, Matrix, Pose
from scanchain.errors import InputError
from scanchain.files import write_whole
from scanchain.loops.descriptor import level_frame, upright_frame
from scanchain.maps.saved_map import read_arrays
from scanchain.registration import upright_columns

PLACES_FILE = "places.npz"
VERSION = 1
_TOGETHER = 10  # number of keyframes whose points are seen together; drift between more would raise the ground
_MAX_LEVELED = 16  # number of keyframes, evenly spread, whose ground says where the map's vertical is


@dataclass(frozen=True, slots=True)
class Outline:
    """Upright structure of a map.

    Attributes
    ----------
    T_map_level : (4, 4) rotation to the frame whose z axis is normal to the ground, on average
    columns : (M, 2) where it is upright, level frame
    size_m : edge length of the cells that the map was seen in
    """

    T_map_level: Pose
    columns: Matrix
    size_m: float


def outline_of(folder: Path, keyframes: Sequence[Keyframe], config: LocalMapConfig) -> Outline:
    """The outline of a map in this folder, which holds it from the first time on where it can be written to.

    keyframes : of the map; their ``T_odom_lidar`` is T_map_lidar
    """
    path = folder / PLACES_FILE
    stored = _stored(path, len(keyframes))
    if stored is not None:
        return stored
    size_m = config.voxel_size_m * float(np.median([keyframe.scale for keyframe in keyframes]))
    T_map_level = level_of(keyframes, [keyframe.T_odom_lidar for keyframe in keyframes], config)
    outline = Outline(T_map_level, _columns(keyframes, lie.inverse(T_map_level), size_m), size_m)
    data = io.BytesIO()
    np.savez(
        data,
        version=VERSION,
        keyframes=len(keyframes),
        T_map_level=outline.T_map_level,
        columns=outline.columns.astype(np.float32),
        size_m=size_m,
    )
    with suppress(OSError):  # a map that cannot be written to is searched all the same
        write_whole(path, data.getvalue())
    return outline


def _stored(path: Path, count: int) -> Outline | None:
    """The outline on disk; None where there is none of this version and number of keyframes."""
    try:
        file = read_arrays(path)
        if (int(file["version"]), int(file["keyframes"])) != (VERSION, count):
            return None
        return Outline(file["T_map_level"], file["columns"].astype(np.float64), float(file["size_m"]))
    except (InputError, ValueError, KeyError, TypeError):
        return None


def level_of(keyframes: Sequence[Keyframe], poses: Sequence[Pose] | Matrix, config: LocalMapConfig) -> Pose:
    """T_map_level by the ground around some of the keyframes, whose poses in the map these are."""
    step = max(-(-len(keyframes) // _MAX_LEVELED), 1)
    chosen = zip(keyframes[::step], poses[::step], strict=True)
    up = sum((T[:3, :3] @ level_frame(k, config)[:3, 2] for k, T in chosen), np.zeros(3))
    return upright_frame(up / np.linalg.norm(up))


def _columns(keyframes: Sequence[Keyframe], T_level_map: Pose, size_m: float) -> Matrix:
    """Upright columns (M, 2), one a cell."""
    seen: list[NDArray[np.float64]] = []
    for first in range(0, len(keyframes), _TOGETHER):
        members = keyframes[first : first + _TOGETHER]
        seen.append(
            upright_columns(
                np.vstack([lie.transform(T_level_map @ each.T_odom_lidar, each.points) for each in members]),
                size_m,
            )
        )
    columns = np.vstack(seen)
    return columns[np.unique(np.floor(columns / size_m), axis=0, return_index=True)[1]]
