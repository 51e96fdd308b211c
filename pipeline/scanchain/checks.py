"""Checks of arguments of public functions: converted if nothing is lost, else refused with one clear error.

Each function returns its argument as the kernels take it, C-contiguous, writeable and of one dtype (another layout
would be compiled separately), or raises an InputError that names the argument, what was given and what is wanted.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import DTypeLike, NDArray

from scanchain.config_keys import LARGEST
from scanchain.errors import InputError, one_line, shown
from scanchain.kernels.geometry import largest_magnitude, rigidity_error
from scanchain.kernels.voxels import REACH

_LARGEST_WHOLE = np.iinfo(np.int64).max
RIGID = 1e-3  # largest entry of RᵀR − I; poses printed with four digits stay below it
_LARGEST_VOXEL = float(1 << 31)  # the index of a voxel along an axis has 32 bits
_LATEST_S = 1e11  # latest stamp, seconds: the year 5138
SMALLER_UNITS = " (from milliseconds: 1e-3 * stamp, microseconds: 1e-6, nanoseconds: 1e-9)"
LONGEST_SWEEP_S = 10.0  # largest time between the stamp of a scan and any of its points


def dimension(value: object, name: str = "dimension") -> int:
    """2 for the plane, 3 for space."""
    if isinstance(value, int | np.integer) and not isinstance(value, bool) and value in (2, 3):
        return int(value)
    raise InputError(f"{name} is {shown(value)}; it must be 2 (laser scans) or 3 (clouds)")


def shape(value: object, name: str) -> tuple[int, ...]:
    """Shape of an array or of nested lists."""
    return value.shape if isinstance(value, np.ndarray) else _array(value, name, "an array").shape


def dimension_of(value: object, name: str) -> int:
    """2 where points are (N, 2), else 3."""
    return 2 if shape(value, name)[1:] == (2,) else 3


def points(value: object, name: str, d: int, *, dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Points (N, d), finite; N may be 0."""
    array: Any = value
    if not _is_ready(value, dtype):
        array = _numbers(value, name, f"an (N, {d}) array of meters{_where(value, name)}", dtype)
    if array.ndim != 2 or array.shape[1] != d:
        raise InputError(
            f"{name} has the shape {array.shape}; wanted (N, {d}), one row per point{_remedy(array, name, d)}"
        )
    farthest = largest_magnitude(array)
    if LARGEST < farthest < math.inf:
        raise InputError(f"{name} holds {farthest:.3g}, over {LARGEST:g}; give meters")
    if not math.isfinite(farthest):
        bad = int((~np.isfinite(array)).any(axis=1).sum())
        raise InputError(
            f"{name}: {bad:,} of {len(array):,} points are NaN or infinite; leave them out, with their times"
        )
    return array


