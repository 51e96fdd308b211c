"""The catalog of sequences: the files in sequences/, and logs of them, simulated or downloaded."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import asdict

from scanchain.download import Progress, fetch
from scanchain.errors import InputError
from scanchain.logs.convert import convert
from scanchain.settings import shipped
from scanchain.simulation import simulate

Sha256 = Annotated[str, Meta(pattern="^([0-9a-f]{64}|unknown)$")]


class Simulated(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="simulated"):
    """A drive through a simulated world; fields as in ``scanchain.simulation.simulate``."""

    world: str
    sensor: str
    seed: Annotated[int, Meta(ge=0)]
    duration_s: Annotated[float, Meta(gt=0.0)]
    drift: Annotated[float, Meta(ge=0.0)] = 1.0
    noise_m: Annotated[float, Meta(ge=0.0)] | None = None
    dropout: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None


class Download(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="download"):
    """A recording published by others, in a format that ``scanchain convert`` reads.

    ``page`` is where its authors describe it. ``reference_url`` is its reference or calibration, empty
    if there is none. ``converts`` is the folder of an archive that is converted to the log.
    """

    page: str
    url: str
    sha256: Sha256
    reference_url: str = ""
    converts: str = ""


class Page(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="page"):
    """A recording behind an account or without a fixed address, to be downloaded by hand.

    ``steps`` are the instructions for its download and conversion to MCAP.
    """

    page: str
    steps: str


class Sequence(Struct, frozen=True, forbid_unknown_fields=True):
    """A sequence: description, source, conversion to MCAP, ground truth."""

    title: str
    description: str
    dimension: Literal[2, 3]
    conversion: str
    ground_truth: str
    license: str
    source: Simulated | Download | Page


def names() -> tuple[str, ...]:
    """The sequences of the catalog, in order of name."""
    return tuple(sorted(file.stem for file in shipped("sequences").glob("*.toml")))


def load(name: str) -> Sequence:
    """Entry of a sequence."""
    if name not in names():
        raise InputError(f"sequence {name!r} is not in the catalog; choose one of {', '.join(names())}")
    file = shipped("sequences") / f"{name}.toml"
    try:
        return msgspec.toml.decode(file.read_bytes(), type=Sequence)
    except (msgspec.DecodeError, UnicodeDecodeError, OSError) as error:
        raise InputError(f"{file}: {error}; compare it with the other sequences") from error


def prepare(name: str, folder: Path, *, force: bool = False, progress: Progress | None = None) -> Path:
    """The path of the sequence's log in ``folder``; simulated, or downloaded and converted, where it is missing.

    progress : called with the scans made, or the MiB downloaded, and their total
    """
    source = load(name).source
    destination = folder / f"{name}.mcap"
    if destination.exists() and not force:
        return destination
    match source:
        case Simulated():
            simulate(destination=destination, force=True, progress=progress, **asdict(source))
        case Download():
            convert([_download(name, source, folder, progress)], destination, force=True)
        case Page():
            raise InputError(
                f"{destination}: {name} cannot be downloaded automatically; {source.page}: {source.steps}"
            )
    return destination


def _download(name: str, source: Download, folder: Path, progress: Progress | None) -> Path:
    """Download the recording and its reference; returns the file or folder to convert."""
    sha256 = "" if source.sha256 == "unknown" else source.sha256
    recording, reference = (folder / Path(urlsplit(url).path).name for url in (source.url, source.reference_url))
    fetch(source.url, recording, sha256=sha256, progress=progress)
    if source.reference_url:
        fetch(source.reference_url, reference)
    if not source.converts:
        return recording
    unpacked = folder / f"{name}-unpacked"
    for archive in (recording, reference) if source.reference_url else (recording,):
        try:
            with zipfile.ZipFile(archive) as packed:
                packed.extractall(unpacked)  # which keeps all files below that folder, whatever their names
        except (zipfile.BadZipFile, OSError) as error:
            raise InputError(f"{archive}: does not unpack ({error}); delete it and call again") from error
    return unpacked / source.converts
