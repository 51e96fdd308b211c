"""The rerun recording of a run, to a file, to a viewer, or to both.

An error here after the start does not end the run; it is collected in ``Recording.warnings``.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from functools import partial
from pathlib import Path
from uuid import uuid4

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.error_utils import catch_and_log_exceptions

from scanchain.config import RecordingConfig
from scanchain.data import Closure, GraphState, Matrix, Step, Trajectory
from scanchain.errors import InputError, ScanchainError
from scanchain.runs.job import SinkName
from scanchain.steps import SENSORS, Steps
from scanchain.verdict import Judged, Kind
from scanchain_viz.colors import color_of, color_of_kind, rgb
from scanchain_viz.recording import drawing, entities, viewer
from scanchain_viz.recording.batching import WARNING, Batcher, events
from scanchain_viz.recording.drawing import Message, Times
from scanchain_viz.recording.sinks import Sink, file_sink, is_readable, open_stream, send_layout, viewer_sink

_LISTED = 50  # largest number of segments in the text of a verdict


@dataclass(eq=False)
class Recording:
    """Recording of steps and results; a context manager, entered before the first and left after the last.

    path : the .rrd file; needed for the sink "save", ignored otherwise
    name : of the recording in the viewer
    sinks : "save" to the file, "spawn" a viewer, "connect" to an open one, serve a "web" viewer on this machine;
        without any, nothing is recorded
    """

    path: Path | None
    _: KW_ONLY
    dimension: int
    name: str
    sinks: frozenset[SinkName]
    config: RecordingConfig

    def __post_init__(self) -> None:
        if "save" in self.sinks and self.path is None:
            raise InputError("no path for the recording: give --out, or leave save out of --rerun")
        self.web_address = ""
        self.opened: list[Sink] = []
        self.file: Sink | None = None
        self.server: subprocess.Popen[bytes] | None = None
        self.batcher = Batcher(self.config)
        self.problems: list[str] = []
        self.has_sensors = False  # other than lidars

    def __enter__(self) -> Recording:
        recording_id = uuid4()
        if "save" in self.sinks and self.path is not None:
            stream = open_stream(self.name, self.dimension, recording_id)
            self.file = file_sink(self.path, stream, entities.blueprint(self.dimension))
            self.opened.append(self.file)
        address = self._viewer_address() if self.sinks & {"spawn", "connect", "web"} else ""
        if address:
            stream = open_stream(self.name, self.dimension, recording_id)
            self.opened.append(viewer_sink(address, stream, entities.blueprint(self.dimension)))
        self._send(lambda: entities.constants(self.dimension))
        return self

    def __exit__(self, *error: object) -> None:
        """Write the last batch, frame the view, and close file and viewer."""
        self._send(lambda: [*self.batcher.messages(), *self.batcher.graph.draw(self.batcher.now)])
        scans = int(self.batcher.now.scans[0])
        layout = entities.blueprint(self.dimension, self.batcher.box, scans, has_sensors=self.has_sensors)
        for sink in self.opened:
            sink.send(partial(send_layout, blueprint=layout, is_active=True))
            sink.close()
        if self.server is not None:
            viewer.stop(self.server)

    @property
    def warnings(self) -> list[str]:
        """Problems so far, one line each."""
        return [*self.problems, *(warning for sink in self.opened for warning in sink.warnings)]

    def resume(self, before: Path | None, steps: Steps, closures: Sequence[Closure], graph: GraphState) -> None:
        """Resume after these steps, with all closures tried by then and the graph as it was.

        before : the recording up to there, which is copied; without one, the recording begins here
        """
        self._guard(lambda: self.batcher.restore(steps, closures, graph))
        if before is not None and not is_readable(before):
            self.problems.append(
                f"{before.name} of the stopped run is damaged: the recording begins where it stopped"
            )
            before = None
        for sink in self.opened:
            if before is not None:
                sink.send(partial(sink.copy, before))
            sink.settle()

    def secure(self) -> int:
        """Size of the file in bytes, after everything so far is written to it; 0 if there is no complete file."""
        self._send(self.batcher.messages)
        if self.path is None or self.file is None or not self.file.settle():
            return 0
        return self.path.stat().st_size

    def log(self, step: Step) -> None:
        """Record one step; most of it is gathered and written in batches."""
        self._send(lambda: self.batcher.add(step))

    def log_trajectory(self, optimized: Trajectory) -> None:
        """Record the optimized trajectory of all scans."""
        times = Times(np.arange(len(optimized), dtype=np.int64), optimized.stamps_ns)
        self._send(lambda: [
            _path(entities.OPTIMIZED, optimized.poses, entities.Color.CYAN),
            Message(entities.OPTIMIZED_LIDAR, drawing.transforms(optimized.poses), times),
        ])  # fmt: skip

    def log_innovations(self, steps: Steps) -> None:
        """Record the normalized innovations of the other sensors."""
        self.has_sensors = bool(steps.innovations)
        self._send(lambda: _innovations(steps))

    def log_closures(self, closures: Sequence[Closure], graph: GraphState) -> None:
        """Record the final graph and the final verdict on every closure, at the last scan."""
        self._send(lambda: self.batcher.settled(closures, graph))

    def log_verdict(self, judged: Judged, trajectory: Trajectory) -> None:
        """Record the verdict, and its segments on the optimized trajectory of all scans of the log."""
        self._send(lambda: _verdict(judged, trajectory))

    def log_ground_truth(self, poses: Matrix) -> None:
        """Record true poses (N, 4, 4), aligned to the optimized trajectory."""
        self._send(lambda: [_path(entities.GROUND_TRUTH, poses, entities.Color.WHITE)])

    def log_map(self, points: NDArray[np.floating]) -> None:
        """Record the finished map (N, d), downsampled to a third of the points of the scans."""
        self._send(lambda: self._map(points))

    def log_grid(self, cells: NDArray[np.int8], *, resolution_m: float, origin_m: tuple[float, float]) -> None:
        """Record the finished occupancy grid of a 2D log.

        cells : (H, W), as in ROS: 0 free to 100 occupied, −1 unknown; row 0 at the lowest y
        origin_m : x, y of the outer corner of cells[0, 0]
        """
        self._send(lambda: [Message(entities.GRID, _grid(cells, resolution_m, origin_m))])

    def hold(self) -> None:
        """Serve the web viewer until it ends or the user interrupts."""
        self._send(self.batcher.messages)
        if self.server is not None:
            with suppress(KeyboardInterrupt):
                self.server.wait()

    def _viewer_address(self) -> str:
        """Address of a viewer; empty, with a warning, if there is none."""
        try:
            if "web" in self.sinks:
                self.server = viewer.start_web()
                self.web_address = viewer.web_address()
            elif "spawn" in self.sinks:
                viewer.start_window()
            elif not viewer.is_listening(viewer.PORT):
                raise ScanchainError(
                    f"no viewer at {viewer.HOST}:{viewer.PORT}, the run goes on without it; open one with: rerun"
                )
        except (ScanchainError, OSError) as error:
            self.problems.append(str(error))
            return ""
        return viewer.grpc_address()

    def _map(self, points: NDArray[np.floating]) -> list[Message]:
        """Message with the map's points, downsampled to as many as are drawn."""
        drawn = drawing.at_most(points, max(self.config.max_map_points, self.batcher.points // 3))
        if not len(drawn):
            return []
        color = entities.height_colors(drawn) if self.dimension == 3 else entities.Color.WHITE
        return [Message(entities.MAP, drawing.dots(drawn, color, 1.0))]

    def _send(self, say: Callable[[], Iterable[Message]]) -> None:
        """Send the messages that ``say`` returns to every sink."""
        messages: list[Message] = []

        def write(stream: rr.RecordingStream) -> None:
            for message in messages:
                message.send(stream)

        if self.opened:
            self._guard(lambda: messages.extend(say()))
        for sink in self.opened if messages else ():
            sink.send(write)

    def _guard(self, act: Callable[[], object]) -> None:
        """Turn an exception into a warning, once per kind: a recording that fails must not fail the run."""
        try:
            with catch_and_log_exceptions(strict=True):  # else rerun turns errors into warnings on stderr
                act()
        except Exception as error:
            problem = f"the recording lacks something: {type(error).__name__}: {error}"
            if problem not in self.problems:
                self.problems.append(problem)


def _path(entity: str, poses: Matrix, color: drawing.Color) -> Message:
    """A line through poses (N, d+1, d+1)."""
    return Message(entity, drawing.lines([drawing.positions(poses)], color, 0.75))


def _innovations(steps: Steps) -> Iterator[Message]:
    """A series for each sensor, in the colors of the report, at the scans where it was compared."""
    times = Times(steps.columns["index"], steps.columns["stamp_ns"])
    for sensor, values in steps.innovations.items():
        entity, known = f"{entities.INNOVATIONS}/{sensor}", np.isfinite(values)
        yield Message(entity, rr.SeriesLines(names=[sensor], colors=[rgb(color_of(SENSORS.index(sensor)))]))
        yield Message(entity, rr.Scalars.columns(scalars=values[known]), times[known])


def _grid(cells: NDArray[np.int8], resolution_m: float, origin_m: tuple[float, float]) -> rr.GridMap:
    height, width = cells.shape
    pixels = np.ascontiguousarray(cells[::-1]).view(np.uint8)  # rerun's first row is the top one
    return rr.GridMap(
        data=pixels.tobytes(),
        format=rr.components.ImageFormat(width=width, height=height, color_model="L", channel_datatype="U8"),
        cell_size=resolution_m,
        translation=[*origin_m, -0.05],
        colormap=rr.components.Colormap.RvizMap,
    )


def _verdict(judged: Judged, trajectory: Trajectory) -> Iterator[Message]:
    """The verdict as text, its segments as lines and as events."""
    listed = "".join(f"- {each.text}\n" for each in judged.segments[:_LISTED])
    more = len(judged.segments) - _LISTED
    listed += f"- and {more:,} more\n" if more > 0 else ""
    text = f"## {judged.verdict}\n\n{judged.valid_error}\n\n{judged.reason}\n\n{listed}"
    yield Message(entities.VERDICT, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
    if not judged.segments:
        return
    path = drawing.positions(trajectory.poses)
    strips = [  # for disagreeing loops, the line between their ends
        path[[each.first, each.last]] if each.kind is Kind.LOOPS else path[max(each.first - 1, 0) : each.last + 1]
        for each in judged.segments
    ]
    lines = rr.LineStrips3D(
        strips,
        colors=[rgb(color_of_kind(each.kind)) for each in judged.segments],
        radii=drawing.pixels(3.5),
        labels=[str(each.kind) for each in judged.segments],
        show_labels=False,
    )
    yield Message(entities.SEGMENTS, lines)
    first = np.array([each.first for each in judged.segments], np.int64)
    texts = [[(WARNING, f"segment to check: {each.text}")] for each in judged.segments]
    yield from events(texts, Times(first, trajectory.stamps_ns[first]))
