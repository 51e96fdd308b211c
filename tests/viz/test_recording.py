import errno
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import numpy as np
import psutil
import pytest
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from scanchain import lie
from scanchain.config import RecordingConfig
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.runs.closures import final_verdicts
from scanchain.runs.step_table import StepTable
from scanchain.verdict import Judged, Kind, Stretch, Verdict
from scanchain_viz.recording import entities, shapes, viewer
from scanchain_viz.recording import recording as module
from scanchain_viz.recording.blueprint import blueprint
from scanchain_viz.recording.messages import Message
from scanchain_viz.recording.recording import Recording
from scanchain_viz.recording.sinks import file_sink, open_stream, write_recording
from tests.support.killing import same_recording
from tests.support.recordings import (
    EVERY_SCAN,
    FOR_EVER,
    NOW_AND_THEN,
    column,
    drive,
    free_port,
    record,
    rows_of,
    static_entities,
)
from tests.support.scenes import ROOT


@pytest.mark.parametrize("dimension", [2, 3])
def test_every_entity_is_there_on_both_timelines_and_every_scan_is_recorded(tmp_path, dimension):
    steps = drive(60, dimension)
    recording = record(tmp_path / "a.rrd", steps, dimension, config=RecordingConfig(local_map_every=2))
    assert recording.warnings == []
    rows, timelines = rows_of(tmp_path / "a.rrd")
    for entity in EVERY_SCAN:
        moving = rows[entity] - (entity in static_entities(tmp_path / "a.rrd"))
        assert moving == len(steps), entity
    for entity in (*EVERY_SCAN, *NOW_AND_THEN):
        assert timelines[entity] == {"scan", "sensor_time"}, entity
    for entity in (*FOR_EVER, entities.MAP, *([entities.GRID] if dimension == 2 else [])):
        assert timelines[entity] == set(), entity


def test_the_recorded_numbers_are_those_of_the_steps(tmp_path):
    steps = drive(60, 2)
    record(tmp_path / "a.rrd", steps, 2)
    path = tmp_path / "a.rrd"
    assert column(path, entities.INLIERS, "Scalars:scalars") == [[173.0]] * 60
    np.testing.assert_allclose(column(path, entities.TIME, "Scalars:scalars"), [[1.0, 2.0, 3.0, 1.0, 0.0]] * 60)
    assert column(path, entities.SCAN, "scan") == list(range(60))
    positions = np.array(column(path, entities.LIDAR, "Transform3D:translation"))[:, 0]
    np.testing.assert_allclose(positions[:, :2], [step.T_world_lidar[:2, 2] for step in steps], atol=1e-5)
    scan = np.array(column(path, entities.SCAN, "Points3D:positions")[17])
    np.testing.assert_allclose(scan[:, :2], steps[17].points, atol=1e-5)
    assert [len(row) for row in column(path, entities.ODOM, "Transform3D:translation")] == [
        1,
        1,
    ]  # start, correction


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # before the recording is closed
def test_a_preview_is_shown_by_a_viewer_until_its_step_is_recorded_and_is_in_no_file(tmp_path, monkeypatch):
    steps, before, after = drive(20, 2), tmp_path / "before.rrd", tmp_path / "after.rrd"
    monkeypatch.setattr(Recording, "_viewer_address", lambda self: "a viewer")
    monkeypatch.setattr(module, "viewer_sink", lambda address, stream, layout: file_sink(after, stream, layout))
    sinks, measured = frozenset({"save", "connect"}), replace(steps[0].scan, points=2.0 * steps[0].scan.points)
    with Recording(tmp_path / "a.rrd", dimension=2, name="a", sinks=sinks, config=RecordingConfig()) as recording:
        recording.preview(measured)
        assert all(sink.settle() for sink in recording.sinks)
        before.write_bytes(after.read_bytes())
        for step in steps:
            recording.log(step)
    assert recording.warnings == []
    scan = "Points3D:positions"
    (previewed,) = column(before, entities.SCAN, scan)
    np.testing.assert_array_equal(np.array(previewed)[:, :2], measured.points)
    assert column(after, entities.SCAN, "scan") == [0, *range(20)]
    assert column(after, entities.SCAN, scan)[1:] == column(tmp_path / "a.rrd", entities.SCAN, scan)
    assert column(after, entities.SCAN, scan)[0] == previewed
    assert column(tmp_path / "a.rrd", entities.SCAN, "scan") == list(range(20))


