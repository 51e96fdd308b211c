"""Files of a log: their sizes, and remote files, read by byte ranges through fsspec or downloaded whole."""

from __future__ import annotations

import atexit
import os
import re
import shutil
from collections.abc import Callable
from difflib import get_close_matches
from functools import cached_property
from importlib import import_module
from pathlib import Path
from tempfile import mkdtemp
from time import sleep
from typing import Any, TypeVar

from scanchain.download import fetch
from scanchain.errors import InputError, MissingExtraError, spelled
from scanchain.files import ATTEMPTS, SILENCE_S, Address, Source

T = TypeVar("T")
_PAUSE_S = 0.5  # pause after the first failure; twice as long after each further one
_ABSENT, _REFUSED, _PASSING = {404, 410}, {401, 403}, {408, 425, 429}  # HTTP statuses


class RemoteFile:
    """A file at an address.

    size : bytes, 0 if the server does not report it
    version : its ETag or time of last modification, empty if the server reports neither
    """

    def __init__(self, address: Address) -> None:
        """Open it. Raises InputError where it is absent or access is refused; MissingExtraError without fsspec."""
        self.address = address
        self._system, self._path = _system_of(address)
        facts = _patient(lambda: self._system.info(self._path), str(address))
        if facts["type"] != "file":
            raise InputError(f"{address}: is a folder; name the files of a remote log one by one")
        if facts.get("size") == 0:
            raise InputError(f"{address}: is empty (0 bytes); record or copy it again")
        self.size = int(facts.get("size") or 0)
        stated = (facts.get(name) for name in ("ETag", "etag", "Last-Modified", "LastModified", "mtime"))
        self.version = str(next(filter(None, stated), ""))
        self._may_have_ranges = self.size > 0 and facts.get("partial", True)

    @cached_property
    def has_ranges(self) -> bool:
        """True if byte ranges can be requested; tested with the last byte."""

        def ask() -> bool:
            try:
                with self._system.open(self._path, "rb", cache_type="none") as file:
                    file.seek(self.size - 1)
                    return len(file.read(1)) == 1
            except ValueError:  # a web server without range requests would send everything
                return False

        return self._may_have_ranges and _patient(ask, str(self.address))

    def read(self, offset: int, size: int) -> bytes:
        """``size`` bytes from ``offset`` on. Raises InputError if several requests do not return them."""

        def ask() -> bytes:
            data: bytes = self._system.cat_file(self._path, start=offset, end=offset + size)
            if len(data) != size:
                raise ConnectionError(f"{len(data)} bytes received instead of {size}")
            return data

        return _patient(ask, f"{self.address}: byte {offset}") if size else b""


def matching(pattern: Address) -> list[Address]:
    """The addresses that match a pattern with *, in the order of their names."""
    system, path = _system_of(pattern)
    found = _patient(lambda: system.glob(path), str(pattern))
    return [Address(system.unstrip_protocol(each)) for each in sorted(found)]


def _system_of(address: Address) -> tuple[Any, str]:
    """The fsspec file system of an address, and the path in it."""
    try:
        from aiohttp import ClientTimeout
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise MissingExtraError(str(error.name).partition(".")[0], "remote") from None
    silence = ClientTimeout(total=None, sock_connect=10.0, sock_read=SILENCE_S)  # a large file takes long
    is_web = address.url.lower().startswith(("http://", "https://"))
    try:
        return url_to_fs(address.url, **({"client_kwargs": {"timeout": silence}} if is_web else {}))
    except ImportError as error:
        raise InputError(f"{address}: {error}") from None
    except ValueError as error:
        raise InputError(f"{address}: {error}; give a path, s3:// or https://") from None


