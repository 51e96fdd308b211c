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
from scanchain.files import ATTEMPTS, BLOCK_BYTES, SILENCE_S
from scanchain.processes import MIB

Progress = Callable[[int, int], None]

_BROKEN = (http.client.HTTPException, ConnectionError, TimeoutError, urllib.error.URLError)


def fetch(url: str, destination: Path, *, sha256: str = "", progress: Progress | None = None) -> None:
    """Download a file unless it exists, resuming an earlier try.

    sha256 : the expected hash, empty if unknown
    progress : called with the MiB received and their total, 0 if unknown
    Raises InputError if the hash differs or the address is not of HTTP; ScanchainError if the download fails,
    the part received being retained for the next try.
    """
    if urlsplit(url).scheme not in ("http", "https"):
        raise InputError(f"{url}: is no address of a web server; give one with http:// or https://")
    received = destination
    if not destination.exists():
        destination.parent.mkdir(parents=True, exist_ok=True)
        received = destination.with_name(f".{destination.name}.part")
        _complete(url, received, progress)
    with received.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest() if sha256 else ""
    if found != sha256:
        received.unlink()
        raise InputError(
            f"{url}: has SHA-256 {found}, not {sha256} as the catalog says; it was deleted, call it again, or "
            "see whether its page announces a new version"
        )
    received.replace(destination)


def _complete(url: str, part: Path, progress: Progress | None) -> None:
    """Download the missing bytes, with a new request after each interruption."""
    reason = ""
    for _ in range(ATTEMPTS):
        try:
            if _more(url, part, progress):
                return
            reason = "the server ended too early, or has a file of another length by now"
        except urllib.error.HTTPError as error:
            if error.code != http.client.REQUESTED_RANGE_NOT_SATISFIABLE:
                raise ScanchainError(f"{url}: {error.code} {error.reason}; see whether its page moved") from error
            part.unlink()
            reason = "the file on the server is not longer than the one begun"
        except _BROKEN as error:
            reason = str(getattr(error, "reason", error)) or type(error).__name__
    have = part.stat().st_size if part.exists() else 0
    raise ScanchainError(f"{url}: {reason}; {have:,} bytes are kept, call it again to resume")


def _more(url: str, part: Path, progress: Progress | None) -> bool:
    """One request from the first missing byte on; True if the file is complete."""
    have = part.stat().st_size if part.exists() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
    with urllib.request.urlopen(request, timeout=SILENCE_S) as response:
        is_rest = response.status == http.client.PARTIAL_CONTENT
        have = have if is_rest else 0
        total = have + int(response.headers.get("Content-Length", -have))
        with part.open("ab" if is_rest else "wb") as file:
            while block := response.read(BLOCK_BYTES):
                file.write(block)
                have += len(block)
                if progress is not None:
                    progress(have // MIB, total // MIB)
    return not total or have == total
