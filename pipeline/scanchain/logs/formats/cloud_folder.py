"""A folder of PCD, PLY, .npy or raw .bin files, one a scan; stamps by their names, or at a rate."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.errors import InputError, counted
from scanchain.logs.formats.cloud_file import (
    SUFFIXES,
    XYZI,
    CloudFileError,
    point_of_columns,
    read_cloud_file,
)
from scanchain.logs.formats.on_demand import add_block, add_channel, left_out, natural_order, on_demand_index
from scanchain.logs.mcap.records import Block, Contents, FileIndex, Message
from scanchain.logs.writing.pack import LATEST_NS, pack_cloud

_UNITS_NS = {19: 1, 16: 1_000, 13: 1_000_000}  # nanoseconds of a stamp's unit, by its number of digits since 2001
_FIRST_FILES = 3  # number of files of which one has to be readable
_LIKELY_COLUMNS = (4, 3, 5, 6)  # numbers of columns of .bin files, the first where none is more likely
_SAMPLE_BYTES, _VOTERS = 1 << 20, 5  # bytes read of a .bin file; number of files sampled
_SMALLEST, _LARGEST, _MOSTLY = 1e-9, 1e7, 0.98  # plausible magnitudes, and least share of the numbers within
_FEWEST_ROWS = 20  # least number of rows from which columns are distinguished
_ALIKE, _HARDLY = 0.5, 0.05  # largest differences of equal columns, in spreads of the two, and of all
_NOTHING = 0.1  # contrast below which no layout is preferred
_NS = 1_000_000_000


def claims_clouds(path: Path, _: bytes) -> bool:
    """True for a folder with such files."""
    return path.is_dir() and any(entry.suffix.lower() in SUFFIXES for entry in path.iterdir())


def index_clouds(folder: Path, number: int, rate_hz: float = 0.0) -> FileIndex:
    """The files of a folder as the scans of /points.

    rate_hz : at which they come, from the epoch on; 0 takes the stamps from the names. Raises InputError where
        those are none.
    """
    files = _files(folder)
    stamps_ns = [round(k * _NS / rate_hz) for k in range(len(files))] if rate_hz else _stamps(folder, files)
    index = on_demand_index(folder, number)
    index.takes_rate = True
    raw = _raw_point(folder, files)
    index.notes += [*_found(folder, files, raw), *left_out(folder, files[0].suffix.lower(), SUFFIXES)]
    channel = add_channel(index, "/points", "sensor_msgs/msg/PointCloud2")
    for place, (file, stamp_ns) in enumerate(zip(files, stamps_ns, strict=True)):
        add_block(index, place, file.stat().st_size, [stamp_ns], {channel: 1})

    def make(block: Block, wanted: AbstractSet[int] | None) -> Contents:
        file, stamp_ns = files[block.offset], stamps_ns[block.offset]
        if wanted is not None and channel.key[1] not in wanted:
            return Contents([], "")
        try:
            data = pack_cloud(stamp_ns, "lidar", read_cloud_file(file, raw))
        except (CloudFileError, OSError) as error:
            unreadable = Message(channel, stamp_ns, memoryview(b""), f"{file.name} {error}")
            return Contents([unreadable], f"{file}: {error}; it was left out")
        return Contents([Message(channel, stamp_ns, memoryview(data))], "")

    index.make = make
    return index


def _raw_point(folder: Path, files: Sequence[Path]) -> np.dtype[np.void]:
    """Layout of a point in .bin files."""
    try:
        return raw_point(files if files[0].suffix.lower() == ".bin" else [])
    except CloudFileError as error:
        raise InputError(f"{folder}: {files[0].name} {error}; save clouds as .npy, PCD or PLY") from error


def _found(folder: Path, files: Sequence[Path], raw: np.dtype[np.void]) -> list[str]:
    """Fields of the files, by the first that can be read."""
    for file in files[:_FIRST_FILES]:
        try:
            points = read_cloud_file(file, raw)
        except (CloudFileError, OSError):
            continue
        kinds = ", ".join(dict.fromkeys(points.dtype[name].name for name in points.dtype.names or ()))
        names = " ".join(points.dtype.names or ())
        suffix = file.suffix.lower()
        guess = " (as their numbers suggest)" if suffix == ".bin" else ""
        held = f"{names}, {kinds}{guess}; {counted(len(points), 'point')} in {file.name}"
        return [f"{folder}: {counted(len(files), f'{suffix} file')} of {held}"]
    return []


def stamp_of_name(stem: str) -> int | None:
    """The stamp in nanoseconds in a file's name, None where there is none.

    Understood are nanoseconds, micro- and milliseconds since the epoch as 19, 16 and 13 digits, seconds with a
    fraction (``12.375``), and seconds and nanoseconds apart (``cloud_1583836591_182590976``).
    """
    stamp_ns = LATEST_NS
    if match := re.search(r"(?<!\d)(\d{1,10})\.(\d{1,9})$", stem):
        stamp_ns = int(match[1]) * _NS + int(match[2].ljust(9, "0"))
    elif match := re.search(r"(?<!\d)(\d{9,10})[_-](\d{1,9})$", stem):
        stamp_ns = int(match[1]) * _NS + int(match[2])
    elif match := re.search(r"(?<!\d)([1-9]\d*)$", stem):
        stamp_ns = int(match[1]) * _UNITS_NS.get(len(match[1]), LATEST_NS)
    return stamp_ns if stamp_ns < LATEST_NS else None


def _files(folder: Path) -> list[Path]:
    """The files of the first kind that the folder has."""
    found = [file for file in folder.iterdir() if file.is_file()]
    for suffix in SUFFIXES:
        files = sorted((file for file in found if file.suffix.lower() == suffix), key=natural_order)
        if files:
            return files
    raise InputError(f"{folder}: has no {', '.join(SUFFIXES)} file; name the folder that holds them")


def _stamps(folder: Path, files: Sequence[Path]) -> list[int]:
    stamps_ns = [stamp for file in files if (stamp := stamp_of_name(file.stem)) is not None]
    if len(stamps_ns) < len(files) or len(set(stamps_ns)) < len(files):
        raise InputError(
            f"{folder}: names such as {files[0].name} hold no stamp; set the rate of the scans, "
            "as in --log.rate_hz 10"
        )
    return stamps_ns


def raw_point(files: Sequence[Path]) -> np.dtype[np.void]:
    """Layout of a point in .bin files, without a header: float32 or float64, x y z and up to three columns more.

    A few files vote, since some may be damaged; a layout must divide the size of most. Of several the one whose
    columns differ most in mean and spread is taken: numbers that are cut into wrong rows mix them, so that all
    columns are equal. x, y, z, intensity where no other is more likely. Raises CloudFileError where none fits.
    """
    sizes = [file.stat().st_size for file in files]
    filled = [file for file, size in zip(files, sizes, strict=True) if size]
    if not filled:
        return XYZI
    voters = filled[:: max(len(filled) // _VOTERS, 1)]
    layouts = [_likely_layout(np.fromfile(file, np.uint8, _SAMPLE_BYTES), sizes) for file in voters]
    votes = Counter(layout for layout in layouts if layout is not None)
    if not votes:
        raise CloudFileError("holds neither float32 nor float64 numbers of 3 to 6 columns")
    return votes.most_common(1)[0][0]


def _likely_layout(sample: NDArray[np.uint8], sizes: Sequence[int]) -> np.dtype[np.void] | None:
    """Likely layout of the points of one file, None where no layout fits."""
    for kind in (np.dtype("<f4"), np.dtype("<f8")):
        values = sample[: len(sample) - len(sample) % kind.itemsize].view(kind)
        with np.errstate(invalid="ignore"):  # a damaged number may be a signaling NaN
            values = values.astype(np.float64)
        magnitude = np.abs(values)
        are_small = (magnitude == 0.0) | np.isnan(magnitude) | ((magnitude > _SMALLEST) & (magnitude < _LARGEST))
        fitting = [
            columns
            for columns in _LIKELY_COLUMNS
            if 2 * sum(size % (columns * kind.itemsize) == 0 for size in sizes) > len(sizes)  # some may be broken
        ]
        if fitting and len(values) and are_small.mean() > _MOSTLY:  # random bits would not
            contrasts = {columns: _contrast(_finite_rows(values, columns)) for columns in fitting}
            best = max(contrasts, key=lambda columns: contrasts[columns])
            if contrasts[best] < _NOTHING:
                best = fitting[0]
            is_repeated = best == 6 and 3 in fitting and _repeats(_finite_rows(values, 6))
            return point_of_columns(kind, 3 if is_repeated else best)
    return None


def _finite_rows(values: NDArray[np.float64], columns: int) -> NDArray[np.float64]:
    rows = values[: len(values) - len(values) % columns].reshape(-1, columns)
    return rows[np.isfinite(rows).all(axis=1)]


def _contrast(rows: NDArray[np.float64]) -> float:
    """Difference of columns in mean and spread, in spreads of all numbers."""
    if len(rows) < _FEWEST_ROWS:
        return 0.0
    spread = float(rows.std()) or 1.0
    return float(np.ptp(rows.mean(axis=0)) + np.ptp(rows.std(axis=0))) / spread


def _repeats(rows: NDArray[np.float64]) -> bool:
    """True if rows of six numbers are two of three: the fourth to sixth columns are as the first to third."""
    mean, spread = rows.mean(axis=0).reshape(2, 3), rows.std(axis=0).reshape(2, 3)
    near = _ALIKE * spread.max(axis=0) + _HARDLY * rows.std()
    return bool(((np.ptp(mean, axis=0) <= near) & (np.ptp(spread, axis=0) <= near)).all())
