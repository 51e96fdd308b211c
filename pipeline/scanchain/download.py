"""Download of a file by HTTP: resumed where it was interrupted; the file is complete and verified, or absent."""

from __future__ import annotations

import hashlib
import http.client
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

from scanchain.errors import InputError, ScanchainError

Progress = Callable[[int, int], None]

_BLOCK_BYTES = 1 << 18
_MIB = 1 << 20
_TIMEOUT_S = 30.0
_ATTEMPTS = 4
_BROKEN = (http.client.HTTPException, ConnectionError, TimeoutError, urllib.error.URLError)


class DownloadError(ScanchainError):
    """A file that could not be downloaded; the part received is retained for the next try."""


def fetch(url: str, destination: Path, *, sha256: str = "", progress: Progress | None = None) -> str:
    """Download a file unless it exists, resuming an earlier try; returns its SHA-256.

    sha256 : the expected one, empty where unknown. Raises InputError where it is not, and for what is no
        HTTP address; DownloadError where the server does not respond as it should.
    progress : called with the MiB received and their total, 0 where unknown
    """
    if urlsplit(url).scheme not in ("http", "https"):
        raise InputError(f"{url}: is no address of a web server; give one with http:// or https://")
    if not destination.exists():
        destination.parent.mkdir(parents=True, exist_ok=True)
        part = destination.with_name(f".{destination.name}.part")
        version = part.with_name(f"{part.name}.etag")  # the ETag, or the time of the last change, of what is begun
        _complete(url, part, version, progress)
        _verify(part, sha256, url)
        part.replace(destination)
        version.unlink(missing_ok=True)
    return _verify(destination, sha256, url)


def _complete(url: str, part: Path, version: Path, progress: Progress | None) -> None:
    """Download the missing bytes, with a new request after each interruption."""
    reason = ""
    for _ in range(_ATTEMPTS):
        try:
            if _more(url, part, version, progress):
                return
            reason = "the server ended too early"
        except urllib.error.HTTPError as error:
            if error.code != http.client.REQUESTED_RANGE_NOT_SATISFIABLE:
                raise DownloadError(f"{url}: {error.code} {error.reason}; see whether its page moved") from error
            part.unlink()
            reason = "the file on the server is not longer than the one begun"
        except _BROKEN as error:
            reason = str(getattr(error, "reason", error)) or type(error).__name__
    have = part.stat().st_size if part.exists() else 0
    raise DownloadError(f"{url}: {reason}; {have:,} bytes are kept, call it again to resume")


def _more(url: str, part: Path, version: Path, progress: Progress | None) -> bool:
    """One request from the first missing byte on; True if the file is complete."""
    validator = version.read_text() if part.exists() and version.exists() else ""
    have = part.stat().st_size if validator else 0
    headers = {"Range": f"bytes={have}-", "If-Range": validator} if have else {}
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT_S) as response:
        is_rest = response.status == http.client.PARTIAL_CONTENT
        have = have if is_rest else 0
        total = have + int(response.headers.get("Content-Length", -have))
        version.write_text(response.headers.get("ETag") or response.headers.get("Last-Modified") or "")
        with part.open("ab" if is_rest else "wb") as file:
            while block := response.read(_BLOCK_BYTES):
                file.write(block)
                have += len(block)
                if progress is not None:
                    progress(have // _MIB, total // _MIB)
    return not total or have == total


def _verify(path: Path, sha256: str, url: str) -> str:
    """The SHA-256 of a file; one with another than expected is deleted."""
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if sha256 and found != sha256:
        path.unlink()
        raise InputError(
            f"{url}: has SHA-256 {found}, not {sha256} as the catalog says; it was deleted, call it again, or "
            "see whether its page announces a new version"
        )
    return found
