"""Destinations of a recording: a file, a live viewer, or both; each is a stream served by its own thread.

rerun can tee one stream to both, but it waits without a limit for a viewer that stops reading (a suspended laptop,
a broken tunnel) and for a file on a full disk, and would block the run. Here the run waits only for a queue, with
a timeout.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import queue
import sys
import threading
import warnings
from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from uuid import UUID, uuid4

import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings as bindings
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from scanchain.errors import InputError, counted
from scanchain.files import write_whole
from scanchain.processes import LOOK_S, KilledFor, die_first, die_with_parent, reading_limits, run_within
from scanchain_viz.recording.drawing import Message
from scanchain_viz.recording.entities import UP

_FILE_PATIENCE_S, _VIEWER_PATIENCE_S = 10.0, 5.0  # time without progress after which writing is abandoned
_open: set[rr.RecordingStream] = set()  # those that are open or were not closed cleanly


@dataclass(eq=False)
class Sink:
    """Passes batches on to one stream.

    name : in warnings
    connect : called first, in the thread
    patience_s : timeout after which a sink that accepts no data is abandoned
    is_lossless : whether the run waits for it when it falls behind; otherwise batches are dropped
    """

    name: str
    stream: rr.RecordingStream
    connect: Callable[[], None]
    _: KW_ONLY
    patience_s: float
    is_lossless: bool

    def __post_init__(self) -> None:
        self.warnings: list[str] = []
        self.dropped = 0
        self.flushes = 0
        self.lock = threading.Lock()
        self.waiting: queue.Queue[Callable[[rr.RecordingStream], object] | None] = queue.Queue(16)
        self.thread = threading.Thread(target=self._serve, name=f"recording to {self.name}", daemon=True)
        self.thread.start()

    def send(self, write: Callable[[rr.RecordingStream], object]) -> None:
        """Have the thread write to the stream; errors are added to ``warnings``."""
        if self.warnings:
            return
        try:
            self.waiting.put(write, timeout=self.patience_s if self.is_lossless else 0.0)
        except queue.Full:
            self.dropped += 1
            if self.is_lossless:
                self._abandon("it accepts no more data")

    def settle(self) -> bool:
        """Wait until everything is written; True if it is."""
        settled = threading.Event()
        if not self.warnings:
            with contextlib.suppress(queue.Full):
                self.waiting.put(lambda stream: settled.set(), timeout=self.patience_s)
            flushes, since_s = self.flushes, perf_counter()
            while not settled.wait(LOOK_S) and not self.warnings:
                if flushes != self.flushes:
                    flushes, since_s = self.flushes, perf_counter()
                elif perf_counter() - since_s > self.patience_s:
                    self._abandon("it accepts no more data")
        return not self.warnings

    def close(self) -> None:
        """Wait for the rest to be written, up to the timeout, then continue without this sink."""
        if not self.warnings:
            with contextlib.suppress(queue.Full):
                self.waiting.put(None, timeout=self.patience_s)
            self.thread.join(self.patience_s + 1.0)
            if self.thread.is_alive():
                self._abandon("it accepts no more data")
        if self.dropped and not self.warnings:
            self.warnings.append(f"{self.name} was too slow: it lacks {counted(self.dropped, 'batch', 'batches')}")

    def _serve(self) -> None:
        try:
            self.connect()
            while (write := self.waiting.get()) is not None:
                write(self.stream)
                self._flush()
            self.stream.disconnect()
            _open.discard(self.stream)
        except Exception as error:
            self._abandon(str(error))

    def copy(self, path: Path, stream: rr.RecordingStream) -> None:
        """Write a recording's data, in the thread, except its static messages, which are sent again."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RerunWarning)  # what a killed process wrote lacks rerun's index
            chunks = RrdReader(path).stream().filter(is_static=False)
        for number, chunk in enumerate(chunks, start=1):
            rr.send_chunks(chunk, recording=stream)
            if number % 64 == 0:  # chunks in memory
                self._flush()

    def _flush(self) -> None:
        self.stream.flush(timeout_sec=self.patience_s)
        self.flushes += 1

    def _abandon(self, why: str) -> None:
        """Warn, and never free the stream: freeing it, like rerun's exit handler, may block forever."""
        with self.lock:
            if self.warnings:
                return
            self.warnings.append(f"{self.name} is incomplete, the run goes on without it: {why}")
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(self.stream))
            rr.unregister_shutdown()


