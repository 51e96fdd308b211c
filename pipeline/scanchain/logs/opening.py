"""The table of log formats, and the index of a path or address."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from scanchain import plugins
from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.files import Source
from scanchain.logs.files import RemoteFile, fetch_whole, misspelled
from scanchain.logs.formats import (
    Format,
    UnknownFormatError,
    carmen,
    clouds,
    evalio,
    kitti,
    left_out,
    mcap,
    natural_order,
    ros1_bag,
    ros2_bag,
)
from scanchain.logs.formats.user import index_scans
from scanchain.logs.index import FileIndex
from scanchain.logs.stream import are_parts, complete

_FORMATS = mcap.FORMAT, ros1_bag.FORMAT, ros2_bag.FORMAT, carmen.FORMAT, kitti.RAW, kitti.ODOMETRY, clouds.FORMAT
_FORMATS += (evalio.FORMAT,)
FORMATS = {each.name: each for each in _FORMATS}  # in the order in which paths are tested
_KNOWN = ", ".join(each.description for each in _FORMATS)
_KNOWN += ", or name a class of your own that reads it, --log.format module:Class"
AUTO = "auto"  # value of log.format: the format is recognized from the path

_RUN_FILE = "run.json"
_POSE_GRAPH = re.compile(rb"^\s*(VERTEX|EDGE)(2|3|_\w+)?(:QUAT)?\s", re.MULTILINE)  # of g2o or TORO
DEFAULTS = LogConfig()


def index_files(sources: Sequence[Source], config: LogConfig = DEFAULTS) -> list[FileIndex]:
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
    with_scans = [suffix for each in _FORMATS if each.files_are != "logs" for suffix in each.suffixes]
    for source in sources if name == AUTO else []:
        parts = _parts(source)
        if isinstance(source, Path) and source not in parts:
            indexes[0].notes += left_out(source, Path(parts[0].name).suffix, with_scans)
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
        return any(path.suffix.lower() in each.suffixes and each.files_are != "scans" for each in _FORMATS)
    return path.is_dir() and (_is_claimed(path) or _parts(path) != [path])


def _is_claimed(folder: Path) -> bool:
    return (folder / _RUN_FILE).is_file() or _recognized(folder, b"") is not None


def _index(source: Source, number: int, config: LogConfig) -> FileIndex:
    """Index of a file; a remote one that cannot be read in parts by its own index is downloaded first."""
    if isinstance(source, Path):
        return _index_path(source, number, config)
    file = RemoteFile(source)
    if file.has_ranges and config.format in (AUTO, "mcap"):
        index = mcap.index_by_summary(file, number)
        if index is not None:
            return index
    copy = fetch_whole(file)
    try:
        index = _index_path(copy, number, config)
    except InputError as error:
        raise InputError(error.text.replace(str(copy), str(source))) from error
    why = "has no complete index" if file.has_ranges else "is on a server without byte ranges"
    index.notes.insert(0, f"{copy}: {why}, so all of its {copy.stat().st_size / 1e6:.1f} MB were downloaded")
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
                head = file.read(64)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    try:
        form = _format_of(path, head) if config.format == AUTO else FORMATS[config.format]
        return form.index(path, number, config)
    except UnknownFormatError as error:
        text, lack = error.args
        if _POSE_GRAPH.search(text):
            raise InputError(f"{path}: is a pose graph, not a log; use scanchain optimize") from None
        raise InputError(f"{path}: is not a recognized log ({lack}); give {_KNOWN}") from None


def _recognized(path: Path, head: bytes) -> Format | None:
    return next((each for each in _FORMATS if each.recognizes(path, head)), None)


def _format_of(path: Path, head: bytes) -> Format:
    """Recognized format of a path; an empty or absent file counts as MCAP, which is refused as such.

    Raises UnknownFormatError for a file of no known format, InputError for a folder.
    """
    if (path / _RUN_FILE).is_file():
        raise InputError(f"{path}: is a run directory, not a log; give the log named in its {_RUN_FILE}")
    if not head and not path.is_dir():
        return evalio.FORMAT if evalio.FORMAT.recognizes(path, head) else mcap.FORMAT
    if found := _recognized(path, head):
        return found
    if path.is_dir():
        raise InputError(f"{path}: is a folder without a recognized log; give {_KNOWN}")
    raise UnknownFormatError(head, f"starts with {head[:8]!r}")


def _parts(source: Source) -> Sequence[Source]:
    """Files of a folder that contains the parts of a log, in order; else the source itself."""
    if not isinstance(source, Path) or not source.is_dir():
        return [source]
    split = [each for each in _FORMATS if each.files_are == "parts"]
    named = (each.parts_of(source) for each in split)
    found = (sorted(source.glob(f"*{suffix}"), key=natural_order) for each in split for suffix in each.suffixes)
    return next(filter(None, chain(named, found)), [source])
