"""``scanchain changes``: two maps, or the sessions of one, opened, aligned, compared, written."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Pose
from scanchain.errors import InputError
from scanchain.maps import SavedMap, open_saved_map
from scanchain.runs.directory import RUN_FILE, RunDirectory
from scanchain.runs.provenance import describe_start
from scanchain.sessions.alignment import align_maps
from scanchain.sessions.change_files import write_change_files
from scanchain.sessions.changes import Changes, Part, changes_between
from scanchain.settings import load_settings
from scanchain.words import counted


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two maps to compare.

    Attributes
    ----------
    earlier, later : run directories; without a later one the newest session of the earlier one is compared with
        all before it
    out : the directory to create
    transform : T_earlier_later (d+1, d+1) where it is known; None to find it
    voxel_size_m, min_size_m : as in ``changes_between``
    """

    earlier: Path
    later: Path | None
    out: Path
    transform: Pose | None = None
    voxel_size_m: float | None = None
    min_size_m: float = 0.2
    force: bool = False


def compare_maps(
    comparison: Comparison,
    present: Callable[[Path, Changes], None],
    say: Callable[[str], None] = lambda stage: None,
) -> Changes:
    """The changes, written into the directory of the comparison.

    present : adds report and recording to a directory; say : called with each stage when it begins
    Raises InputError for bad input, and where the maps are not of one place.
    """
    maps = [_opened(run, comparison.out) for run in (comparison.earlier, comparison.later) if run is not None]
    config = load_settings(maps[0].dimension).config
    with RunDirectory(comparison.out, force=comparison.force) as directory:
        earlier, later, alignment = _parts(maps, comparison, config, say)
        say("comparing")
        changes = changes_between(
            earlier, later, config, voxel_size_m=comparison.voxel_size_m, min_size_m=comparison.min_size_m
        )
        say("writing")
        write_change_files(directory.path, changes, alignment)
        present(directory.path, changes)
        provenance = describe_start(sys.argv, [saved.folder for saved in maps], "")
        msgspec.structs.replace(provenance, complete=True).write(directory.path / RUN_FILE)
        directory.complete()
    return changes


def _opened(run: Path, out: Path) -> SavedMap:
    """The map of a run. Raises InputError where it cannot be compared."""
    saved = open_saved_map(run)
    if not saved.keyframes:
        raise InputError(f"{run}: its map has no keyframe; give another one")
    if out.resolve() in (run.resolve(), saved.folder.resolve()):
        raise InputError(f"{out}: is one of the maps; choose another --out")
    return saved


def _parts(
    maps: Sequence[SavedMap], comparison: Comparison, config: Config, say: Callable[[str], None]
) -> tuple[Part, Part, str]:
    """The earlier and the later map in one frame, and how they came into it, in words."""
    if len(maps) == 1:
        return *_sessions(maps[0]), "sessions of one map"
    first, second = maps
    if second.dimension != first.dimension:
        raise InputError(
            f"{comparison.later}: is a {second.dimension}D map, {comparison.earlier} a {first.dimension}D one; "
            "give maps of the same kind"
        )
    names = first.name, second.name
    if names[0] == names[1]:
        names = str(comparison.earlier), str(comparison.later)
    if comparison.transform is None:
        say(f"placing {names[1]} in {names[0]}")
        alignment = align_maps(first, second, config)
        poses, text = alignment.poses, f"by {counted(alignment.loops, 'loop closure')}"
    else:
        T = comparison.transform
        is_same = np.allclose(T, lie.identity(first.dimension))
        poses, text = T @ second.poses, "as given" + (", one frame" if is_same else "")
    return Part(names[0], first.keyframes, first.poses), Part(names[1], second.keyframes, poses), text


def _sessions(merged: SavedMap) -> tuple[Part, Part]:
    """All sessions but the newest, and that one."""
    if len(merged.sessions) < 2:
        raise InputError(f"{merged.folder}: has one session; give a second map to compare with")
    newest = len(merged.sessions) - 1
    parts = []
    for is_chosen, name in (
        (merged.session < newest, ", ".join(session.name for session in merged.sessions[:-1])),
        (merged.session == newest, merged.sessions[-1].name),
    ):
        chosen = np.flatnonzero(is_chosen)
        parts.append(Part(name, [merged.keyframes[k] for k in chosen.tolist()], merged.poses[chosen]))
    return parts[0], parts[1]