def is_readable(path: Path) -> bool:
    """True if a recording can be read; tried in a separate process, since rerun aborts on damaged sizes."""
    with TemporaryDirectory(prefix="scanchain-") as folder:
        output = Path(folder) / "output.txt"
        ending = run_within(reading_limits(path), __name__, [str(path.resolve())], os.environ, output=output)
    return ending.killed_for is KilledFor.NOTHING and ending.code == 0


def open_stream(name: str, dimension: int, recording_id: UUID, kind: str = "") -> rr.RecordingStream:
    """A stream with the recording's name and without rerun's log_time; each ``kind`` has its own layout.

    rerun keeps two threads for each closed stream until streams without an owner are freed, as by ``rr.init``.
    Freeing waits for streams that accept no more data, and ends a recording that the user started: it is skipped
    if there is either.
    """
    if not _open and rr.get_global_data_recording() is None:
        bindings.flush_and_cleanup_orphaned_recordings()
    application = " ".join(filter(None, ("scanchain", kind, f"{dimension}D")))
    stream = rr.RecordingStream(application, recording_id=recording_id)
    _open.add(stream)
    stream.set_log_time_enabled(False)
    stream.send_recording_name(name)
    return stream


def send_layout(stream: rr.RecordingStream, blueprint: rrb.Blueprint, *, is_active: bool) -> None:
    """Send a layout by a stream that is then closed; ``rr.send_blueprint`` leaves one open, with two threads."""
    application = stream.get_application_id() or ""
    layout = rr.RecordingStream._from_native(
        bindings.new_blueprint(application, make_default=False, make_thread_default=False, default_enabled=True)
    )
    layout.set_time("blueprint", sequence=0)
    blueprint.to_blueprint()._log_to_stream(layout)
    storage = layout.memory_recording().storage
    bindings.send_blueprint(storage, is_active, True, recording=stream.to_native())
    layout.disconnect()


def file_sink(path: Path, stream: rr.RecordingStream, blueprint: rrb.Blueprint) -> Sink:
    """A .rrd file; it can be read up to the last batch even if the run is killed.

    It gets its final name only once it can be read: rerun writes the header in parts.
    """
    unnamed = path.with_name(f"{path.name}.new")
    try:
        stream.set_sinks(rr.FileSink(unnamed))
        send_layout(stream, blueprint, is_active=False)
        stream.flush(timeout_sec=_FILE_PATIENCE_S)
        unnamed.replace(path)
    except (RuntimeError, OSError) as error:
        raise InputError(
            f"{path}: cannot write the recording: {error}; use another --out or --rerun off"
        ) from error
    return Sink(f"{path}", stream, lambda: None, patience_s=_FILE_PATIENCE_S, is_lossless=True)


def write_recording(
    path: Path, name: str, dimension: int, blueprint: rrb.Blueprint, messages: Iterable[Message], *, kind: str
) -> None:
    """Write complete data, with z up, to a .rrd file, completely or not at all. Raises OSError.

    name : of the recording; the suffix .partial-… of an unfinished directory is removed
    """
    stream = open_stream(name.partition(".partial-")[0], dimension, uuid4(), kind)
    memory = stream.memory_recording()
    send_layout(stream, blueprint, is_active=False)
    for message in (UP, *messages):
        message.send(stream)
    data = memory.drain_as_bytes()
    stream.disconnect()
    _open.discard(stream)
    write_whole(path, data)


def viewer_sink(address: str, stream: rr.RecordingStream, blueprint: rrb.Blueprint) -> Sink:
    """A viewer at ``address``."""

    def connect() -> None:
        stream.set_sinks(rr.GrpcSink(address))
        send_layout(stream, blueprint, is_active=False)

    return Sink(f"the viewer at {address}", stream, connect, patience_s=_VIEWER_PATIENCE_S, is_lossless=False)


if __name__ == "__main__":  # started by ``is_readable``
    die_first()
    die_with_parent()
    for _ in RrdReader(Path(sys.argv[1])).stream().filter(is_static=False):
        pass