def test_stamps_that_step_back_are_recorded_as_they_are(tmp_path):
    steps = drive(60, 2)
    record(tmp_path / "a.rrd", steps, 2)
    stamps = [value.value for value in column_scalars(tmp_path / "a.rrd", entities.SCAN, "sensor_time")]
    assert stamps == [step.scan.stamp_ns for step in steps]
    assert min(np.diff(stamps)) < 0


def column_scalars(path, entity, name):
    values = []
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path.lstrip("/") == entity and not chunk.is_static:
            values.extend(batch.column(name))
    return values


def test_states_are_recorded_where_they_change_and_say_why(tmp_path):
    record(tmp_path / "a.rrd", drive(60, 2), 2)
    states = column(tmp_path / "a.rrd", entities.STATE, "StateChange:state")
    assert states == [["ok"], ["degenerate"], ["lost"], ["ok"]]
    texts = [row[0] for row in column(tmp_path / "a.rrd", entities.EVENTS, "TextLog:text")]
    assert "lost: a reason" in texts
    assert "closure 1 (0 to 4) accepted: looked alike" in texts


def test_what_the_back_end_rejects_and_accepts_again_is_told_when_it_does_so(tmp_path):
    steps = drive(60, 2)
    weights = {20: [0.0], 40: [0.9, 0.9]}  # of the closures of keyframes 4 and 8, as the steps optimize them
    for i, weight in weights.items():
        steps[i] = replace(steps[i], graph=weighed(steps[i].graph, weight))
    record(tmp_path / "a.rrd", steps, 2, final=weighed(steps[40].graph, [0.9, 0.0]))
    events = list(zip(*(column(tmp_path / "a.rrd", entities.EVENTS, name) for name in ("scan", "TextLog:text")),
                      strict=True))  # fmt: skip
    contradicts = "contradicts the rest of the graph, χ² 0"
    assert [(scan, text) for scan, (text,) in events if text.startswith("closure")] == [
        (10, "closure 0 (0 to 2) rejected: looked alike"),
        (20, "closure 1 (0 to 4) accepted: looked alike"),
        (20, f"closure 1 (0 to 4) rejected: {contradicts}"),
        (30, "closure 2 (0 to 6) rejected: looked alike"),
        (40, "closure 3 (0 to 8) accepted: looked alike"),
        (40, "closure 1 (0 to 4) accepted: looked alike"),
        (50, "closure 4 (0 to 10) rejected: looked alike"),
        (59, f"closure 3 (0 to 8) rejected: {contradicts}"),
    ]
    counts = list(zip(*(column(tmp_path / "a.rrd", entities.LOOPS, name) for name in ("scan", "Scalars:scalars")),
                      strict=True))  # fmt: skip
    told = [(0, 0, 0), (10, 0, 1), (20, 0, 2), (30, 0, 3), (40, 2, 2), (50, 2, 3), (59, 1, 4)]
    assert counts == [(scan, [accepted, rejected]) for scan, accepted, rejected in told]
    for entity, edges in ((entities.ACCEPTED, 1), (entities.REJECTED, 4)):
        assert len(column(tmp_path / "a.rrd", entity, "LineStrips3D:strips")[-1]) == edges
        assert column(tmp_path / "a.rrd", entity, "scan")[-1] == 59


def weighed(graph, weights):
    """The graph with these robust weights of its loop edges."""
    weight = graph.weight.copy()
    weight[graph.is_loop] = weights
    return replace(graph, weight=weight)


def test_loop_edges_end_on_their_keyframes_and_doubted_ones_are_amber(tmp_path):
    steps = drive(60, 3)
    record(tmp_path / "a.rrd", steps, 3)
    strips = np.array(column(tmp_path / "a.rrd", entities.ACCEPTED, "LineStrips3D:strips")[-1])
    nodes = np.array(column(tmp_path / "a.rrd", entities.KEYFRAMES, "Points3D:positions")[-1])
    np.testing.assert_array_equal(strips, [[nodes[0], nodes[4]], [nodes[0], nodes[8]]])
    colors = column(tmp_path / "a.rrd", entities.ACCEPTED, "LineStrips3D:colors")[-1]
    red, green, blue = entities.ORANGE
    amber = (red << 24) + (green << 16) + (blue << 8) + 255
    assert colors[0] == amber != colors[1]


