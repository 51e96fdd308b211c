"""The recording of a merged map: the map, every session to toggle, the closures between them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from scanchain.maps import read_ply
from scanchain.runs.directory import RECORDING_FILE
from scanchain.viz.pictures.merge import DrawnMerge, read_merge
from scanchain.viz.recording import entities, shapes
from scanchain.viz.recording.blueprint import scene
from scanchain.viz.recording.messages import Message
from scanchain.viz.recording.sinks import write_recording

_MAP_POINTS = 300_000


def record_merge(directory: Path) -> None:
    """Write recording.rrd into a merge's directory. Raises OSError."""
    drawn = read_merge(directory)
    stream = rr.RecordingStream(f"scanchain merge {drawn.dimension}D")
    stream.set_log_time_enabled(False)
    stream.send_recording_name(directory.name.partition(".partial-")[0])
    box = np.array([drawn.positions.min(axis=0), drawn.positions.max(axis=0)])
    world = scene("sessions over the map", drawn.dimension, box)
    layout = rrb.Blueprint(world, rrb.TimePanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"))
    write_recording(directory / RECORDING_FILE, stream, layout, list(_messages(directory, drawn)))


def _messages(directory: Path, drawn: DrawnMerge) -> Iterator[Message]:
    yield Message(entities.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    points = shapes.in_space(shapes.at_most(read_ply(directory / "map.ply"), _MAP_POINTS))
    yield Message(entities.MAP, rr.Points3D(points, colors=[entities.GRAY], radii=[entities.pixels(0.75)]))
    closures = drawn.closures.astype(np.float32)
    yield Message(
        entities.ACCEPTED, rr.LineStrips3D(closures, colors=[entities.GREEN], radii=[entities.pixels(0.75)])
    )
    for session in drawn.sessions:
        color = [int(session.color[at : at + 2], 16) for at in (1, 3, 5)]
        name = rr.escape_entity_path_part(session.name)
        path = [session.positions.astype(np.float32)]
        line = rr.LineStrips3D(path, colors=[color], radii=[entities.pixels(1.5)])
        yield Message(f"world/sessions/{name}/trajectory", line)
        dots = rr.Points3D(path[0], colors=[color], radii=[entities.pixels(2.5)])
        yield Message(f"world/sessions/{name}/keyframes", dots)
