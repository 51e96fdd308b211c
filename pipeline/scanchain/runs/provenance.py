"""run.json: what was run, on what, with which versions."""

from __future__ import annotations

import hashlib
import os
import platform
import threading
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from msgspec import Struct

from scanchain.errors import InputError
from scanchain.files import Source, without_keys
from scanchain.georeference import Origin
from scanchain.logs.files import RemoteFile, files_of, size_of

_PACKAGES = ("scanchain", "numpy", "numba", "scipy", "pyarrow", "mcap", "msgspec", "rerun-sdk")


class LogFile(Struct, frozen=True):
    """A file or folder that was read; ``sha256`` is empty until it is computed.

    The hash of a folder covers the names and contents of its files, sorted by name. A remote file, which is not
    necessarily read as a whole, has its ETag or modification time as ``version`` instead.
    """

    path: str
    size_bytes: int
    sha256: str
    version: str = ""


class Provenance(Struct, frozen=True):
    """Origin of a run directory. ``complete`` is False while it is written and if it is marked partial.

    ``origin`` is that of the world frame on Earth, null where it is unknown.
    """

    complete: bool
    stopped: str
    command: list[str]
    started: str
    duration_s: float
    logs: list[LogFile]
    configuration: str
    python: str
    platform: str
    cores: int
    versions: dict[str, str]
    origin: Origin | None = None


def describe_start(command: Sequence[str]) -> Provenance:
    """Provenance as known when a run starts, without logs and configuration."""
    return Provenance(
        complete=False,
        stopped="",
        command=without_keys(command),
        started=datetime.now(UTC).isoformat(timespec="seconds"),
        duration_s=0.0,
        logs=[],
        configuration="",
        python=platform.python_version(),
        platform=platform.platform(),
        cores=os.cpu_count() or 0,
        versions={name: package_version(name) for name in _PACKAGES},
    )


def log_file(source: Source) -> LogFile:
    """A file or folder that is read, without its hash."""
    if isinstance(source, Path):
        return LogFile(str(source.resolve()), size_of(source), "")
    file = RemoteFile(source)
    return LogFile(str(source), file.size, "", file.version)


class Hashing:
    """SHA-256 of files, computed in a daemon thread in parallel to the run."""

    def __init__(self, sources: Sequence[Source]) -> None:
        self._sources, self._digests = tuple(sources), list[str]()
        self._thread = threading.Thread(target=self._work, name="log hash", daemon=True)
        self._thread.start()

    def digests(self) -> list[str]:
        """The hashes, in the order of the sources; empty for remote files. Waits until they are computed."""
        self._thread.join()
        return self._digests

    def _work(self) -> None:
        for source in self._sources:
            self._digests.append(_sha256_of(source) if isinstance(source, Path) else "")


def _sha256_of(path: Path) -> str:
    """SHA-256 of a file, or of a folder as described in ``LogFile``; empty where it cannot be read."""
    digest = hashlib.sha256()
    try:
        for file in files_of(path):
            if path.is_dir():
                digest.update(os.fsencode(file.relative_to(path).as_posix()) + b"\0")
            with file.open("rb") as stream:
                hashlib.file_digest(stream, lambda: digest)
    except (OSError, InputError):
        return ""
    return digest.hexdigest()


def identity_of(source: Source) -> str:
    """Hash of path, sizes and modification times, or version of a remote file; empty where unreadable."""
    try:
        if isinstance(source, Path):
            files = [(file, file.stat()) for file in files_of(source.resolve())]
            parts = [str(source.resolve()), *(f"{file} {each.st_size} {each.st_mtime_ns}" for file, each in files)]
        else:
            remote = RemoteFile(source)
            parts = [str(source) if remote.version else source.url, str(remote.size), remote.version]
    except (OSError, InputError):
        return ""
    return hashlib.sha256(os.fsencode("\0".join(parts))).hexdigest()


def package_version(package: str) -> str:
    """The installed version of a distribution, empty where there is none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