def test_a_3d_scan_of_8000_points_takes_at_most_150_kilobytes(tmp_path):
    steps = drive(60, 3, points=8000)
    record(tmp_path / "a.rrd", steps, 3)
    assert (tmp_path / "a.rrd").stat().st_size / len(steps) < 150_000


def test_drawing_the_growing_graph_costs_no_more_than_linear_room(tmp_path):
    rows = []
    for count in (300, 3000):
        record(tmp_path / f"{count}.rrd", drive(count, 2, points=3), 2)
        rows.append(
            sum(len(row) for row in column(tmp_path / f"{count}.rrd", entities.KEYFRAMES, "Points3D:positions"))
        )
    assert rows[1] < 15 * rows[0]


def test_a_position_that_one_direction_leaves_open_is_drawn_long_in_that_direction():
    angle = 0.3
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    information = np.zeros((3, 3))
    information[:2, :2] = R @ np.diag([1e4, 1e6]) @ R.T
    information[2, 2] = 1e8
    columns = {
        str(c.component_descriptor()): c.as_arrow_array().to_pylist()
        for c in shapes.ellipsoids(information[None], 1.0)
    }
    sizes = next(value for key, value in columns.items() if "half_sizes" in key)[0][0]
    quat = next(value for key, value in columns.items() if "quaternion" in key)[0][0]
    longest = int(np.argmax(sizes))
    np.testing.assert_allclose(sorted(sizes)[1:], [1e-3, 1e-2], rtol=1e-4)
    axis = lie.from_quaternion(np.array(quat))[:, longest]
    assert abs(axis[:2] @ R[:, 0]) == pytest.approx(1.0, abs=1e-5)


def test_a_match_without_any_information_is_drawn_at_the_cap_and_breaks_nothing():
    for information in (np.zeros((6, 6)), np.full((6, 6), np.nan)):
        columns = list(shapes.ellipsoids(information[None], 1.0))
        np.testing.assert_allclose(columns[0].as_arrow_array().to_pylist()[0][0], [0.2] * 3, rtol=1e-5)


def test_a_dead_port_costs_no_time_and_leaves_one_line(tmp_path):
    started = time.perf_counter()
    recording = record(tmp_path / "a.rrd", drive(60, 2), 2, sinks=("save", "connect"), port=free_port())
    assert time.perf_counter() - started < 15.0
    assert len(recording.warnings) == 1
    assert "no viewer at 127.0.0.1" in recording.warnings[0] and "\n" not in recording.warnings[0]
    assert rows_of(tmp_path / "a.rrd")[0][entities.INLIERS] == 61


def test_spawn_without_a_display_is_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    recording = record(tmp_path / "a.rrd", drive(60, 2), 2, sinks=("save", "spawn"), port=free_port())
    assert len(recording.warnings) == 1 and "no display" in recording.warnings[0]


def test_the_web_viewer_listens_on_this_machine_only_and_ends_with_the_recording(tmp_path):
    port, web_port = free_port(), free_port()
    recording = Recording(
        tmp_path / "a.rrd", dimension=2, name="test", sinks=frozenset({"save", "web"}), config=RecordingConfig(),
        port=port, web_port=web_port,
    )  # fmt: skip
    with recording:
        assert recording.warnings == []
        assert recording.web_address.startswith(f"http://127.0.0.1:{web_port}/?url=")
        assert viewer.is_listening(web_port)
        with socket.socket() as other, pytest.raises(OSError):
            other.settimeout(0.3)
            other.connect(("127.0.0.2", web_port))
        for step in drive(60, 2):
            recording.log(step)
    assert recording.warnings == []
    deadline = time.monotonic() + 20.0
    while viewer.is_listening(web_port) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not viewer.is_listening(web_port)
    assert rows_of(tmp_path / "a.rrd")[0][entities.INLIERS] == 61


def test_a_viewer_that_dies_ends_with_a_warning_and_the_file_is_whole(tmp_path):
    port, web_port = free_port(), free_port()
    server = viewer.start_web(port, web_port)
    steps = drive(600, 2)
    recording = Recording(
        tmp_path / "a.rrd", dimension=2, name="test", sinks=frozenset({"save", "connect"}),
        config=RecordingConfig(), port=port,
    )  # fmt: skip
    with recording:
        for step in steps:
            if step.scan.index == 300:
                viewer.stop(server)
            recording.log(step)
    assert [line for line in recording.warnings if "the viewer at" in line]
    assert rows_of(tmp_path / "a.rrd")[0][entities.INLIERS] == 601


