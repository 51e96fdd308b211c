"""Simulated logs and finished runs that several tests share: made once for each version of the code.

    path = made.log("office", tmp_path, seconds=6)
    run = made.run("office", tmp_path, seconds=6, odometry__prior="constant-velocity")

They lie in build/made, in a folder named after the code that makes them, and are copied into the folder of a test,
which may damage them there. Without a folder the path is that of the original, to be read only.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import scanchain
from tests.support.scenes import ROOT

_FOLDER = ROOT / "build" / "made"
_FILES = (".tum", ".changes.csv", ".mcap")  # of a simulated log, itself the last
_OF_SIMULATE = (
    "seed", "seconds", "sensor", "changed", "reverse", "start_m", "drift", "noise_m", "dropout", "gnss",
)  # fmt: skip


def log(world: str, into: Path | None = None, *, folder: Path = _FOLDER, **options: object) -> Path:
    """A simulated log with its .tum beside it; ``seconds`` and others are options of ``simulate``."""
    if "seconds" in options:
        options["duration_s"] = float(str(options.pop("seconds")))
    name = "_".join([world, *(f"{key}-{value}" for key, value in sorted(options.items()))])
    path = recorded(name, lambda draft: scanchain.simulate(world, draft, force=True, **options), folder)
    return path if into is None else _copied(path, into / f"{world}.mcap")


def recorded(name: str, write: Callable[[Path], object], folder: Path = _FOLDER) -> Path:
    """A log that a function of the simulator writes."""
    path = _current(folder, "simulation", "kernels/raycast.py", "logs/writer.py") / f"{name}.mcap"
    if not path.exists():
        draft = path.with_name(f"{os.getpid()}_{path.name}")  # another process may be making the same
        write(draft)
        for suffix in _FILES:
            if draft.with_suffix(suffix).exists():
                draft.with_suffix(suffix).replace(path.with_suffix(suffix))
    return path


def run(world: str, into: Path | None = None, *, folder: Path = _FOLDER, **options: object) -> Path:
    """The run directory of a simulated log, without a recording; options of ``log`` and of ``scanchain.run``."""
    source = log(world, folder=folder, **{key: options.pop(key) for key in _OF_SIMULATE if key in options})
    name = "_".join([source.stem, *(f"{key}-{value}" for key, value in sorted(options.items()))])
    path = run_of(source, folder, name, **options)
    return path if into is None else _copied(path, into / world)


def run_of(log: Path, folder: Path, name: str, **options: object) -> Path:
    """The run of any log, without a recording."""
    path = _current(folder) / name
    if not path.exists():
        draft = path.with_name(f"{os.getpid()}_{name}")
        scanchain.run(log, draft, recording=False, **options)
        try:
            draft.rename(path)
        except OSError:  # another process was faster
            shutil.rmtree(draft)
    return path


def _copied(source: Path, target: Path) -> Path:
    if source.is_dir():
        shutil.copytree(source, target)
    else:
        for suffix in _FILES:
            if source.with_suffix(suffix).exists():
                shutil.copyfile(source.with_suffix(suffix), target.with_suffix(suffix))
    return target


def _current(folder: Path, *parts: str) -> Path:
    """The folder of this version of some parts of the code; in the folder of the tests older ones are removed."""
    path = folder / f"{'logs' if parts else 'runs'}_{version(*parts)}"
    if folder == _FOLDER and not path.exists():
        for old in folder.glob(f"{path.name.partition('_')[0]}_*"):
            shutil.rmtree(old, ignore_errors=True)
    path.mkdir(parents=True, exist_ok=True)
    return path


@cache
def version(*parts: str) -> str:
    """A name for some files and folders of the code as they are now, or for all of it."""
    root = Path(scanchain.__file__).parent
    places = [root / part for part in parts or ("",)]
    files = sorted(file for each in places for file in (each.rglob("*.py") if each.suffix == "" else [each]))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:8]
