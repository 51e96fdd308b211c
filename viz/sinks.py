"""Where a recording goes: a file, written at once, and a live viewer, served by a thread of its own.

The two are two streams of one recording. rerun can tee one stream to both, but then a viewer that stops reading
(a suspended laptop, a broken tunnel) blocks the writing of the file, and with it the run, without a limit.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from pathlib import Path
from typing import Protocol
from uuid import UUID

import rerun as rr
import rerun.blueprint as rrb

from pipeline.errors import InputError
from viz.messages import Message

_FLUSH_S = 5.0
_QUEUE = 256  # batches that may wait for a slow viewer


class Sink(Protocol):
    """A place that messages go to."""

    warnings: list[str]

    def send(self, messages: list[Message]) -> None:
        """Take messages; what goes wrong ends up in ``warnings``."""
        ...

    def frame(self, blueprint: rrb.Blueprint) -> None:
        """Replace the blueprint by one that frames what was recorded."""
        ...

    def close(self) -> None:
        """Send off what is left, within a limit of time."""
        ...


def open_stream(name: str, dimension: int, recording_id: UUID) -> rr.RecordingStream:
    """A stream without log-time column, so that there are the two timelines and no third."""
    stream = rr.RecordingStream(f"scanchain {dimension}D", recording_id=recording_id)
    stream.set_log_time_enabled(False)
    stream.send_recording_name(name)
    return stream


class FileSink:
    """A .rrd file; it can be read up to the last batch even if the run is killed."""

    def __init__(self, path: Path, stream: rr.RecordingStream, blueprint: rrb.Blueprint) -> None:
        self.path = path
        self.stream = stream
        self.warnings: list[str] = []
        try:
            stream.set_sinks(rr.FileSink(path), default_blueprint=blueprint)
        except RuntimeError as error:
            raise InputError(
                f"{path}: cannot write the recording: {error}; use another --out or --rerun off"
            ) from error

    def send(self, messages: list[Message]) -> None:
        """Write a batch; a broken disk is told once, and then nothing more is written."""
        if self.warnings:
            return
        try:
            for message in messages:
                message.send(self.stream)
            self.stream.flush(timeout_sec=0.0)
        except Exception as error:
            self.warnings.append(f"{self.path}: the recording is incomplete: {error}")

    def frame(self, blueprint: rrb.Blueprint) -> None:
        """Write the blueprint at the end of the file; the last one holds."""
        if not self.warnings:
            self.stream.send_blueprint(blueprint, make_active=False, make_default=True)

    def close(self) -> None:
        """Finish the file."""
        try:
            self.stream.flush(timeout_sec=_FLUSH_S)
        except Exception as error:
            if not self.warnings:
                self.warnings.append(f"{self.path}: the recording is incomplete: {error}")
        self.stream.disconnect()


class LiveSink:
    """A viewer that listens on ``address``; batches that it is too slow for are dropped and counted."""

    def __init__(self, address: str, stream: rr.RecordingStream, blueprint: rrb.Blueprint) -> None:
        self.address = address
        self.stream = stream
        self.blueprint = blueprint
        self.warnings: list[str] = []
        self.dropped = 0
        self.waiting: queue.Queue[list[Message] | rrb.Blueprint | None] = queue.Queue(_QUEUE)
        self.thread = threading.Thread(target=self._serve, name="rerun viewer", daemon=True)
        self.thread.start()

    def send(self, messages: list[Message]) -> None:
        """Hand a batch to the thread."""
        self._put(messages)

    def frame(self, blueprint: rrb.Blueprint) -> None:
        """Hand the blueprint to the thread."""
        self._put(blueprint)

    def close(self) -> None:
        """Give the viewer a few seconds to take the rest, then go on without it."""
        with contextlib.suppress(queue.Full):
            self.waiting.put(None, timeout=_FLUSH_S)
        self.thread.join(_FLUSH_S)
        if self.thread.is_alive():
            rr.unregister_shutdown()  # it would wait for the viewer when Python ends, without a limit
            self.warnings.append(f"the viewer at {self.address} stopped reading; what it shows is incomplete")
        elif self.dropped:
            self.warnings.append(f"the viewer at {self.address} was too slow: it misses {self.dropped} batches")

    def _put(self, item: list[Message] | rrb.Blueprint) -> None:
        if self.warnings:
            return
        try:
            self.waiting.put_nowait(item)
        except queue.Full:
            self.dropped += 1

    def _serve(self) -> None:
        try:
            self.stream.set_sinks(rr.GrpcSink(self.address), default_blueprint=self.blueprint)
            while (item := self.waiting.get()) is not None:
                if isinstance(item, list):
                    for message in item:
                        message.send(self.stream)
                else:
                    self.stream.send_blueprint(item)
                self.stream.flush(timeout_sec=_FLUSH_S)
            self.stream.disconnect()
        except Exception as error:
            self.warnings.append(f"the viewer at {self.address} is gone, the run goes on without it: {error}")
