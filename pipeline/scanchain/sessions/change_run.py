"""``scanchain changes``: aligns and compares two maps, or the sessions of one, and writes the changes to files."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from scanchain import checks, lie
from scanchain.config import Config
from scanchain.data import Pose
from scanchain.errors import InputError, counted
from scanchain.maps import SavedMap, write_ply
from scanchain.runs.directory import RunDirectory, write_figures
from scanchain.sessions.alignment import align_maps, opened_maps
from scanchain.sessions.changes import Changes, Cluster, Label, Part, changes_between
from scanchain.settings import load_settings

TABLE_FILE = "changes.csv"
COLORS = {
    Label.SAME: (150, 156, 165),
    Label.APPEARED: (26, 161, 121),
    Label.VANISHED: (214, 69, 65),
    Label.UNKNOWN: (96, 125, 175),
}
_LARGEST = 7  # clusters of each kind in the summary
_COMMENT = """scanchain changes, meters, frame of the earlier map
label 0 same, 1 appeared, 2 vanished, 3 unknown; cluster 0 for none"""


def compare_maps(
    runs: Sequence[Path],
    out: Path,
    present: Callable[[Path, Changes], None],
    say: Callable[[str], None] = lambda stage: None,
    *,
    T_earlier_later: Pose | None = None,
    voxel_size_m: float | None = None,
    min_size_m: float = 0.2,
    force: bool = False,
    command: Sequence[str] = (),
) -> Changes:
    """The changes, written into the directory ``out``.

    runs : directories of the earlier and the later map, or of one, whose newest session is compared with the rest
    present : adds report and recording to a directory; say : called with each stage when it begins
    T_earlier_later : (d+1, d+1) where it is known; None to find it
    voxel_size_m, min_size_m : as in ``changes_between``; command : the command line, for run.json
    Raises InputError for bad input, and where the maps are not of one place.
    """
    maps = opened_maps(runs, out)
    config = load_settings(maps[0].dimension).config
    sources = [saved.folder for saved in maps]
    with RunDirectory(out, force=force, sources=sources, command=command) as directory:
        directory.begin()
        if len(maps) == 1:
            earlier, later, alignment = *_sessions(maps[0]), "sessions of one map"
        else:
            earlier, later, alignment = _in_one_frame(runs, maps, T_earlier_later, config, say)
        say("comparing")
        changes = changes_between(earlier, later, config, voxel_size_m=voxel_size_m, min_size_m=min_size_m)
        say("writing")
        _write(directory.path, changes, alignment)
        present(directory.path, changes)
        directory.end()
        directory.complete()
    return changes


def _sessions(merged: SavedMap) -> tuple[Part, Part]:
    """The older sessions together, and the newest session."""
    if len(merged.sessions) < 2:
        raise InputError(f"{merged.folder}: has one session; give a second map to compare with")
    *before, newest = (session.name for session in merged.sessions)

    def part(name: str, chosen: Sequence[int]) -> Part:
        return Part(name, [merged.keyframes[k] for k in chosen], merged.poses[chosen])

    is_old = merged.session < len(before)
    return part(", ".join(before), np.flatnonzero(is_old).tolist()), part(newest, np.flatnonzero(~is_old).tolist())


def _in_one_frame(
    runs: Sequence[Path], maps: Sequence[SavedMap], T: Pose | None, config: Config, say: Callable[[str], None]
) -> tuple[Part, Part, str]:
    """Both maps in the frame of the first, and a description of how the second was aligned to it."""
    first, second = maps
    names = (first.name, second.name) if first.name != second.name else (str(runs[0]), str(runs[1]))
    if T is None:
        say(f"placing {names[1]} in {names[0]}")
        alignment = align_maps(first, second, config)
        poses, text = alignment.poses, f"by {counted(alignment.loops, 'loop closure')}"
    else:
        T = checks.pose(T, "T_earlier_later", first.dimension)
        is_same = np.allclose(T, lie.identity(first.dimension))
        poses, text = T @ second.poses, "as given" + (", one frame" if is_same else "")
    return Part(names[0], first.keyframes, first.poses), Part(names[1], second.keyframes, poses), text


def _write(folder: Path, changes: Changes, alignment: str) -> None:
    """Write changes.ply, changes.csv and .parquet, summary.txt and metrics.json.

    alignment : description of how the later map was aligned to the earlier one
    """
    colors = np.array([COLORS[label] for label in Label], np.uint8)[changes.labels]
    columns = dict(zip(("red", "green", "blue"), colors.T, strict=True))
    columns |= {"label": changes.labels, "cluster": changes.of_cluster.astype("<i4")}
    write_ply(folder / "changes.ply", changes.points, columns, _COMMENT)
    schema = _schema(changes.dimension)
    rows = [_row(cluster, schema.names) for cluster in changes.clusters]
    with (folder / TABLE_FILE).open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, schema.names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    pq.write_table(pa.Table.from_pylist(rows, schema), (folder / TABLE_FILE).with_suffix(".parquet"))
    counts = dict(zip(Label, np.bincount(changes.labels, minlength=len(Label)).tolist(), strict=True))
    kinds = [cluster.kind for cluster in changes.clusters]
    moved = sum(cluster.counterpart > 0 for cluster in changes.clusters) // 2
    metrics = {
        "earlier": changes.names[0],
        "later": changes.names[1],
        "dimension": changes.dimension,
        "alignment": alignment,
        "agreement": round(changes.agreement, 4),
        "voxel_size_m": changes.voxel_size_m,
        "reach_m": round(changes.reach_m, 2),
        "points": {label.name.lower(): count for label, count in counts.items()},
        "clusters": {"appeared": kinds.count("appeared"), "vanished": kinds.count("vanished"), "moved": moved},
    }
    write_figures(folder, metrics, _summary(changes, alignment, counts))


def _schema(dimension: int) -> pa.Schema:
    numbers = ["x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad", "volume_m3"]
    if dimension == 2:
        numbers = ["x_m", "y_m", "length_m", "width_m", "yaw_rad", "area_m2"]
    return pa.schema([
        ("number", pa.int64()), ("kind", pa.string()), *((name, pa.float64()) for name in numbers),
        ("points", pa.int64()), ("counterpart", pa.int64()),
    ])  # fmt: skip


def _row(cluster: Cluster, names: Sequence[str]) -> dict[str, object]:
    numbers = [*cluster.center.tolist(), *cluster.size_m.tolist(), cluster.yaw_rad, cluster.volume]
    values = [cluster.number, cluster.kind, *(round(x, 4) for x in numbers), cluster.points, cluster.counterpart]
    return dict(zip(names, values, strict=True))


def _summary(changes: Changes, alignment: str, counts: dict[Label, int]) -> str:
    """The text of summary.txt."""
    lines = [
        f"earlier        {changes.names[0]}",
        f"later          {changes.names[1]}",
        f"alignment      {alignment}",
        f"agreement      {100.0 * changes.agreement:.1f} % of what both observed is the same",
        f"resolution     voxels of {changes.voxel_size_m:g} m, scans compared up to {changes.reach_m:.0f} m",
        "points         " + ", ".join(f"{count:,} {label.name.lower()}" for label, count in counts.items()),
    ]
    for kind in ("vanished", "appeared"):
        of_kind = [cluster for cluster in changes.clusters if cluster.kind == kind]
        lines.append(f"{kind:<14s} {counted(len(of_kind), 'cluster')}")
        lines += [f"  {_described(cluster, changes)}" for cluster in of_kind[:_LARGEST]]
        if len(of_kind) > _LARGEST:
            lines.append(f"  and {len(of_kind) - _LARGEST:,} smaller ones: {TABLE_FILE}")
    return "\n".join(lines) + "\n"


def _described(cluster: Cluster, changes: Changes) -> str:
    """Description of a cluster: number, position, size, and where it moved to or from."""
    place = ", ".join(f"{x:.1f}" for x in cluster.center)
    size = " x ".join(f"{x:.2f}" for x in cluster.size_m)
    text = f"{cluster.number:3d}  at ({place}) m, {size} m, {counted(cluster.points, 'point')}"
    if not cluster.counterpart:
        return text
    other = changes.clusters[cluster.counterpart - 1]
    away_m = float(np.linalg.norm(other.center - cluster.center))
    return f"{text}; moved {'to' if cluster.kind == 'vanished' else 'from'} {other.number}, {away_m:.1f} m away"
