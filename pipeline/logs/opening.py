"""What lies at a path, and its index: MCAP, ROS bags, CARMEN text, folders of sweeps or of the parts of a log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from scanchain.errors import InputError
from scanchain.logs.files import RemoteFile, fetch_whole, misspelled
from scanchain.logs.formats.carmen import index_carmen
from scanchain.logs.formats.cloud_file import SUFFIXES
from scanchain.logs.formats.cloud_folder import index_clouds
from scanchain.logs.formats.kitti import index_kitti_odometry, index_kitti_raw
from scanchain.logs.formats.made import KNOWN, left_out, natural_order, unknown
from scanchain.logs.formats.ros2_bag import index_bag, parts_of_bag
from scanchain.logs.mcap.index import index_file
from scanchain.logs.mcap.records import MAGIC, FileIndex
from scanchain.logs.mcap.selection import complete
from scanchain.logs.mcap.summary import index_by_summary
from scanchain.source import Source

HAS_STAMPS = "the log has its own stamps, it is no folder of clouds"  # why log.rate_hz has no effect

Indexer = Callable[[Path, int], FileIndex]

_PART_SUFFIXES = (".mcap", ".bag", ".db3")


def index_files(sources: Sequence[Source], rate_hz: float = 0.0) -> list[FileIndex]:
    """What lies where in a log's files, folders and addresses, every channel known and counted.

    Raises InputError for what is no log, or cannot be read.

    rate_hz : at which the files of a folder come whose names tell no time; 0 where that is not known
    """
    if not sources:
        raise InputError("no log was named; give at least one file or folder")
    files = [part for source in sources for part in _parts(source)]
    for each in files:
        if complaint := misspelled(each):
            raise InputError(complaint)
    indexes = [_index(source, number, rate_hz) for number, source in enumerate(files)]
    for index in indexes:
        complete(index)
    indexes[0].notes += [note for source in sources for note in _other_parts(source)]
    return indexes


def _index(source: Source, number: int, rate_hz: float) -> FileIndex:
    if isinstance(source, Path):
        return _indexer(source, rate_hz)(source, number)
    file = RemoteFile(source)
    index = index_by_summary(file, number) if file.has_ranges else None
    return index or _index_whole(file, number)


def _index_whole(file: RemoteFile, number: int) -> FileIndex:
    """That of a copy of a remote file which has no index to read it by."""
    copy = fetch_whole(file)
    indexer = _file_indexer(copy)
    index = index_file(copy, number, file.address) if indexer is index_file else indexer(copy, number)
    why = "has no index to read it by" if file.has_ranges else "lies on a server that sends no parts of files"
    index.notes.insert(0, f"{file.address}: {why}, so all {copy.stat().st_size / 1e6:.1f} MB of it were fetched")
    return index


def _parts(source: Source) -> Sequence[Source]:
    """The files of a folder that holds the parts of a log, in the order of their names; else the source itself."""
    if not isinstance(source, Path) or not source.is_dir():
        return [source]
    path = source
    if (path / "metadata.yaml").is_file():
        return parts_of_bag(path)
    for suffix in _PART_SUFFIXES:
        parts = sorted(path.glob(f"*{suffix}"), key=natural_order)
        if parts:
            return parts
    return [path]


def _other_parts(source: Source) -> list[str]:
    """A note on what lies beside the parts of a log and is none."""
    parts = _parts(source)
    if not isinstance(source, Path) or source in parts or (source / "metadata.yaml").is_file():
        return []
    return left_out(source, Path(parts[0].name).suffix, (*_PART_SUFFIXES, *SUFFIXES))


def _indexer(path: Path, rate_hz: float) -> Indexer:
    return _folder_indexer(path, rate_hz) if path.is_dir() else _file_indexer(path)


def _file_indexer(path: Path) -> Indexer:
    head = _head(path) if path.is_file() else b""
    if head.startswith(b"#ROSBAG") or head.startswith(b"SQLite format 3\0"):
        return index_bag
    if head.startswith((b"BZh", b"\x1f\x8b")) or _looks_like_carmen(head):
        return index_carmen
    if head and not head.startswith(MAGIC):
        raise unknown(path, head, f"starts with {head[:8]!r}")
    return index_file


def _folder_indexer(path: Path, rate_hz: float) -> Indexer:
    if (path / "metadata.yaml").is_file():
        return index_bag
    if (path / "velodyne_points").is_dir():
        return index_kitti_raw
    if (path / "velodyne").is_dir() and (path / "times.txt").is_file():
        return index_kitti_odometry
    if any(entry.suffix.lower() in SUFFIXES for entry in path.iterdir()):
        return lambda folder, number: index_clouds(folder, number, rate_hz)
    raise InputError(f"{path}: is a folder of no log that is known; give {KNOWN}")


def _looks_like_carmen(head: bytes) -> bool:
    """Whether the first line is a comment or begins with a word in capitals and digits, as CARMEN's do."""
    word = head.lstrip().split(maxsplit=1)[0] if head.strip() else b""
    return word.startswith(b"#") or (word.isascii() and word.replace(b"_", b"").isalnum() and word.isupper())


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(64)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
