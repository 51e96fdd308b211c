"""The registry of log formats, and the index of a path or address."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from scanchain import plugins
from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.files import Source
from scanchain.logs.files import RemoteFile, fetch_whole, misspelled
from scanchain.logs.formats import UnknownFormatError, left_out, natural_order
from scanchain.logs.formats.carmen import index_carmen, is_carmen
from scanchain.logs.formats.clouds import SUFFIXES, index_clouds
from scanchain.logs.formats.kitti import index_kitti_odometry, index_kitti_raw
from scanchain.logs.formats.ros1_bag import index_ros1_bag
from scanchain.logs.formats.ros2_bag import index_ros2_bag, parts_of_bag
from scanchain.logs.formats.user import index_scans
from scanchain.logs.index import FileIndex
from scanchain.logs.mcap.index import index_by_summary, index_file
from scanchain.logs.stream import are_parts, complete

FORMATS: dict[str, tuple[str, Callable[..., FileIndex]]] = {  # with descriptions for errors; see _format_of
    "mcap": ("MCAP", index_file),
    "ros1": ("a ROS 1 .bag", index_ros1_bag),
    "ros2": ("a ROS 2 .db3 or the folder of a ROS 2 bag", index_ros2_bag),
    "carmen": ("a CARMEN .log or .clf (also .bz2, .gz)", index_carmen),
    "kitti-raw": ("a KITTI raw drive", index_kitti_raw),
    "kitti-odometry": ("a KITTI odometry sequence", index_kitti_odometry),
    "clouds": ("a folder of PCD, PLY, .npy or .bin files", index_clouds),
}
_KNOWN = ", ".join(description for description, _ in FORMATS.values())
_KNOWN += ", or name a class of your own that reads it, --log.format module:Class"
AUTO = "auto"  # value of log.format: the format is recognized from the path

_RUN_FILE, _BAG_FILE = "run.json", "metadata.yaml"
_PART_SUFFIXES = (".mcap", ".bag", ".db3")
_LOG_SUFFIXES = (*_PART_SUFFIXES, ".log", ".clf", ".bz2", ".gz")
_POSE_GRAPH = re.compile(rb"^\s*(VERTEX|EDGE)(2|3|_\w+)?(:QUAT)?\s", re.MULTILINE)  # of g2o or TORO
_HEAD_BYTES = 64  # leading bytes of a file from which its format is recognized
_DEFAULTS = LogConfig()


def index_files(sources: Sequence[Source], config: LogConfig = _DEFAULTS) -> list[FileIndex]:
    """Index of each file in a log's files, folders and addresses, with every channel and its message count.

    Raises InputError for a source that is no log or cannot be read.
    """
    name = config.format
    if name != AUTO and name not in FORMATS:
        if ":" not in name:
            raise InputError(
                f"log.format {name!r} is unknown; wanted {AUTO}, {', '.join(FORMATS)} or module:Class"
            )
        plugins.load(name, "scans")  # before anything is downloaded
        files = list(sources)
    else:
        files = [part for source in sources for part in _parts(source)]
    for each in files:
        if complaint := misspelled(each):
            raise InputError(complaint)
    indexes = [_index(source, number, config) for number, source in enumerate(files)]
    for index in indexes:
        complete(index)
    for source in sources if name == AUTO else []:
        parts = _parts(source)
        if isinstance(source, Path) and source not in parts and not (source / _BAG_FILE).is_file():
            taken = Path(parts[0].name).suffix
            indexes[0].notes += left_out(source, taken, (*_PART_SUFFIXES, *SUFFIXES))
    return indexes


def logs_in(folder: Path) -> list[Path]:
    """Logs in a folder, sorted by name; only the folder itself if it is one log or contains the parts of one."""
    if _is_claimed(folder):
        return [folder]
    found = [path for path in sorted(folder.iterdir(), key=natural_order) if _is_named_as_log(path)]
    if len(found) < 2:
        return [folder]
    try:  # parts of one log: consecutive in time, or without a common lidar topic
        is_one = found == _parts(folder) and are_parts(index_files(found))
    except InputError:
        is_one = False
    return [folder] if is_one else found


def _is_named_as_log(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in _LOG_SUFFIXES
    return path.is_dir() and (_is_claimed(path) or _parts(path) != [path])


def _is_claimed(folder: Path) -> bool:
    return (folder / _RUN_FILE).is_file() or _format_of(folder, b"") != ""


def _index(source: Source, number: int, config: LogConfig) -> FileIndex:
    """Index of a file; a remote one that cannot be read in parts by its own index is downloaded first."""
    if isinstance(source, Path):
        return _index_path(source, number, config)
    file = RemoteFile(source)
    if file.has_ranges and config.format in (AUTO, "mcap"):
        index = index_by_summary(file, number)
        if index is not None:
            return index
    copy = fetch_whole(file)
    try:
        index = _index_path(copy, number, config)
    except InputError as error:
        raise InputError(error.text.replace(str(copy), str(source))) from error
    why = "has no index to read it by" if file.has_ranges else "lies on a server that sends no parts of files"
    index.notes.insert(0, f"{copy}: {why}, so all {copy.stat().st_size / 1e6:.1f} MB of it were downloaded")
    index.path = source
    for lines in (index.notes, index.damage):
        lines[:] = [line.replace(str(copy), str(source)) for line in lines]
    return index


def _index_path(path: Path, number: int, config: LogConfig) -> FileIndex:
    if config.format != AUTO and config.format not in FORMATS:
        return index_scans(path, number, config.format)
    try:
        head = b""
        if path.is_file():
            with path.open("rb") as file:
                head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    try:
        _, index_of = FORMATS[_claiming(path, head) if config.format == AUTO else config.format]
        if index_of is index_clouds:
            return index_clouds(path, number, config.rate_hz, config.bin_columns)
        return index_of(path, number)
    except UnknownFormatError as error:
        text, lack = error.args
        if _POSE_GRAPH.search(text):
            raise InputError(f"{path}: is a pose graph, no log; give it to scanchain optimize") from None
        raise InputError(f"{path}: is not a recognized log ({lack}); give {_KNOWN}") from None


def _format_of(path: Path, head: bytes) -> str:
    """Format of a path by its first bytes (empty for a folder) or its contents; empty if none is recognized."""
    claims = {
        "mcap": head.startswith(MCAP0_MAGIC) or not (head or path.is_dir()),  # an empty file is refused as such
        "ros1": head.startswith(b"#ROSBAG"),
        "ros2": head.startswith(b"SQLite format 3\0") or path.suffix == ".db3" or (path / _BAG_FILE).is_file(),
        "carmen": is_carmen(head),
        "kitti-raw": (path / "velodyne_points").is_dir(),
        "kitti-odometry": (path / "velodyne").is_dir() and (path / "times.txt").is_file(),
        "clouds": path.is_dir() and any(each.suffix.lower() in SUFFIXES for each in path.iterdir()),
    }
    return next((name for name, is_claimed in claims.items() if is_claimed), "")


def _claiming(path: Path, head: bytes) -> str:
    """Recognized format of a path. Without one raises UnknownFormatError for a file, InputError for a folder."""
    if (path / _RUN_FILE).is_file():
        raise InputError(f"{path}: is a run directory, no log; give the log that its {_RUN_FILE} names")
    if name := _format_of(path, head):
        return name
    if path.is_dir():
        raise InputError(f"{path}: is a folder without a recognized log; give {_KNOWN}")
    raise UnknownFormatError(head, f"starts with {head[:8]!r}")


def _parts(source: Source) -> Sequence[Source]:
    """Files of a folder that contains the parts of a log, in order; else the source itself."""
    if not isinstance(source, Path) or not source.is_dir():
        return [source]
    if (source / _BAG_FILE).is_file():
        return parts_of_bag(source)
    parts = (sorted(source.glob(f"*{suffix}"), key=natural_order) for suffix in _PART_SUFFIXES)
    return next(filter(None, parts), [source])
