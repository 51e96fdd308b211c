"""One cloud in a file, PCD, PLY, .npy or raw numbers, as an array of points with named fields."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.logs.formats.pcd import read_pcd
from scanchain.logs.formats.ply import read_ply
from scanchain.logs.formats.point_rows import CloudFileError

SUFFIXES = (".pcd", ".ply", ".npy", ".bin")
_MOST_COLUMNS = 16
_LIKELY_COLUMNS = (4, 3, 5, 6)  # of .bin files; the first where nothing speaks for another
_SAMPLE_BYTES, _VOTERS = 1 << 20, 5  # read of a .bin file, and of how many files about
_SMALLEST, _LARGEST, _MOSTLY = 1e-9, 1e7, 0.98  # sizes of numbers that are plausible, and how many must be
_FEWEST_ROWS = 20  # that tell columns apart
_ALIKE, _HARDLY = 0.5, 0.05  # differences of columns, in spreads of the two, and of all, that are none
_NOTHING = 0.1  # a contrast that speaks for no layout
_XYZI = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])


def read_cloud_file(path: Path, raw: np.dtype[np.void] = _XYZI) -> NDArray[np.void]:
    """The points (N,) of a file as they are, little endian, in number types that ROS knows.

    raw : a point of a .bin file
    Raises CloudFileError, and OSError where the file cannot be read.
    """
    readers = {".pcd": read_pcd, ".ply": read_ply, ".npy": read_npy, ".bin": lambda path: read_raw(path, raw)}
    rows = readers[path.suffix.lower()](path)
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise CloudFileError(f"has no x, y and z, but {', '.join(names) or 'nothing'}")
    numbers = [name for name in names if not rows.dtype[name].shape]
    point = np.dtype([(name, _ros_type(rows.dtype[name])) for name in numbers])
    return rows[numbers].astype(point, copy=False)


def read_xyzi(path: Path) -> NDArray[np.void]:
    """The points of a file of float32 x, y, z, intensity, as KITTI and others write them."""
    return read_raw(path, _XYZI)


def read_raw(path: Path, point: np.dtype[np.void]) -> NDArray[np.void]:
    """The points of a file that holds nothing else."""
    size = path.stat().st_size
    if size % point.itemsize:
        names = ", ".join(point.names or ())
        raise CloudFileError(f"has {size} bytes, not a multiple of the {point.itemsize} of {names}")
    return np.fromfile(path, point)


def read_npy(path: Path) -> NDArray[np.void]:
    """The points of a NumPy array, (N, 3) or more columns, x y z first, or (N,) with fields of these names."""
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise CloudFileError(f"is no .npy array of numbers ({' '.join(str(error).split())})") from error
    if not isinstance(array, np.ndarray):
        raise CloudFileError("is an archive of arrays, no .npy array; save each cloud in a file of its own")
    if array.dtype.names and array.ndim == 1:
        return array
    is_list = array.ndim == 2 and 3 <= array.shape[1] <= _MOST_COLUMNS
    if array.dtype.kind not in "fiu" or not is_list or (len(array) in (3, 4) and array.shape[1] > 4):
        raise CloudFileError(
            f"is an array {array.shape} of {array.dtype}; give numbers (N, 3), (N, 4) or more columns, x y z first"
        )
    return np.rec.fromarrays(list(array.T), dtype=_columns(array.dtype, array.shape[1]))


def raw_point(files: Sequence[Path]) -> np.dtype[np.void]:
    """How a point lies in .bin files, which do not say: float32 or float64, x y z and up to three more columns.

    A few files vote, since some may be damaged; a layout must divide the size of most. Of several the one whose
    columns differ most from each other in mean and spread is taken: numbers that are cut into wrong rows mix them,
    so that all columns look alike. x, y, z, intensity where nothing speaks for another. Raises CloudFileError
    where none fits.
    """
    sizes = [file.stat().st_size for file in files]
    filled = [file for file, size in zip(files, sizes, strict=True) if size]
    if not filled:
        return _XYZI
    voters = filled[:: max(len(filled) // _VOTERS, 1)]
    layouts = [_layout(np.fromfile(file, np.uint8, _SAMPLE_BYTES), sizes) for file in voters]
    votes = Counter(layout for layout in layouts if layout is not None)
    if not votes:
        raise CloudFileError("holds neither float32 nor float64 numbers of 3 to 6 columns")
    return votes.most_common(1)[0][0]


def _layout(sample: NDArray[np.uint8], sizes: Sequence[int]) -> np.dtype[np.void] | None:
    """How the points of one file seem to lie, None where no layout fits."""
    for kind in (np.dtype("<f4"), np.dtype("<f8")):
        values = sample[: len(sample) - len(sample) % kind.itemsize].view(kind)
        if not _are_plausible(values):
            continue
        contrasts = {
            columns: _contrast(values, columns)
            for columns in _LIKELY_COLUMNS
            if 2 * sum(size % (columns * kind.itemsize) == 0 for size in sizes) > len(sizes)  # some may be broken
        }
        if contrasts:
            best = max(contrasts, key=lambda columns: contrasts[columns])
            if contrasts[best] < _NOTHING:
                best = next(iter(contrasts))
            if best == 6 and 3 in contrasts and _repeats(values):
                best = 3
            return _columns(kind, best)
    return None


def _are_plausible(values: NDArray[np.floating]) -> bool:
    """Whether bytes that are read as such numbers look like meters and the like: random bits would not."""
    with np.errstate(invalid="ignore"):
        size = np.abs(values.astype(np.float64))
    return bool(np.mean((size == 0.0) | np.isnan(size) | ((size > _SMALLEST) & (size < _LARGEST))) > _MOSTLY)


def _contrast(values: NDArray[np.floating], columns: int) -> float:
    """How far columns differ in mean and spread, in spreads of all numbers."""
    rows = _finite_rows(values, columns)
    if len(rows) < _FEWEST_ROWS:
        return 0.0
    spread = float(rows.std()) or 1.0
    return float(np.ptp(rows.mean(axis=0)) + np.ptp(rows.std(axis=0))) / spread


def _repeats(values: NDArray[np.floating]) -> bool:
    """Whether rows of six numbers are two of three: the fourth to sixth columns are as the first to third."""
    rows = _finite_rows(values, 6)
    mean, spread = rows.mean(axis=0).reshape(2, 3), rows.std(axis=0).reshape(2, 3)
    near = _ALIKE * spread.max(axis=0) + _HARDLY * rows.std()
    return bool(((np.ptp(mean, axis=0) <= near) & (np.ptp(spread, axis=0) <= near)).all())


def _finite_rows(values: NDArray[np.floating], columns: int) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore"):  # a damaged number may be a signaling NaN
        rows = values[: len(values) - len(values) % columns].astype(np.float64).reshape(-1, columns)
    return rows[np.isfinite(rows).all(axis=1)]


def _columns(kind: np.dtype[np.generic], count: int) -> np.dtype[np.void]:
    """A point of so many numbers of a kind."""
    names = ["x", "y", "z", "intensity", *(f"column_{k}" for k in range(5, count + 1))][:count]
    return np.dtype([(name, kind.str) for name in names])


def _ros_type(kind: np.dtype[np.generic]) -> str:
    """The number type itself, little endian; what ROS does not know becomes float64, of 16 bits float32."""
    if kind.kind == "f" and kind.itemsize not in (4, 8):
        return "<f4" if kind.itemsize == 2 else "<f8"
    return "<f8" if kind.itemsize == 8 else kind.newbyteorder("<").str.replace("|", "<")
