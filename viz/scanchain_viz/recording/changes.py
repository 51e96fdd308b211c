"""Two maps that were compared as a recording: points by label, boxes around clusters, arrows of what moved."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from scanchain.runs.directory import RECORDING_FILE
from scanchain.sessions.change_run import COLORS, SUMMARY_FILE
from scanchain.sessions.changes import Changes, Label
from scanchain_viz.recording import entities, shapes
from scanchain_viz.recording.blueprint import scene
from scanchain_viz.recording.messages import Message
from scanchain_viz.recording.sinks import write_recording

_FLAT_M = 0.02  # height of a box in the plane
_RADII = {Label.SAME: 0.75, Label.UNKNOWN: 1.0, Label.APPEARED: 2.0, Label.VANISHED: 2.0}


def record_changes(directory: Path, changes: Changes) -> None:
    """Write recording.rrd into a directory that holds summary.txt. Raises OSError."""
    points = shapes.in_space(changes.points)
    messages = [
        entities.UP,
        Message("summary", rr.TextDocument((directory / SUMMARY_FILE).read_text(encoding="utf-8"))),
    ]
    for label, radius in _RADII.items():
        chosen = entities.dots(COLORS[label], radius, points[changes.labels == label])
        messages.append(Message(f"world/{label.name.lower()}", chosen))
    messages += [_boxes(changes, label) for label in (Label.APPEARED, Label.VANISHED)]
    messages.append(_arrows(changes))
    box = np.array([points.min(axis=0), points.max(axis=0)]) if len(points) else None
    text = rrb.TextDocumentView(origin="summary", name="summary")
    world = scene("changes", changes.dimension, box)
    layout = rrb.Blueprint(rrb.Horizontal(world, text, column_shares=[3, 1]), collapse_panels=True)
    name = directory.name.split(".partial")[0]
    write_recording(directory / RECORDING_FILE, name, changes.dimension, layout, messages)


def _boxes(changes: Changes, label: Label) -> Message:
    kind = label.name.lower()
    chosen = [cluster for cluster in changes.clusters if cluster.kind == kind]
    sizes = np.full((len(chosen), 3), _FLAT_M)
    upright = np.zeros((len(chosen), 4))
    for row, cluster in enumerate(chosen):
        sizes[row, : changes.dimension] = cluster.size_m
        upright[row, 2:] = np.sin(0.5 * cluster.yaw_rad), np.cos(0.5 * cluster.yaw_rad)
    centers = shapes.in_space(np.array([cluster.center for cluster in chosen]).reshape(-1, changes.dimension))
    drawn = rr.Boxes3D(
        centers=centers,
        half_sizes=0.5 * sizes,
        quaternions=upright,
        colors=[COLORS[label]],
        labels=[str(cluster.number) for cluster in chosen],
        show_labels=False,
    )
    return Message(f"world/clusters/{kind}", drawn)


def _arrows(changes: Changes) -> Message:
    """From where something vanished to where it appeared."""
    moved = [each for each in changes.clusters if each.kind == "vanished" and each.counterpart]
    starts = np.array([each.center for each in moved]).reshape(-1, changes.dimension)
    ends = np.array([changes.clusters[each.counterpart - 1].center for each in moved]).reshape(starts.shape)
    arrows = rr.Arrows3D(origins=shapes.in_space(starts), vectors=shapes.in_space(ends - starts))
    return Message("world/clusters/moved", arrows)
