"""The rerun recording of a run, to a file, to a viewer, or to both.

Nothing that goes wrong here after the start ends a run; it is collected in ``Recording.warnings``.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import Concatenate, ParamSpec
from uuid import uuid4

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.error_utils import catch_and_log_exceptions

from scanchain.config import RecordingConfig
from scanchain.data import Closure, GraphState, Matrix, Step, Trajectory
from scanchain.errors import InputError
from scanchain.runs.job import SinkName
from scanchain.runs.step_table import StepTable
from scanchain.verdict import Judged, Kind
from scanchain_viz.colors import STRETCH_COLORS, rgb
from scanchain_viz.recording import drawing, entities, viewer
from scanchain_viz.recording.batching import WARNING, Batcher, events
from scanchain_viz.recording.drawing import Message, Times
from scanchain_viz.recording.entities import blueprint
from scanchain_viz.recording.sinks import Sink, file_sink, open_stream, viewer_sink

_LISTED = 50  # largest number of stretches in the text of a verdict
_RADIUS = 3.5  # of a stretch, in points of the screen
Given = ParamSpec("Given")


def _recorded(
    draw: Callable[Concatenate[Recording, Given], Iterable[Message]],
) -> Callable[Concatenate[Recording, Given], None]:
    """A method that sends the messages which it makes to every sink."""

    @wraps(draw)
    def send(recording: Recording, *values: Given.args, **named: Given.kwargs) -> None:
        recording._send(lambda: draw(recording, *values, **named))

    return send


class Recording:
    """Takes in steps and results; a context that is entered before the first and left after the last.

    path : the .rrd file; needed for the sink "save", ignored otherwise
    name : what the viewer calls the recording
    sinks : "save" to the file, "spawn" a viewer, "connect" to an open one, serve a "web" viewer on this machine;
        none at all is a recording that goes nowhere
    """

    def __init__(
        self,
        path: Path | None,
        *,
        dimension: int,
        name: str,
        sinks: frozenset[SinkName],
        config: RecordingConfig,
        port: int = viewer.PORT,
        web_port: int = viewer.WEB_PORT,
    ) -> None:
        if "save" in sinks and path is None:
            raise InputError("no path for the recording: give --out, or leave save out of --rerun")
        self.path = path
        self.dimension = dimension
        self.name = name
        self.wanted = sinks
        self.config = config
        self.port = port
        self.web_port = web_port
        self.web_address = ""
        self.sinks: list[Sink] = []
        self.file: Sink | None = None
        self.server: subprocess.Popen[bytes] | None = None
        self.batcher = Batcher()
        self.last = (0, 0)  # scan and stamp of the last step
        self.problems: list[str] = []

    def __enter__(self) -> Recording:
        recording_id = uuid4()
        if "save" in self.wanted and self.path is not None:
            stream = open_stream(self.name, self.dimension, recording_id)
            self.file = file_sink(self.path, stream, blueprint(self.dimension))
            self.sinks.append(self.file)
        address = self._viewer_address() if self.wanted & {"spawn", "connect", "web"} else ""
        if address:
            stream = open_stream(self.name, self.dimension, recording_id)
            self.sinks.append(viewer_sink(address, stream, blueprint(self.dimension)))
        self._send(lambda: entities.constants(self.dimension))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def warnings(self) -> list[str]:
        """Problems so far, a line each."""
        return [*self.problems, *(warning for sink in self.sinks for warning in sink.warnings)]

    def resume(
        self, before: Path | None, steps: StepTable, closures: Sequence[Closure], graph: GraphState
    ) -> None:
        """Resume after these steps, with all closures tried by then and the graph as it was.

        before : the recording up to there, which is copied; without one, the recording begins here
        """
        self.last = int(steps.columns["index"][-1]), int(steps.columns["stamp_ns"][-1])
        self._guard(lambda: self.batcher.restore(steps, closures, graph))
        if before is not None:
            for sink in self.sinks:
                sink.send(before)
        for sink in self.sinks:
            sink.settle()

    def secure(self) -> int:
        """Size of the file in bytes, once it holds all that was recorded; 0 where there is no whole one."""
        self._send(self.batcher.messages)
        if self.path is None or self.file is None or not self.file.settle():
            return 0
        return self.path.stat().st_size

    def log(self, step: Step) -> None:
        """Record one step; most of it is gathered and written in batches."""
        if not self.sinks:
            return
        self.last = step.scan.index, step.scan.stamp_ns
        try:
            self.batcher.add(step)
        except Exception as error:
            self._note(error)
        has_news = self.batcher.graph.has_grown or self._draws_map_of(step)
        if has_news or self.batcher.is_due:
            self._send(lambda: self._step(step))

    @_recorded
    def log_trajectory(
        self, stamps_ns: NDArray[np.int64], poses_optimized: Matrix, indices: NDArray[np.int64]
    ) -> Iterable[Message]:
        """Record the optimized trajectory: poses (N, d+1, d+1) of the scans ``indices``."""
        path = drawing.lines([drawing.positions(poses_optimized)], entities.CYAN, 0.75)
        yield Message(entities.OPTIMIZED, path)
        times = Times(indices, stamps_ns)
        yield Message(entities.OPTIMIZED_LIDAR, drawing.transforms(poses_optimized), times)

    @_recorded
    def log_closures(self, closures: Sequence[Closure], graph: GraphState) -> Iterable[Message]:
        """Record the final graph and the final verdict on every closure, at the last scan."""
        return self.batcher.settled(closures, graph, self.now)

    @_recorded
    def log_verdict(self, judged: Judged, trajectory: Trajectory) -> Iterable[Message]:
        """Record the verdict, and its stretches on the optimized trajectory of all scans of the log."""
        document = rr.TextDocument(_document(judged), media_type=rr.MediaType.MARKDOWN)
        yield Message(entities.VERDICT, document)
        if judged.stretches:
            path = drawing.positions(trajectory.poses)
            strips = [  # of disagreeing loops the line between their ends
                path[[each.first, each.last]]
                if each.kind is Kind.LOOPS
                else path[max(each.first - 1, 0) : each.last + 1]
                for each in judged.stretches
            ]
            lines = rr.LineStrips3D(
                strips,
                colors=[rgb(STRETCH_COLORS[each.kind]) for each in judged.stretches],
                radii=drawing.pixels(_RADIUS),
                labels=[str(each.kind) for each in judged.stretches],
                show_labels=False,
            )
            yield Message(entities.STRETCHES, lines)
            first = np.array([each.first for each in judged.stretches], np.int64)
            texts = [[(WARNING, f"stretch to check: {each.text}")] for each in judged.stretches]
            yield from events(texts, Times(first, trajectory.stamps_ns[first]))

    @_recorded
    def log_ground_truth(self, poses: Matrix) -> Iterable[Message]:
        """Record true poses (N, 4, 4), aligned to the optimized trajectory."""
        line = drawing.lines([drawing.positions(poses)], entities.WHITE, 0.75)
        yield Message(entities.GROUND_TRUTH, line)

    @_recorded
    def log_map(self, points: NDArray[np.floating]) -> Iterable[Message]:
        """Record the finished map (N, d), downsampled to a third of the points of the scans."""
        limit = max(self.config.max_map_points, self.batcher.points // 3)
        drawn = drawing.at_most(points, limit)
        if len(drawn):
            color = entities.height_colors(drawn) if self.dimension == 3 else entities.WHITE
            yield Message(entities.MAP, drawing.dots(drawn, color, 1.0))

    @_recorded
    def log_grid(
        self, cells: NDArray[np.int8] | NDArray[np.uint8], *, resolution_m: float, origin_m: tuple[float, float]
    ) -> Iterable[Message]:
        """Record the finished occupancy grid of a 2D log.

        cells : (H, W), as ROS counts: 0 free to 100 occupied, −1 (255) unknown; row 0 at the lowest y
        origin_m : x, y of the outer corner of cells[0, 0]
        """
        height, width = cells.shape
        pixels = np.ascontiguousarray(cells[::-1]).view(np.uint8)  # rerun's first row is the top one
        grid = rr.GridMap(
            data=pixels.tobytes(),
            format=rr.components.ImageFormat(width=width, height=height, color_model="L", channel_datatype="U8"),
            cell_size=resolution_m,
            translation=[*origin_m, -0.05],
            colormap=rr.components.Colormap.RvizMap,
        )
        yield Message(entities.GRID, grid)

    def close(self) -> None:
        """Write the last batch, frame the view, and close file and viewer; may be called twice."""
        self._send(lambda: [*self.batcher.messages(), *self.batcher.graph.draw(self.now)])
        layout = blueprint(self.dimension, self.batcher.box, self.batcher.scans)
        for sink in self.sinks:
            sink.send(layout)
            sink.close()
        self.problems, self.sinks = self.warnings, []
        if self.server is not None:
            viewer.stop(self.server)
            self.server = None

    def hold(self) -> None:
        """Keep the web viewer served until it ends or the user interrupts."""
        self._send(self.batcher.messages)
        if self.server is not None:
            try:
                self.server.wait()
            except KeyboardInterrupt:
                return

    def _viewer_address(self) -> str:
        """Address of a viewer; empty, with a warning, if there is none."""
        try:
            if "web" in self.wanted:
                self.server = viewer.start_web(self.port, self.web_port)
                self.web_address = viewer.web_address(self.port, self.web_port)
            elif "spawn" in self.wanted:
                viewer.start_window(self.port)
            elif not viewer.is_listening(self.port):
                raise viewer.ViewerError(
                    f"no viewer at {viewer.HOST}:{self.port}, the run goes on without it; open one with: rerun"
                )
        except (viewer.ViewerError, OSError) as error:
            self.problems.append(str(error))
            return ""
        return viewer.grpc_address(self.port)

    @property
    def now(self) -> Times:
        """The instant of the last step."""
        return Times.at(*self.last)

    def _draws_map_of(self, step: Step) -> bool:
        """True for every so many keyframes."""
        return step.keyframe >= 0 and step.keyframe % self.config.local_map_every == 0 and len(step.local_map) > 0

    def _cloud(self, entity: str, points: NDArray[np.floating], times: Times) -> list[Message]:
        """Every n-th point, so that a viewer can draw them."""
        return [Message(entity, drawing.dots(drawing.at_most(points, self.config.max_map_points)), times)]

    def _step(self, step: Step) -> list[Message]:
        """Messages that are due after a step."""
        messages = self.batcher.graph.draw(self.now) if self.batcher.graph.has_grown else []
        if self._draws_map_of(step):
            messages += self._cloud(entities.LOCAL_MAP, step.local_map, self.now)
        return [*messages, *self.batcher.messages()] if self.batcher.is_due else messages

    def _send(self, say: Callable[[], Iterable[Message]]) -> None:
        """Send the messages that ``say`` returns to every sink."""
        messages: list[Message] = []
        if self.sinks:
            self._guard(lambda: messages.extend(say()))
        for sink in self.sinks if messages else ():
            sink.send(messages)

    def _guard(self, act: Callable[[], object]) -> None:
        """Turn an exception into a warning, once per kind: a recording that fails must not fail the run."""
        try:
            with catch_and_log_exceptions(strict=True):  # else rerun turns errors into warnings on stderr
                act()
        except Exception as error:
            self._note(error)

    def _note(self, error: Exception) -> None:
        problem = f"the recording lacks something: {type(error).__name__}: {error}"
        if problem not in self.problems:
            self.problems.append(problem)


def _document(judged: Judged) -> str:
    listed = "".join(f"- {each.text}\n" for each in judged.unnamed[:_LISTED])
    more = len(judged.unnamed) - _LISTED
    head = f"## {judged.verdict}\n\n{judged.vouched}\n\n{judged.reason}\n\n"
    return head + listed + (f"- and {more:,} more\n" if more > 0 else "")