def _patient(ask: Callable[[], T], what: str) -> T:
    """Result of a request, retried after errors that may be transient."""
    for attempt in range(1, ATTEMPTS + 1):
        try:
            return ask()
        except Exception as error:  # each file system raises errors of its own libraries
            cause = error.__cause__ or error
            status = int(getattr(cause, "status", 0) or 0)  # of HTTP
            text = f"{status} {getattr(cause, 'message', '')}" if status else str(cause)
            is_absent = isinstance(cause, FileNotFoundError)  # its text would be the address with its keys
            reason = "not found" if is_absent else " ".join(text.split()) or type(cause).__name__
            if hopeless := _hopeless(error, status):
                raise InputError(f"{what}: {hopeless} ({reason})") from error
            if attempt == ATTEMPTS:
                raise InputError(f"{what}: cannot be read ({reason}); requested {ATTEMPTS} times") from error
            sleep(_PAUSE_S * 2 ** (attempt - 1))
    raise AssertionError


def _hopeless(error: Exception, status: int) -> str:
    """Remedy for an error that a retry cannot fix; empty for one that may be transient."""
    if status in _ABSENT or (isinstance(error, FileNotFoundError) and error.__cause__ is None):
        return "no such file; check the address"
    if status in _REFUSED or isinstance(error, PermissionError) or type(error).__name__ == "NoCredentialsError":
        return (
            "may not be read; for s3:// set AWS_PROFILE, or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or "
            "FSSPEC_S3_ANON=1 for a public bucket, for https:// give user:password@host or a signed address"
        )
    return "the server refuses it; check the address" if 400 <= status < 500 and status not in _PASSING else ""


def fetch_whole(file: RemoteFile) -> Path:
    """Path of a temporary copy of a remote file. Raises InputError if it cannot be downloaded or stored."""
    folder = Path(mkdtemp(prefix="scanchain-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    copy = folder / (file.address.name or "log")
    try:
        if not file.has_ranges:
            fetch(file.address.url, copy)
            return copy
        with copy.open("wb") as written:  # block by block: a broken connection costs one block only
            for offset in range(0, file.size, 8_000_000):
                written.write(file.read(offset, min(8_000_000, file.size - offset)))
    except OSError as error:
        raise InputError(
            f"{copy}: {file.address} cannot be stored there ({error.strerror}); set TMPDIR"
        ) from error
    return copy


def evalio_name(path: Path) -> str:
    """``NAME/SEQUENCE`` of the path ``evalio:NAME/SEQUENCE``, relative or not; empty for any other path."""
    found = re.search(r"(?:^|/)evalio:(.*)", path.as_posix())
    return found[1] if found else ""


def evalio_sequence(path: Path) -> Any:
    """The sequence of evalio that a path names. Raises InputError if it is unknown or not downloaded."""
    name = evalio_name(path)
    try:
        datasets = import_module("evalio.datasets")
    except ImportError:
        raise MissingExtraError("evalio", "evalio") from None
    folder = datasets.get_data_dir()
    datasets.set_data_dir(folder)  # else evalio prints a note on its default folder
    known = datasets.all_sequences()
    if name not in known:
        near = ", ".join(get_close_matches(name, known)) or ", ".join(sorted(datasets.all_datasets()))
        raise InputError(
            f"evalio:{name}: evalio has no such sequence; evalio ls datasets lists them, as of {near}"
        )
    if not known[name].is_downloaded():
        raise InputError(
            f"evalio:{name}: is not in {folder}; set EVALIO_DATA to where it is, or download it: evalio dl {name}"
        )
    return known[name]


def files_of(path: Path) -> list[Path]:
    """The file itself, or all files in a folder and its subfolders, sorted by path."""
    if evalio_name(path):
        sequence = evalio_sequence(path)
        return [file for part in sequence.files() for file in files_of(sequence.folder / part)]
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]


def misspelled(source: Source) -> str:
    """Error text for a name that is not valid UTF-8 and cannot be printed; empty if it is valid."""
    name = os.path.realpath(source) if isinstance(source, Path) else str(source)
    return "" if spelled(name) == name else f"{spelled(name)}: the name is not UTF-8; rename it"


def size_of(source: Source) -> int:
    """Size in bytes of a file, of all files in a folder, or of a remote file."""
    if not isinstance(source, Path):
        return RemoteFile(source).size
    return sum(file.stat().st_size for file in files_of(source))
