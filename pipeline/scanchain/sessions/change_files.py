"""Files of ``scanchain changes``: labeled cloud, table of clusters, summary and figures."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from scanchain.maps import write_ply
from scanchain.sessions.changes import Changes, Cluster, Label
from scanchain.words import counted

CLOUD_FILE, TABLE_FILE, SUMMARY_FILE, METRICS_FILE = "changes.ply", "changes.csv", "summary.txt", "metrics.json"
COLORS = {
    Label.SAME: (150, 156, 165),
    Label.APPEARED: (26, 161, 121),
    Label.VANISHED: (214, 69, 65),
    Label.UNKNOWN: (96, 125, 175),
}
_LARGEST = 10  # clusters of each kind in the summary
_COMMENT = """scanchain changes, meters, frame of the earlier map
label 0 same, 1 appeared, 2 vanished, 3 unknown; cluster 0 for none"""


def write_change_files(folder: Path, changes: Changes, alignment: str) -> None:
    """Write changes.ply, changes.csv and .parquet, summary.txt and metrics.json.

    alignment : how the later map came into the frame of the earlier one, in words
    """
    colors = np.array([COLORS[label] for label in Label], np.uint8)[changes.labels]
    columns = dict(zip(("red", "green", "blue"), colors.T, strict=True))
    columns |= {"label": changes.labels, "cluster": changes.of_cluster.astype("<i4")}
    write_ply(folder / CLOUD_FILE, changes.points, columns, _COMMENT)
    rows = [_row(cluster, changes) for cluster in changes.clusters]
    with (folder / TABLE_FILE).open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(_columns(changes.dimension)), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    schema = pa.schema(list(_columns(changes.dimension).items()))
    pq.write_table(pa.Table.from_pylist(rows, schema), (folder / TABLE_FILE).with_suffix(".parquet"))
    (folder / SUMMARY_FILE).write_text(summary_of(changes, alignment), encoding="utf-8")
    tree = json.dumps(metrics_of(changes, alignment), indent=2)
    (folder / METRICS_FILE).write_text(tree + "\n", encoding="utf-8")


def metrics_of(changes: Changes, alignment: str) -> dict[str, object]:
    """The figures of metrics.json."""
    counts = np.bincount(changes.labels, minlength=len(Label))
    kinds = [cluster.kind for cluster in changes.clusters]
    moved = sum(cluster.counterpart > 0 for cluster in changes.clusters) // 2
    return {
        "earlier": changes.names[0],
        "later": changes.names[1],
        "dimension": changes.dimension,
        "alignment": alignment,
        "agreement": round(changes.agreement, 4),
        "voxel_size_m": changes.voxel_size_m,
        "reach_m": round(changes.reach_m, 2),
        "points": {label.name.lower(): int(counts[label]) for label in Label},
        "clusters": {"appeared": kinds.count("appeared"), "vanished": kinds.count("vanished"), "moved": moved},
    }


def summary_of(changes: Changes, alignment: str) -> str:
    """The text of summary.txt."""
    counts = np.bincount(changes.labels, minlength=len(Label))
    lines = [
        f"earlier        {changes.names[0]}",
        f"later          {changes.names[1]}",
        f"alignment      {alignment}",
        f"agreement      {100.0 * changes.agreement:.1f} % of what both had in sight is the same",
        f"resolution     voxels of {changes.voxel_size_m:g} m, scans compared up to {changes.reach_m:.0f} m",
        f"points         {counts[Label.SAME]:,} same, {counts[Label.APPEARED]:,} appeared, "
        f"{counts[Label.VANISHED]:,} vanished, {counts[Label.UNKNOWN]:,} unknown",
    ]
    for kind in ("vanished", "appeared"):
        of_kind = [cluster for cluster in changes.clusters if cluster.kind == kind]
        lines.append(f"{kind:<14s} {counted(len(of_kind), 'cluster')}")
        lines += [f"  {described(cluster, changes)}" for cluster in of_kind[:_LARGEST]]
        if len(of_kind) > _LARGEST:
            lines.append(f"  and {len(of_kind) - _LARGEST:,} smaller ones: {TABLE_FILE}")
    return "\n".join(lines) + "\n"


def described(cluster: Cluster, changes: Changes) -> str:
    """A cluster in words: number, place, size, and where it came from or went."""
    place = ", ".join(f"{x:.1f}" for x in cluster.center)
    size = " x ".join(f"{x:.2f}" for x in cluster.size_m)
    text = f"{cluster.number:3d}  at ({place}) m, {size} m, {counted(cluster.points, 'point')}"
    if not cluster.counterpart:
        return text
    other = changes.clusters[cluster.counterpart - 1]
    away_m = float(np.linalg.norm(other.center - cluster.center))
    return f"{text}; moved {'to' if cluster.kind == 'vanished' else 'from'} {other.number}, {away_m:.1f} m away"


def _columns(dimension: int) -> dict[str, pa.DataType]:
    numbers = ["x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad", "volume_m3"]
    if dimension == 2:
        numbers = ["x_m", "y_m", "length_m", "width_m", "yaw_rad", "area_m2"]
    columns: dict[str, pa.DataType] = {"number": pa.int64(), "kind": pa.string()}
    columns |= dict.fromkeys(numbers, pa.float64())
    return columns | {"points": pa.int64(), "counterpart": pa.int64()}


def _row(cluster: Cluster, changes: Changes) -> dict[str, object]:
    numbers = [*cluster.center.tolist(), *cluster.size_m.tolist(), cluster.yaw_rad, cluster.volume]
    values = [cluster.number, cluster.kind, *(round(x, 4) for x in numbers), cluster.points, cluster.counterpart]
    return dict(zip(_columns(changes.dimension), values, strict=True))