@pytest.mark.skipif(os.name != "posix", reason="needs signals that stop a process")
def test_a_viewer_that_stops_reading_does_not_stop_the_run(tmp_path):
    script = """
import sys, time, os, signal
from pathlib import Path
from uuid import uuid4
from tests.support.recordings import drive, free_port
from scanchain.config import RecordingConfig
from scanchain_viz.recording import sinks, viewer
from scanchain_viz.recording.blueprint import blueprint
from scanchain_viz.recording.messages import Message
from scanchain_viz.recording.recording import Recording
from scanchain_viz.recording.sinks import open_stream, write_recording
sinks._VIEWER_PATIENCE_S = 1.0
port = free_port()
server = viewer.start_web(port, free_port())
os.killpg(server.pid, signal.SIGSTOP)
try:
    steps = drive(400, 3, points=8000)
    recording = Recording(Path(sys.argv[1]), dimension=3, name="t", sinks=frozenset({"save", "connect"}),
                          config=RecordingConfig(), port=port)
    with recording:
        started = time.perf_counter()
        for step in steps:
            recording.log(step)
        print("LOGGED", time.perf_counter() - started < 20.0)
    print("SAID", any("the viewer at" in line for line in recording.warnings))
finally:
    os.killpg(server.pid, signal.SIGKILL)
    time.sleep(1.0)  # the thread that this frees must end before Python does
"""
    answer = run_script(script, tmp_path / "a.rrd")
    assert answer.returncode == 0, answer.stderr
    assert "LOGGED True" in answer.stdout and "SAID True" in answer.stdout
    assert rows_of(tmp_path / "a.rrd")[0][entities.INLIERS] == 401


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_view_web_prints_one_address_and_takes_its_server_along(tmp_path, number):
    record(tmp_path / "a.rrd", drive(60, 2), 2)
    port, web_port = free_port(), free_port()
    script = f"""
import sys
from scanchain.__main__ import main
from scanchain_viz.recording import viewer
viewer.PORT, viewer.WEB_PORT = {port}, {web_port}
sys.exit(main(["view", "--web", sys.argv[1]]))
"""
    child = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path / "a.rrd")], cwd=ROOT, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert child.stdout.readline() == f"{viewer.web_address(port, web_port)}\n"
    assert viewer.is_listening(port) and viewer.is_listening(web_port)
    servers = psutil.Process(child.pid).children(recursive=True)
    assert servers
    child.send_signal(number)
    output, errors = child.communicate(timeout=20)
    assert (child.returncode, output, errors) == (0, "", "")
    assert psutil.wait_procs(servers, timeout=10)[1] == []
    assert not viewer.is_listening(port) and not viewer.is_listening(web_port)


def run_script(script, path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-c", script, str(path)], env=environment, capture_output=True, text=True, timeout=60
    )


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_the_file_has_its_name_only_once_it_can_be_read(tmp_path, monkeypatch):
    written = []

    def set_sinks(stream, *sinks, **options):
        real(stream, *sinks, **options)
        written.extend(path.name for path in tmp_path.iterdir())

    real = rr.RecordingStream.set_sinks
    monkeypatch.setattr(rr.RecordingStream, "set_sinks", set_sinks)
    sink = file_sink(tmp_path / "a.rrd", open_stream("t", 2, uuid4()), blueprint(2))
    assert written == ["a.rrd.new"]
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd"]
    assert list(RrdReader(tmp_path / "a.rrd").stream())
    sink.close()


def test_a_killed_run_leaves_a_file_that_reads_up_to_the_last_batch(tmp_path):
    script = """
import os, signal, sys, time
from pathlib import Path
from uuid import uuid4
from tests.support.recordings import drive
from scanchain.config import RecordingConfig
from scanchain_viz.recording.blueprint import blueprint
from scanchain_viz.recording.messages import Message
from scanchain_viz.recording.recording import Recording
from scanchain_viz.recording.sinks import open_stream, write_recording
recording = Recording(Path(sys.argv[1]), dimension=2, name="t", sinks=frozenset({"save"}),
                      config=RecordingConfig())
recording.__enter__()
for step in drive(600, 2):
    recording.log(step)
while not recording.sinks[0].waiting.empty():
    time.sleep(0.05)
time.sleep(1.0)  # for the batch that was taken last
os.kill(os.getpid(), signal.SIGKILL)
"""
    answer = run_script(script, tmp_path / "a.rrd")
    assert answer.returncode == -signal.SIGKILL
    rows, _ = rows_of(tmp_path / "a.rrd")
    assert rows[entities.INLIERS] - 1 >= 512


