"""Files: the path or address of a log, JSON, and atomic writing."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit

import msgspec

BLOCK_BYTES = 1 << 20  # read or written at once where the whole may not fit the memory
ATTEMPTS = 4  # number of requests before an error of the network that may be transient is final
SILENCE_S = 30.0  # longest time without data from the network
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Address:
    """A file that is read over the network. As text it is without password and query, which may hold keys."""

    url: str

    def __str__(self) -> str:
        parts = urlsplit(self.url)
        return parts._replace(netloc=parts.netloc.rpartition("@")[2], query="", fragment="").geturl()

    @property
    def name(self) -> str:
        """The last part of its path."""
        return PurePosixPath(unquote(urlsplit(self.url).path)).name

    @property
    def stem(self) -> str:
        """Its name without the last suffix."""
        return PurePosixPath(self.name).stem

    def resolve(self) -> Address:
        """Itself: an address does not depend on the working directory."""
        return self


Source = Path | Address


def without_keys(words: Sequence[str]) -> list[str]:
    """The words of a command line, addresses without password and query."""
    return [str(source_of(word)) if "://" in word else word for word in words]


def source_of(named: Source | str) -> Source:
    """Source that a text names: an address if it begins with ``s3://`` or the like, else a path."""
    if not isinstance(named, str):
        return named
    if not _SCHEME.match(named):
        return Path(named)
    if named.lower().startswith("file://"):
        from urllib.request import url2pathname  # which imports HTTP, too

        return Path(url2pathname(urlsplit(named).path))
    return Address(named)


def json_text(tree: object) -> str:
    """Records, dictionaries and NumPy numbers as indented JSON; non-finite numbers become null."""
    return msgspec.json.format(msgspec.json.encode(tree, enc_hook=lambda number: number.item()), indent=2).decode()


def write_json(path: Path, tree: object) -> None:
    """Write ``json_text`` atomically."""
    write_whole(path, f"{json_text(tree)}\n".encode())


def write_whole(path: Path, data: bytes) -> None:
    """Write a file atomically: the old one stays until the new one is complete on disk.

    Raises OSError of ``path``.
    """
    new = path.with_name(f"{path.name}.new")
    try:
        new.write_bytes(data)
        new.replace(path)
    except BaseException as error:
        new.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise
