"""The recording of a merged map: the map, every session to toggle, the closures between them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from scanchain.maps import read_ply
from scanchain.runs.directory import RECORDING_FILE
from scanchain_viz.pictures.merge import DrawnMerge, read_merge
from scanchain_viz.recording import entities, shapes
from scanchain_viz.recording.blueprint import scene
from scanchain_viz.recording.messages import Message
from scanchain_viz.recording.sinks import write_recording

_MAP_POINTS = 300_000


def record_merge(directory: Path) -> None:
    """Write recording.rrd into a merge's directory. Raises OSError."""
    drawn = read_merge(directory)
    name = directory.name.partition(".partial-")[0]
    box = np.array([drawn.positions.min(axis=0), drawn.positions.max(axis=0)])
    world = scene("sessions over the map", drawn.dimension, box)
    layout = rrb.Blueprint(world, rrb.TimePanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"))
    messages = _messages(directory, drawn)
    write_recording(directory / RECORDING_FILE, name, drawn.dimension, layout, messages, kind="merge ")


def _messages(directory: Path, drawn: DrawnMerge) -> Iterator[Message]:
    yield entities.UP
    points = shapes.in_space(shapes.at_most(read_ply(directory / "map.ply"), _MAP_POINTS))
    yield Message(entities.MAP, entities.dots(entities.GRAY, 0.75, points))
    closures = entities.lines(entities.GREEN, 0.75, drawn.closures.astype(np.float32))
    yield Message(entities.ACCEPTED, closures)
    for session in drawn.sessions:
        color, name = entities.rgb(session.color), rr.escape_entity_path_part(session.name)
        path = session.positions.astype(np.float32)
        yield Message(f"world/sessions/{name}/trajectory", entities.lines(color, 1.5, [path]))
        yield Message(f"world/sessions/{name}/keyframes", entities.dots(color, 2.5, path))