@pytest.mark.skipif(os.name != "posix", reason="needs a limit on the size of files")
def test_a_full_disk_is_a_warning_and_the_run_goes_on(tmp_path):
    script = """
import resource, signal, sys
from pathlib import Path
from uuid import uuid4
from tests.support.recordings import drive, record
from scanchain_viz.recording import sinks
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
sinks._FILE_PATIENCE_S = 1.0
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
print(record(Path(sys.argv[1]), drive(300, 3, points=8000), 3).warnings)
"""
    answer = run_script(script, tmp_path / "a.rrd")
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout.count("is incomplete, the run goes on without it") == 1


def test_what_is_recorded_at_once_is_written_whole_or_not_at_all(tmp_path, monkeypatch, capfd):
    """rerun printed lines of its own, and half a file was left."""
    path, up = tmp_path / "a.rrd", [Message("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)]

    def write():
        write_recording(path, "a", 2, blueprint(2), up)

    write()
    assert RrdReader(str(path)).blueprints()
    before = path.read_bytes()

    def fill_up(_, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill_up)
    with pytest.raises(OSError, match=r"a\.rrd") as full:
        write()
    assert full.value.filename == str(path) and capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == [path] and path.read_bytes() == before


def test_a_step_that_cannot_be_drawn_is_told_and_does_not_raise(tmp_path):
    steps = drive(60, 2)
    steps[30] = replace(steps[30], T_world_lidar=np.eye(7))
    recording = Recording(
        tmp_path / "a.rrd", dimension=2, name="t", sinks=frozenset({"save"}), config=RecordingConfig()
    )
    with recording:
        for step in steps:
            recording.log(step)
    assert recording.warnings and "the recording lacks something" in recording.warnings[0]


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_recording_goes_on_in_file_and_viewer_from_what_was_secured_of_it(tmp_path, dimension):
    steps, port = drive(300, dimension), free_port()
    whole, begun, again = (tmp_path / name for name in ("whole.rrd", "begun.rrd", "again.rrd"))
    options = {"dimension": dimension, "name": "test", "config": RecordingConfig(local_map_every=2)}
    closures = [closure for step in steps for closure in step.closures]
    last = next(step for step in reversed(steps[:200]) if step.graph is not None)
    rows = rows_of_steps(steps[: last.scan.index + 1])

    def finish(recording, rest):
        for step in rest:
            recording.log(step)
        recording.log_closures(final_verdicts(closures, steps[280].graph), steps[280].graph)
        recording.log_map(np.concatenate([step.points for step in steps]))

    with Recording(whole, sinks=frozenset({"save"}), **options) as recording:
        finish(recording, steps)
    with Recording(begun, sinks=frozenset({"save"}), **options) as recording:
        for step in steps[: len(rows)]:
            recording.log(step)
        secured = recording.secure()
        finish(recording, steps[len(rows) : 250])  # what a process records that is killed after its checkpoint
    os.truncate(begun, secured)
    server = viewer.start_web(port, free_port())
    try:
        with Recording(again, sinks=frozenset({"save", "connect"}), port=port, **options) as recording:
            known = [closure for step in steps[: len(rows)] for closure in step.closures]
            recording.resume(begun, rows, known, last.graph)
            finish(recording, steps[len(rows) :])
    finally:
        viewer.stop(server)
    late = [warning for warning in recording.warnings if "the viewer" in warning]  # on a busy machine
    assert recording.warnings == late
    same_recording(again, whole)


def rows_of_steps(steps):
    table = StepTable()
    return [table.append(step) for step in steps]


def test_what_lacks_something_is_not_secured(tmp_path):
    without = Recording(None, dimension=2, name="t", sinks=frozenset(), config=RecordingConfig())
    with without as recording:
        assert recording.secure() == 0
    steps, saved = drive(21, 2), frozenset({"save"})
    with Recording(tmp_path / "a.rrd", dimension=2, name="t", sinks=saved, config=RecordingConfig()) as recording:
        recording.log(steps[0])
        assert recording.secure() == (tmp_path / "a.rrd").stat().st_size > 0
        (tmp_path / "b.rrd").write_bytes(b"no recording")
        recording.resume(tmp_path / "b.rrd", rows_of_steps(steps), [], steps[20].graph)
        assert recording.secure() == 0
    assert "a.rrd is incomplete, the run goes on without it" in recording.warnings[0]


def test_a_path_that_cannot_be_written_is_refused_at_the_start(tmp_path):
    with pytest.raises(InputError, match=r"missing/a\.rrd: cannot write the recording"):
        record(tmp_path / "missing" / "a.rrd", drive(10, 2), 2)
    with pytest.raises(InputError, match="no path"):
        record(None, drive(10, 2), 2)


def test_without_sinks_nothing_is_kept_and_nothing_written(tmp_path):
    recording = Recording(None, dimension=2, name="t", sinks=frozenset(), config=RecordingConfig())
    with recording:
        for step in drive(60, 2):
            recording.log(step)
    assert recording.batcher.steps == [] and recording.warnings == []


def test_a_blueprint_lies_in_the_file(tmp_path):
    record(tmp_path / "a.rrd", drive(60, 2), 2)
    assert RrdReader(str(tmp_path / "a.rrd")).blueprints()


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_viewer_opens_on_observability_residual_and_loops_and_times_stand_behind(dimension):
    _, side = blueprint(dimension).root_container.contents
    verdict, *plots, state, tabs = side.contents
    assert verdict.origin == entities.VERDICT
    assert [view.origin for view in plots] == [entities.OBSERVABILITY, entities.RESIDUAL, entities.LOOPS]
    assert state.origin == entities.STATE
    assert isinstance(tabs, rrb.Tabs) and tabs.active_tab is None  # the first is
    origins = [view.origin for view in tabs.contents]
    assert origins[0] == entities.LEGEND and entities.TIME in origins


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_scene_is_dark_in_a_light_viewer_too(dimension):
    scene, _ = blueprint(dimension).root_container.contents
    (color,) = scene.properties["Background"].color.as_arrow_array().to_pylist()
    assert max(color >> shift & 0xFF for shift in (8, 16, 24)) < 32


def test_the_verdict_is_recorded_as_text_with_its_stretches_as_lines_and_events(tmp_path):
    steps = drive(60, 2)
    path = Trajectory(np.array([s.scan.stamp_ns for s in steps]), np.array([s.T_world_lidar for s in steps]))
    stretches = (
        Stretch(Kind.LOOPS, 5, 50, 4, 0.5, 5.0, 2.0),
        Stretch(Kind.WHEELS, 20, 30, 9, 2.0, 3.0, 1.5),
    )
    judged = Judged(Verdict.CHECK, "; ".join(each.text for each in stretches), stretches, "ATE below 1 m")
    with Recording(
        tmp_path / "a.rrd", dimension=2, name="a", sinks=frozenset({"save"}), config=RecordingConfig()
    ) as r:
        for step in steps:
            r.log(step)
        r.log_verdict(judged, path)
    assert r.warnings == []
    texts = [text for row in column(tmp_path / "a.rrd", entities.EVENTS, "TextLog:text") for text in row]
    assert [text for text in texts if "stretch" in text] == [
        f"stretch to check: {each.text}" for each in stretches
    ]
    statics = {
        chunk.entity_path.lstrip("/"): chunk.to_record_batch()
        for chunk in RrdReader(str(tmp_path / "a.rrd")).stream()
        if chunk.is_static
    }
    (strips,) = statics[entities.STRETCHES].column("LineStrips3D:strips").to_pylist()
    assert [len(strip) for strip in strips] == [2, 12]
    (document,) = statics[entities.VERDICT].column("TextDocument:text").to_pylist()
    assert document[0].startswith("## check these stretches\n\notherwise ATE below 1 m\n")
    assert stretches[0].text in document[0]


def test_the_legend_has_no_table_whose_lines_the_viewer_would_cut_off(tmp_path):
    record(tmp_path / "a.rrd", drive(60, 2), 2)
    texts = [
        chunk.to_record_batch().column("TextDocument:text")[0].as_py()[0]
        for chunk in RrdReader(str(tmp_path / "a.rrd")).stream()
        if chunk.entity_path == f"/{entities.LEGEND}"
    ]
    assert len(texts) == 1 and "red edges" in texts[0] and "|" not in texts[0]
