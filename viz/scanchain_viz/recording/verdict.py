"""The verdict of a run in its recording: text, stretches on the trajectory, and events."""

from __future__ import annotations

import numpy as np
import rerun as rr

from scanchain.data import Trajectory
from scanchain.verdict import Judged, Kind, Stretch
from scanchain_viz.recording import entities, shapes
from scanchain_viz.recording.batching import WARNING, events
from scanchain_viz.recording.messages import Message, Times
from scanchain_viz.stretch_colors import STRETCH_COLORS

_LISTED = 50  # largest number of stretches in the text
_RADIUS = 3.5  # points of the screen


def verdict_messages(judged: Judged, trajectory: Trajectory) -> list[Message]:
    """Text, lines and events; the indices of the trajectory's scans are those of the log."""
    document = rr.TextDocument(_text(judged), media_type=rr.MediaType.MARKDOWN)
    messages = [Message(entities.VERDICT, document)]
    if judged.stretches:
        path = shapes.positions(trajectory.poses)
        lines = rr.LineStrips3D(
            [_line(path, each) for each in judged.stretches],
            colors=[entities.rgb(STRETCH_COLORS[each.kind]) for each in judged.stretches],
            radii=[entities.pixels(_RADIUS)],
            labels=[str(each.kind) for each in judged.stretches],
            show_labels=False,
        )
        messages.append(Message(entities.STRETCHES, lines))
        first = np.array([each.first for each in judged.stretches], np.int64)
        texts = [[(WARNING, f"stretch to check: {each.text}")] for each in judged.stretches]
        messages += events(texts, Times(first, trajectory.stamps_ns[first]))
    return messages


def _text(judged: Judged) -> str:
    listed = "".join(f"- {each.text}\n" for each in judged.unnamed[:_LISTED])
    more = len(judged.unnamed) - _LISTED
    head = f"## {judged.verdict}\n\n{judged.vouched}\n\n{judged.reason}\n\n"
    return head + listed + (f"- and {more:,} more\n" if more > 0 else "")


def _line(path: shapes.Floats, stretch: Stretch) -> shapes.Floats:
    """The part of the path that leads through a stretch; of disagreeing loops the line between their ends."""
    if stretch.kind is Kind.LOOPS:
        return path[[stretch.first, stretch.last]]
    return path[max(stretch.first - 1, 0) : stretch.last + 1]