def valid_points(
    value: object, name: str, d: int | None = None, *, dtype: DTypeLike = np.float64
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """The finite points (M, d), and a mask (N,) of these; the others are invalid returns of the lidar."""
    d = dimension_of(value, name) if d is None else d
    if type(value) is np.ndarray and value.ndim == 2 and value.dtype.kind == "f" and not np.isfinite(value).all():
        is_valid = np.asarray(np.isfinite(value).all(axis=1))
        return points(value[is_valid], name, d, dtype=dtype), is_valid
    array = points(value, name, d, dtype=dtype)
    return array, np.ones(len(array), np.bool_)


def pose(value: object, name: str, d: int) -> NDArray[np.float64]:
    """A rigid transformation of SE(d): (d+1, d+1), RᵀR = I, det R = 1, last row 0 … 0 1."""
    n = d + 1
    wanted = f"a ({n}, {n}) pose, because the points are {d}D"
    array = _shaped(_numbers(value, name, f"a ({n}, {n}) pose"), name, (n, n), wanted)
    error = rigidity_error(array)
    if not error <= RIGID:
        off = f"is not a rigid transformation (off by {error:.2g})"
        what = "holds NaN or infinite values" if math.isinf(error) else off
        raise InputError(f"{name} {what}; wanted [R t; 0 1] with RᵀR = I and det R = 1")
    return array


def poses(value: object, name: str, d: int) -> NDArray[np.float64]:
    """Rigid transformations (N, d+1, d+1)."""
    wanted = f"(N, {d + 1}, {d + 1})"
    array = _shaped(_numbers(value, name, f"an {wanted} array of poses"), name, (None, d + 1, d + 1), wanted)
    for index, each in enumerate(array):
        if not rigidity_error(each) <= RIGID:
            pose(each, f"{name}[{index}]", d)
    return array


def within_map(points: NDArray[np.floating], T: NDArray[np.float64], voxel_m: float, name: str) -> None:
    """Refuse points that, moved by T, lie beyond what a voxel map can address."""
    at_most_m = math.sqrt(points.shape[1]) * largest_magnitude(points) + math.hypot(*T[:-1, -1].tolist())
    if at_most_m < REACH * voxel_m:  # an upper bound, without moving them
        return
    farthest_m = largest_magnitude(points @ T[:-1, :-1].T + T[:-1, -1])
    if not farthest_m < REACH * voxel_m:
        raise InputError(
            f"{name} reach {farthest_m:.3g} m from the origin; a map of {voxel_m:g} m voxels holds "
            f"{REACH * voxel_m:.3g} m: give meters, and coordinates near the lidar (subtract a map offset)"
        )


def within_voxels(
    points: NDArray[np.floating], voxel_m: float, name: str, *, max_range_m: float = math.inf
) -> None:
    """Refuse points within a range that lie so far away or apart, in voxels, that voxels would share a key."""
    if max_range_m < REACH * voxel_m or largest_magnitude(points) < REACH * voxel_m:
        return
    used = points[np.linalg.norm(points, axis=1) <= max_range_m] if math.isfinite(max_range_m) else points
    apart_m = float(np.ptp(used, axis=0).max()) if len(used) else 0.0
    farthest_m = float(np.abs(used).max(initial=0.0))
    if not (apart_m < 2.0 * REACH * voxel_m and farthest_m < _LARGEST_VOXEL * voxel_m):
        raise InputError(
            f"{name} lie up to {farthest_m:.3g} m from the origin and {apart_m:.3g} m apart; voxels of "
            f"{voxel_m:g} m reach {_LARGEST_VOXEL * voxel_m:.3g} and {2.0 * REACH * voxel_m:.3g} m: take larger "
            "ones, give meters, and coordinates near the lidar (subtract a map offset)"
        )


def point_times(value: object, name: str, count: int) -> NDArray[np.float32]:
    """Seconds (N,) of points relative to their scan's stamp; (0,) for None or an empty array."""
    if value is None:
        return np.empty(0, np.float32)
    if type(value) is np.ndarray and value.dtype == np.float32 and value.shape == (0,):
        return value
    is_ready = _is_ready(value, np.float32)
    array = _numbers(value, name, "seconds, one per point", np.float32 if is_ready else np.float64)
    if array.shape != (0,):
        _shaped(array, name, (count,), f"({count},), one per point, or None")
    farthest_s = largest_magnitude(array)
    if not farthest_s <= LONGEST_SWEEP_S:
        raise InputError(
            f"{name}: a point lies {farthest_s:.3g} s from the stamp of its scan; wanted seconds after the stamp, "
            f"at most {LONGEST_SWEEP_S:g} (from nanoseconds: 1e-9 * times; from absolute times: minus the stamp)"
        )
    return array if is_ready else array.astype(np.float32)


def truth(value: object, name: str) -> bool:
    """True or False; strings and numbers are refused: Python takes the string "no" as true."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    raise InputError(f"{name} is {shown(value)}; wanted True or False")


def truths(value: object, name: str, count: int) -> NDArray[np.bool_]:
    """Booleans (N,), one for each of ``count`` items."""
    array = _array(value, name, f"({count},) of True or False")
    if array.shape != (count,) or (array.dtype.kind != "b" and count):
        raise InputError(f"{name} is {shown(value)} of {_kind(array)}; wanted ({count},) of True or False")
    return array.astype(np.bool_, copy=False)


def one_of(value: object, choices: tuple[str, ...], name: str) -> None:
    """Refuse what is not one of a few words."""
    if not (isinstance(value, str) and value in choices):
        raise InputError(f"{name} is {shown(value)}; it must be one of {', '.join(choices)}")


def integer(value: object, name: str, wanted: str, *, least: int | None = None) -> int:
    """A whole number, not below ``least``; floats are refused, also those without a fraction."""
    try:
        whole = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        whole = None
    if whole is None or isinstance(value, bool) or (least is not None and whole < least):
        raise InputError(f"{name} is {shown(value)}; wanted {wanted}")
    if abs(whole) > _LARGEST_WHOLE:
        raise InputError(f"{name} is {shown(value)}, too large for 64 bits; wanted {wanted}")
    return whole


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def positive(value: object, name: str) -> float:
    """A finite number above 0."""
    if _is_number(value) and 0.0 < value < math.inf:
        return float(value)
    raise InputError(f"{name} is {shown(value)}; wanted a finite number > 0")


def seconds(value: object, name: str) -> float:
    """A stamp in seconds; a present-day one in nanoseconds is refused."""
    if _is_number(value) and abs(value) < _LATEST_S:
        return float(value)
    raise InputError(f"{name} is {shown(value)}; wanted seconds, as a number below {_LATEST_S:.0e}{SMALLER_UNITS}")


def weights(value: object, name: str, count: int) -> NDArray[np.float64]:
    """Weights (N,), finite and not negative."""
    array = _shaped(_numbers(value, name, f"({count},) weights"), name, (count,), f"({count},), one per pair")
    if not ((array >= 0.0) & (array <= LARGEST)).all():
        raise InputError(
            f"{name} holds negative, NaN, infinite or huge values; wanted weights from 0 to {LARGEST:g}"
        )
    return array


def matrices(value: object, name: str, wanted: tuple[int, ...]) -> NDArray[np.float64]:
    """Finite numbers of a shape."""
    array = _shaped(_numbers(value, name, f"an array of the shape {wanted}"), name, wanted, f"{wanted}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} holds NaN or infinite values")
    return array


def whole_numbers(value: object, name: str, wanted: str) -> NDArray[np.int64]:
    """An array of whole numbers; floats are refused, since that alone distinguishes seconds from nanoseconds."""
    array = _array(value, name, wanted)
    if array.dtype.kind not in "iu" and array.size:
        raise InputError(f"{name} holds {_kind(array)}; wanted whole numbers: {wanted}")
    return array.astype(np.int64, copy=False)


def indices(value: object, name: str) -> NDArray[np.int64]:
    """Pairs (E, 2) of whole numbers."""
    pairs, wanted = _array(value, name, "(E, 2) indices of poses"), "(E, 2) whole numbers: indices of poses"
    return whole_numbers(_shaped(pairs, name, (None, 2), wanted), name, "(E, 2) indices of poses")


def instance(value: object, kind: type, name: str, remedy: str) -> None:
    """Refuse a value of another type."""
    if not isinstance(value, kind):
        raise InputError(f"{name} is {shown(value)}; wanted a {kind.__name__}: {remedy}")


def path(value: object, name: str) -> Path:
    """The path that a text or a path object names."""
    if not isinstance(value, str | Path) or "\0" in str(value):
        raise InputError(f"{name} is {shown(value)}; wanted a path, as text or pathlib.Path")
    return Path(value)


@contextmanager
def writing(path: Path, *, force: bool = True) -> Generator[None]:
    """A context that raises InputError if a path cannot be written, for lack of a folder or of permission.

    force : whether an existing file may be replaced
    """
    if path.exists() and not force:
        raise InputError(f"{path}: exists; choose another name or pass --force to replace it")
    try:
        yield
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError) as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); name a file in a folder that exists and is yours"
        ) from None


def _shaped(array: NDArray[Any], name: str, shape: tuple[int | None, ...], wanted: str) -> NDArray[Any]:
    """The array, which must have this shape; None stands for any size."""
    if array.shape == shape or (
        array.ndim == len(shape) and all(size in (n, None) for n, size in zip(array.shape, shape, strict=True))
    ):
        return array
    raise InputError(f"{name} has the shape {array.shape}; wanted {wanted}")


def _numbers(value: object, name: str, wanted: str, dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """The value as a C-contiguous, writeable array of this dtype."""
    if _is_ready(value, dtype):
        return value  # type: ignore[return-value]
    if np.ma.is_masked(value):
        raise InputError(f"{name} has masked entries; leave them out")
    if value is None:
        raise InputError(f"{name} is None; wanted {wanted}")
    array = _array(value, name, wanted)
    if array.dtype.kind not in "iuf":
        raise InputError(f"{name} holds {_kind(array)}, not real numbers; wanted {wanted}")
    with np.errstate(over="ignore"):  # values that overflow to infinity are refused later
        return np.require(array, dtype, ["C_CONTIGUOUS", "WRITEABLE", "ALIGNED"]).view(np.ndarray)


def _array(value: object, name: str, wanted: str) -> NDArray[Any]:
    try:
        return np.asarray(value)
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{name} is {shown(value)}, no array ({one_line(error)}); wanted {wanted}") from None


def _is_ready(value: object, dtype: DTypeLike) -> bool:
    return type(value) is np.ndarray and value.dtype == dtype and value.flags.carray


def _remedy(array: NDArray[Any], name: str, d: int) -> str:
    """Hint for an array of another shape, empty where there is none."""
    if array.ndim == 2 and array.shape[1] > d and array.shape[0] != d:
        return f"; of more columns, as with intensity, pass {name}[:, :{d}]"
    if array.ndim == 3 and array.shape[2] == d:
        return f"; organized? pass {name}.reshape(-1, {d})"
    if array.ndim == 2 and array.shape[0] == d:
        return f"; transposed? pass {name}.T"
    if array.ndim == 2 and array.shape[1] == d - 1:
        return f"; {d - 1}D points need a {d - 1}D map or odometry"
    return ""


def _where(value: object, name: str) -> str:
    """Hint at the coordinates of a cloud of another library; empty where unknown."""
    if isinstance(value, np.ndarray) and value.dtype.names:
        return f": np.stack([{name}[axis] for axis in 'xyz'], axis=1)"
    return f": np.asarray({name}.points)" if hasattr(value, "points") else ""


def _kind(array: NDArray[Any]) -> str:
    kinds = {"b": "booleans", "c": "complex numbers", "O": "objects", "U": "text", "S": "text"}
    return kinds.get(array.dtype.kind, f"{array.dtype}")
