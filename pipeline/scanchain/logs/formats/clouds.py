"""Folders of PCD, PLY, .npy or raw .bin files, one per scan, stamped by file name or at a fixed rate.

PCD: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. PLY: Turk 1994.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import IO

import lzf
import numpy as np
from numpy.typing import NDArray

from scanchain.config import LogConfig
from scanchain.errors import InputError, counted, printable
from scanchain.logs.formats import Format, add_block, add_channel, left_out, natural_order
from scanchain.logs.index import Block, Channel, Contents, FileIndex, Message
from scanchain.logs.writer import LATEST_NS, pack_cloud

_UNITS_NS = {19: 1, 16: 1_000, 13: 1_000_000}  # unit of a stamp by its number of digits, for stamps after 2001
_SPLIT = re.compile(r"(?<!\d)(\d{9,10})[_-](\d{1,9})$")
_DATE = re.compile(
    r"(?<!\d)(20\d\d)[-_]?(\d\d)[-_]?(\d\d)[T_ -]?(\d\d)[-:._]?(\d\d)[-:._]?(\d\d)(?:[.,_-](\d{1,9}))?Z?$"
)

SUFFIXES = (".pcd", ".ply", ".npy", ".bin")
XYZI = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])

_PCD_TYPES = {("F", "4"): "<f4", ("F", "8"): "<f8"} | {
    (sign, str(size)): f"<{code}{size}" for sign, code in (("I", "i"), ("U", "u")) for size in (1, 2, 4, 8)
}

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_FEWEST_ROWS, _MOST_ROWS = 100, 10_000  # number of points of a .bin file from which its columns are inferred
# shares of the variance between columns: that of the right number at least, and the most, over it, of a wrong one
_DISTINCT, _AMBIGUOUS = 0.2, 0.5
_NONE = 0.05  # share below which no columns are distinct; 0.04 for float64, 0.0 for one column after another
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}

_ONE_AT_A_TIME = Lock()  # for .npy headers: NumPy parses them with ast, which is not thread-safe in Python 3.11


class CloudFileError(Exception):
    """A file that contradicts its header; the text states where."""

    def __init__(self, text: str) -> None:
        super().__init__(printable(text))


def _rows(file: IO[bytes], point: np.dtype[np.void], count: int, *, is_text: bool) -> NDArray[np.void]:
    """The next ``count`` points of a file, packed one after another, or one line of numbers per point."""
    size = os.fstat(file.fileno()).st_size  # limits what a header may claim
    if is_text:
        if point.itemsize > 8 * size:
            raise CloudFileError(f"ends after 0 of its {count} points")
        lines = list(islice((line for line in file if line.strip()), min(count, size)))
        try:
            rows = np.loadtxt(lines, point, comments=None, ndmin=1) if lines else np.empty(0, point)
        except ValueError as error:
            raise CloudFileError(f"is not a list of {count} points ({error})") from error
    else:
        data = file.read(min(count * point.itemsize, size))
        rows = np.frombuffer(data, point, len(data) // max(point.itemsize, 1))
    if len(rows) < count:
        raise CloudFileError(f"ends after {len(rows)} of its {count} points")
    return rows


def read_cloud_file(path: Path, raw: np.dtype[np.void] = XYZI) -> NDArray[np.void]:
    """Unfiltered points (N,) of a file, little-endian, in number types that ROS supports.

    raw : layout of a point of a .bin file
    Raises CloudFileError if the file is malformed, OSError if it cannot be read.
    """
    readers = {".pcd": read_pcd, ".ply": read_ply, ".npy": read_npy, ".bin": lambda path: read_raw(path, raw)}
    rows = readers[path.suffix.lower()](path)
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise CloudFileError(f"has no x, y and z, but {', '.join(names) or 'nothing'}")
    numbers = [name for name in names if not rows.dtype[name].shape]
    point = np.dtype([(name, _ros_type(rows.dtype[name])) for name in numbers])
    return rows[numbers].astype(point, copy=False)


def read_raw(path: Path, point: np.dtype[np.void]) -> NDArray[np.void]:
    """Points of a file without a header."""
    size = path.stat().st_size
    if size % point.itemsize:
        names = ", ".join(point.names or ())
        raise CloudFileError(f"has {size} bytes, not a multiple of the {point.itemsize} of {names}")
    return np.fromfile(path, point)


def read_npy(path: Path) -> NDArray[np.void]:
    """Points of a NumPy array, (N, 3) or more columns with x y z first, or (N,) with fields x, y, z."""
    try:
        with _ONE_AT_A_TIME:
            array = np.load(path, allow_pickle=False)
    except OSError:
        raise
    except Exception as error:  # anything that NumPy, ast and tokenize raise for a damaged header
        raise CloudFileError("is not a .npy array of numbers") from error
    if not isinstance(array, np.ndarray):
        raise CloudFileError("is an archive of arrays, not a .npy array; save each cloud in a separate file")
    if array.dtype.names and array.ndim == 1:
        return array
    is_list = array.ndim == 2 and 3 <= array.shape[1] <= 16  # more indicate another kind of array
    if array.dtype.kind not in "fiu" or not is_list or (len(array) in (3, 4) and array.shape[1] > 4):
        raise CloudFileError(
            f"is an array {array.shape} of {array.dtype}; give numbers (N, 3), (N, 4) or more columns, x y z first"
        )
    return np.rec.fromarrays(list(array.T), dtype=point_of_columns(array.dtype, array.shape[1]))


def point_of_columns(kind: np.dtype[np.generic], count: int) -> np.dtype[np.void]:
    """Layout of a point of ``count`` numbers of type ``kind``."""
    names = ["x", "y", "z", "intensity", *(f"column_{k}" for k in range(5, count + 1))][:count]
    return np.dtype([(name, kind.str) for name in names])


def _ros_type(kind: np.dtype[np.generic]) -> str:
    """Little-endian number type; float64 for 8-byte integers and floats ROS lacks, float32 for 16-bit floats."""
    if kind.kind == "f" and kind.itemsize not in (4, 8):
        return "<f4" if kind.itemsize == 2 else "<f8"
    return "<f8" if kind.itemsize == 8 else kind.newbyteorder("<").str.replace("|", "<")


def read_pcd(path: Path) -> NDArray[np.void]:
    """Points of a PCD file (ascii, binary or binary_compressed) with all its fields."""
    with path.open("rb") as file:
        header = {words[0]: words[1:] for words in _header_lines(file, "DATA") if words}
        try:
            names, kinds = header["FIELDS"], list(zip(header["TYPE"], header["SIZE"], strict=True))
            counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
            fields = [  # a field with COUNT > 1 becomes one subarray
                (f"_{place}" if name == "_" else name, _PCD_TYPES[kind], (count,) if count > 1 else ())
                for place, (name, kind, count) in enumerate(zip(names, kinds, counts, strict=True))
            ]
            point, count, form = np.dtype(fields), int(header["POINTS"][0]), header["DATA"][0]
            if count < 0:
                raise ValueError(f"how many points there are, but {count}")
        except (KeyError, IndexError, ValueError) as error:
            raise CloudFileError(f"is not a PCD file: its header does not state {error}") from error
        if form == "binary_compressed":
            return _lzf_decompressed(file, point, count)
        return _rows(file, point, count, is_text=form == "ascii")


def _has_viewpoint(path: Path) -> bool:
    """True if a PCD file states a pose of the lidar other than the origin."""
    with suppress(OSError, ValueError), path.open("rb") as file:
        poses = [words[1:] for words in _header_lines(file, "DATA") if words[:1] == ["VIEWPOINT"]]
        return any(list(map(float, pose)) != [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0] for pose in poses)
    return False


def _header_lines(file: IO[bytes], last: str) -> Iterator[list[str]]:
    """Words of each line up to the one that begins with ``last``, at most a thousand lines."""
    for _ in range(1000):  # more indicate another kind of file
        words = file.readline(65536).decode("ascii", "replace").split()
        yield words
        if words[:1] == [last]:
            break


def _lzf_decompressed(file: IO[bytes], point: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """Points compressed by LZF, stored field by field."""
    packed_size, size = struct.unpack("<II", file.read(8).ljust(8, b"\0"))
    packed = file.read(packed_size)
    if size < count * point.itemsize or size > 1000 * len(packed):  # LZF reaches about 130
        raise CloudFileError(
            f"cannot be decompressed: {size} bytes are stated for {count} points, {len(packed)} are present"
        )
    data = b""
    with suppress(ValueError):
        data = lzf.decompress(packed, size)
    if data is None or len(data) != size:
        raise CloudFileError("cannot be decompressed: its bytes are damaged")
    rows = np.empty(count, point)
    offset = 0
    for name in point.names or ():
        field = point[name]
        rows[name] = np.frombuffer(data, field, count, offset)
        offset += count * field.itemsize
    return rows


def read_ply(path: Path) -> NDArray[np.void]:
    """Vertices of a PLY file (ascii, or binary in either byte order) with all their properties."""
    with path.open("rb") as file:
        point, count, form = _ply_header(file)
        return _rows(file, point, count, is_text=form == "ascii")


def _ply_header(file: IO[bytes]) -> tuple[np.dtype[np.void], int, str]:
    """Layout of a vertex, number of vertices, and format; the vertices must be the first element."""
    fields: list[tuple[str, str]] = []
    form, element, count, words = "", "", 0, list[str]()
    for words in _header_lines(file, "end_header"):
        match words:
            case ["format", form, *_] if form in _PLY_ORDERS:
                pass
            case ["element", element, number, *_]:
                if element == "vertex" and number.isdigit() and len(number) < 20:
                    count = int(number)
                elif not fields:
                    raise CloudFileError(f"has {element} before its vertices, which is not supported")
            case ["property", kind, name] if kind in _PLY_TYPES and element == "vertex":
                fields.append((name, _PLY_ORDERS.get(form, "<") + _PLY_TYPES[kind]))
            case ["property", *_] if element == "vertex":
                raise CloudFileError(f"has the vertex property {' '.join(words[1:])!r}, which is not supported")
    if not form or not fields or words != ["end_header"]:
        raise CloudFileError("is not a PLY file with vertices, or its header does not end")
    if len(dict(fields)) < len(fields):
        raise CloudFileError(f"has two vertex properties of one name: {' '.join(name for name, _ in fields)}")
    return np.dtype(fields), count, form


def index_clouds(folder: Path, number: int, config: LogConfig) -> FileIndex:
    """Index of a folder's files as the scans of /points; of several formats the first in SUFFIXES is read.

    Raises InputError if the names contain no stamps, or the .bin files do not have such points.
    """
    found = sorted((file for file in folder.iterdir() if file.is_file()), key=natural_order)
    kinds = {suffix: [file for file in found if file.suffix.lower() == suffix] for suffix in SUFFIXES}
    suffix, files = next(((suffix, files) for suffix, files in kinds.items() if files), ("", []))
    if not files:
        raise InputError(f"{folder}: has no {', '.join(SUFFIXES)} file; name the folder that contains them")
    if config.rate_hz:
        stamps_ns = [round(k * 1e9 / config.rate_hz) for k in range(len(files))]
    else:
        stems = [file.stem.removesuffix(".pcd") for file in files]
        places = max((len(match[2]) for match in map(_SPLIT.search, stems) if match), default=9)
        places = places if places <= 6 else 9  # nanoseconds may be unpadded
        stamps_ns = [stamp for stem in stems if (stamp := stamp_of_name(stem, places)) is not None]
    if len(set(stamps_ns)) < len(files):
        raise InputError(
            f"{folder}: names such as {files[0].name} contain no stamp; set the rate of the scans, "
            "as in --log.rate_hz 10"
        )
    index = FileIndex(folder, number)
    raw = point_of_columns(np.dtype("<f4"), config.bin_columns)
    sizes = [file.stat().st_size for file in files]
    if suffix == ".bin" and np.mean(np.mod(sizes, raw.itemsize) == 0) < 0.5:  # some of the files may be damaged
        raise InputError(
            f"{files[0]}: has {sizes[0]} bytes, no multiple of {config.bin_columns} float32 numbers; set "
            "their number, as in --log.bin_columns 5, or save clouds as .npy, PCD or PLY"
        )
    index.notes += [*_found(folder, files, raw), *left_out(folder, suffix, SUFFIXES)]
    if suffix == ".bin" and (columns := _columns(files[0], config.bin_columns)) != config.bin_columns:
        wrong = f"its numbers are those of {columns} columns, not of {config.bin_columns}, and points are wrong"
        none = "its numbers are no rows of float32 (float64, or column by column?), and points are wrong"
        fix = f"{wrong}: set --log.bin_columns {columns}" if columns else f"{none}: save clouds as .npy"
        index.add_damage(f"{files[0]}: {fix}")
    if suffix == ".pcd" and _has_viewpoint(files[-1]):  # that of the first may be the origin
        index.notes.append(f"{files[-1]}: its VIEWPOINT is not used: points are taken as relative to the lidar")
    channel = add_channel(index, "/points", "sensor_msgs/msg/PointCloud2")
    for place, (size, stamp_ns) in enumerate(zip(sizes, stamps_ns, strict=True)):
        add_block(index, place, size, [stamp_ns], {channel: 1})

    def make(_: FileIndex, block: Block, wanted: AbstractSet[int] | None) -> Contents:
        return contents_of(files[block.offset], channel, block.start_ns, lambda file: read_cloud_file(file, raw))

    index.contents = make
    return index


def _columns(file: Path, stated: int) -> int:
    """Number of columns of a .bin file: ``stated``, or another number if only its columns are distinct; or 0.

    0 means that no columns are distinct. By the share of the variance of the logarithms that is between columns:
    with clouds of KITTI and PandaSet at least 0.34 for the right number, and at most 0.01 for one without a common
    divisor.
    """
    logs, shares = np.empty(0), dict[int, float]()
    with suppress(OSError):
        logs = np.log(np.clip(np.abs(np.nan_to_num(np.fromfile(file, "<f4", 8 * _MOST_ROWS))), 1e-3, 1e6))
    for count in range(3, 9):
        rows = logs[: len(logs) // count * count].reshape(-1, count)
        shares[count] = (
            float(rows.mean(axis=0).var() / max(rows.var(), 1e-12)) if len(rows) >= _FEWEST_ROWS else 0.0
        )
    best = next(count for count in shares if shares[count] >= 0.9 * max(shares.values()))
    if stated > 3 and 0.0 < shares[best] < _NONE:  # x, y and z alone may be distributed equally
        return 0
    return best if shares.get(stated, 1.0) < _AMBIGUOUS * shares[best] and shares[best] > _DISTINCT else stated


def contents_of(
    file: Path, channel: Channel, stamp_ns: int, read: Callable[[Path], NDArray[np.void]], frame: str = "lidar"
) -> Contents:
    """Contents of a block with a cloud file as its only message, malformed if the file cannot be read."""
    try:
        data = pack_cloud(stamp_ns, frame, read(file))
    except (CloudFileError, OSError) as error:
        unreadable = Message(channel, stamp_ns, memoryview(b""), f"{file.name} {error}")
        return Contents([unreadable], f"{file}: {error}; it is skipped")
    return Contents([Message(channel, stamp_ns, memoryview(data))], "")


def _found(folder: Path, files: Sequence[Path], raw: np.dtype[np.void]) -> list[str]:
    """Note on the fields of the files, by the first file that can be read; none if three cannot."""
    for file in files[:3]:
        with suppress(CloudFileError, OSError):
            points = read_cloud_file(file, raw)
            kinds = ", ".join(dict.fromkeys(points.dtype[name].name for name in points.dtype.names or ()))
            guess = " (log.bin_columns)" if file.suffix.lower() == ".bin" else ""
            held = (
                f"{printable(' '.join(points.dtype.names or ()))}, {kinds}{guess}; {counted(len(points), 'point')}"
            )
            kind = f"{file.suffix.lower()} file"
            return [f"{folder}: {counted(len(files), kind)} of {held} in {file.name}"]
    return []


def stamp_of_name(stem: str, places: int = 9) -> int | None:
    """Stamp in nanoseconds in a file's name, None if there is none.

    Supported are nano-, micro- and milliseconds since the epoch as 19, 16 and 13 digits, seconds with a fraction
    (``12.375``), seconds and nanoseconds separately (``cloud_1583836591_182590976``), or a fraction of fewer
    ``places``, and dates with a time of day, as UTC (``2011-09-26_14-14-10.25``, ``20110926_141410_250``).
    """
    stamp_ns = LATEST_NS
    if match := _DATE.search(stem):
        with suppress(ValueError):
            date = np.datetime64("{}-{}-{}T{}:{}:{}".format(*match.groups()), "s")
            stamp_ns = int(date.astype(np.int64)) * 1_000_000_000 + int((match[7] or "0").ljust(9, "0"))
    elif match := re.search(r"(?<!\d)(?<!\d\d[-:]\d\d[-:])(\d{1,10})\.(\d{1,9})$", stem):
        stamp_ns = int(match[1]) * 1_000_000_000 + int(match[2].ljust(9, "0"))
    elif match := _SPLIT.search(stem):
        stamp_ns = int(match[1]) * 1_000_000_000 + int(match[2]) * 10 ** (9 - places)
    elif match := re.search(r"(?<!\d)([1-9]\d*)$", stem):
        stamp_ns = int(match[1]) * _UNITS_NS.get(len(match[1]), LATEST_NS)
    return stamp_ns if stamp_ns < LATEST_NS else None


def _is_folder(path: Path, _: bytes) -> bool:
    return path.is_dir() and any(each.suffix.lower() in SUFFIXES for each in path.iterdir())


FORMAT = Format("clouds", "a folder of PCD, PLY, .npy or .bin files", _is_folder, index_clouds, SUFFIXES, "scans")
