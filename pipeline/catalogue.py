"""The catalogue of sequences: what each folder under sequences/ says, and how the log is made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from pipeline.errors import InputError
from pipeline.simulate import simulate

Sha256 = Annotated[str, Meta(pattern="^([0-9a-f]{64}|unknown)$")]
_FILE = "sequence.toml"


class Simulated(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="simulated"):
    """A drive through a simulated world; fields as in ``pipeline.simulate.simulate``."""

    world: str
    sensor: str
    seed: Annotated[int, Meta(ge=0)]
    duration_s: Annotated[float, Meta(gt=0.0)]
    drift: Annotated[float, Meta(ge=0.0)] = 1.0
    noise_m: Annotated[float, Meta(ge=0.0)] | None = None
    dropout: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None


class Download(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="download"):
    """A recording that others publish; ``reference_url`` is what it is judged by, empty if there is nothing."""

    url: str
    sha256: Sha256
    reference_url: str = ""


class Local(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="file"):
    """A file on this machine."""

    path: str
    sha256: Sha256


class Sequence(Struct, frozen=True, forbid_unknown_fields=True):
    """What a sequence is, where it comes from, how it becomes MCAP and what it is judged by."""

    title: str
    description: str
    dimension: Literal[2, 3]
    conversion: str
    ground_truth: str
    licence: str
    source: Simulated | Download | Local


def names() -> tuple[str, ...]:
    """The sequences of the catalogue, in order of name."""
    return tuple(sorted(file.parent.name for file in _folder().glob(f"*/{_FILE}")))


def load(name: str) -> Sequence:
    """What the catalogue says about a sequence."""
    if name not in names():
        raise InputError(f"sequence {name!r} is not in the catalogue; choose one of {', '.join(names())}")
    return read(_folder() / name / _FILE)


def read(file: Path) -> Sequence:
    """What a sequence.toml says."""
    try:
        return msgspec.toml.decode(file.read_bytes(), type=Sequence)
    except (msgspec.DecodeError, UnicodeDecodeError, OSError) as error:
        raise InputError(f"{file}: {error}; compare it with the other sequences") from error


def prepare(
    name: str, folder: Path, *, force: bool = False, progress: Callable[[int, int], None] | None = None
) -> Path:
    """The path of the sequence's log in ``folder``; a simulated one is made unless it is there already."""
    source = load(name).source
    destination = folder / f"{name}.mcap"
    if destination.exists() and not force:
        return destination
    match source:
        case Simulated():
            simulate(
                source.world,
                destination,
                seed=source.seed,
                duration_s=source.duration_s,
                sensor=source.sensor,
                drift=source.drift,
                noise_m=source.noise_m,
                dropout=source.dropout,
                force=True,
                progress=progress,
            )
        case Download():
            raise InputError(
                f"{destination}: {name} is not fetched by itself; download {source.url} and put it there as MCAP"
            )
        case Local():
            raise InputError(f"{destination}: absent; put {source.path} there as MCAP")
    return destination


def _folder() -> Path:
    """sequences/ in the installed package, or beside it in a checkout."""
    here = Path(__file__).resolve().parent
    for folder in (here / "sequences", here.parent / "sequences"):
        if folder.is_dir():
            return folder
    raise InputError(f"{here / 'sequences'}: absent; install scanchain again")
