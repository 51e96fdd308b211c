import errno
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from scanchain import lie
from scanchain.config import RecordingConfig
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.runs.closures import final_verdicts
from scanchain.steps import Steps
from scanchain.verdict import Judged, Kind, Segment, Verdict
from scanchain_viz.recording import drawing, entities, sinks, viewer
from scanchain_viz.recording.drawing import Message
from scanchain_viz.recording.entities import blueprint
from scanchain_viz.recording.sinks import write_recording
from tests.support.killing import same_recording, wait_until
from tests.support.recordings import (
    EVERY_SCAN,
    FOR_EVER,
    NOW_AND_THEN,
    column,
    drive,
    free_port,
    opened,
    record,
    rows_of,
    static_entities,
)
from tests.support.scenes import ROOT

posix = pytest.mark.skipif(os.name != "posix", reason="needs signals and limits of processes")
STEPS = {dimension: drive(60, dimension) for dimension in (2, 3)}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Recordings of 60 steps in the plane and in space, by dimension."""
    folder = tmp_path_factory.mktemp("recorded")
    for dimension, steps in STEPS.items():
        config = RecordingConfig(local_map_every=2)
        assert record(folder / f"{dimension}.rrd", steps, dimension, config=config).warnings == []
    return {dimension: folder / f"{dimension}.rrd" for dimension in STEPS}


@pytest.mark.parametrize("dimension", [2, 3])
def test_every_entity_is_there_on_both_timelines_and_every_scan_is_recorded(recorded, dimension):
    rows, timelines = rows_of(recorded[dimension])
    static = static_entities(recorded[dimension])
    assert {entity: rows[entity] - (entity in static) for entity in EVERY_SCAN} == dict.fromkeys(EVERY_SCAN, 60)
    for entity in (*EVERY_SCAN, *NOW_AND_THEN):
        assert timelines[entity] == {"scan", "sensor_time"}, entity
    for entity in (*FOR_EVER, entities.MAP, *([entities.GRID] if dimension == 2 else [])):
        assert timelines[entity] == set(), entity
    assert RrdReader(str(recorded[dimension])).blueprints()


def test_the_recorded_numbers_are_those_of_the_steps(recorded):
    path, steps = recorded[2], STEPS[2]
    assert column(path, entities.INLIERS, "Scalars:scalars") == [[173.0]] * 60
    np.testing.assert_allclose(column(path, entities.TIME, "Scalars:scalars"), [[1.0, 2.0, 3.0, 1.0, 0.0]] * 60)
    assert column(path, entities.SCAN, "scan") == list(range(60))
    stamps = [stamp.value for stamp in column(path, entities.SCAN, "sensor_time")]
    assert stamps == [step.scan.stamp_ns for step in steps] and min(np.diff(stamps)) < 0
    positions = np.array(column(path, entities.LIDAR, "Transform3D:translation"))[:, 0]
    np.testing.assert_allclose(positions[:, :2], [step.T_world_lidar[:2, 2] for step in steps], atol=1e-5)
    scan = np.array(column(path, entities.SCAN, "Points3D:positions")[17])
    np.testing.assert_allclose(scan[:, :2], steps[17].points, atol=1e-5)
    corrections = np.array(column(path, entities.ODOM, "Transform3D:translation"))[:, 0]
    np.testing.assert_allclose(corrections, 0.5 * (np.arange(60) >= 30)[:, None] * [0.0, 1.0, 0.0], atol=1e-6)


def test_states_are_recorded_where_they_change_and_say_why(recorded):
    states = column(recorded[2], entities.STATE, "StateChange:state")
    assert states == [["ok"], ["degenerate"], ["lost"], ["ok"]]
    texts = [row[0] for row in column(recorded[2], entities.EVENTS, "TextLog:text")]
    assert "lost: a reason" in texts and "closure 1 (0 to 4) accepted: looked alike" in texts


def test_what_the_back_end_rejects_and_accepts_again_is_told_when_it_does_so(tmp_path):
    steps, path = list(STEPS[2]), tmp_path / "a.rrd"
    weights = {20: [0.0], 40: [0.9, 0.9]}  # of the closures of keyframes 4 and 8, as the steps optimize them
    for i, weight in weights.items():
        steps[i] = replace(steps[i], graph=weighed(steps[i].graph, weight))
    record(path, steps, 2, final=weighed(steps[40].graph, [0.9, 0.0]))
    scans, texts = (column(path, entities.EVENTS, name) for name in ("scan", "TextLog:text"))
    contradicts = "contradicts the rest of the graph, χ² 0"
    assert [(at, text) for at, (text,) in zip(scans, texts, strict=True) if text.startswith("closure")] == [
        (10, "closure 0 (0 to 2) rejected: looked alike"),
        (20, "closure 1 (0 to 4) accepted: looked alike"),
        (20, f"closure 1 (0 to 4) rejected: {contradicts}"),
        (30, "closure 2 (0 to 6) rejected: looked alike"),
        (40, "closure 3 (0 to 8) accepted: looked alike"),
        (40, "closure 1 (0 to 4) accepted: looked alike"),
        (50, "closure 4 (0 to 10) rejected: looked alike"),
        (59, f"closure 3 (0 to 8) rejected: {contradicts}"),
    ]
    counts = column(path, entities.LOOPS, "Scalars:scalars")
    assert column(path, entities.LOOPS, "scan") == [*range(60), 59]
    assert counts[:60:10] == counts[9:60:10] == [[0, 0], [0, 1], [0, 2], [0, 3], [2, 2], [2, 3]]
    assert counts[60] == [1, 4]
    for entity, edges in ((entities.ACCEPTED, 1), (entities.REJECTED, 4)):
        assert len(column(path, entity, "LineStrips3D:strips")[-1]) == edges
        assert column(path, entity, "scan")[-1] == 59


def weighed(graph, weights):
    """The graph with these robust weights of its loop edges."""
    weight = graph.weight.copy()
    weight[graph.is_loop] = weights
    return replace(graph, weight=weight)


def test_loop_edges_end_on_their_keyframes_and_doubted_ones_are_pale(recorded):
    strips = np.array(column(recorded[3], entities.ACCEPTED, "LineStrips3D:strips")[-1])
    nodes = np.array(column(recorded[3], entities.KEYFRAMES, "Points3D:positions")[-1])
    np.testing.assert_array_equal(strips, [[nodes[0], nodes[4]], [nodes[0], nodes[8]]])
    colors = column(recorded[3], entities.ACCEPTED, "LineStrips3D:colors")[-1]
    red, green, blue = entities.Color.PALE_GREEN
    assert colors[0] == (red << 24) + (green << 16) + (blue << 8) + 255 != colors[1]


def test_a_3d_scan_of_8000_points_takes_at_most_150_kilobytes(tmp_path):
    steps = drive(60, 3, points=8000)
    record(tmp_path / "a.rrd", steps, 3)
    assert (tmp_path / "a.rrd").stat().st_size / len(steps) < 150_000


def test_drawing_the_growing_graph_costs_no_more_than_linear_room(tmp_path):
    points = []
    for count in (300, 3000):
        record(path := tmp_path / f"{count}.rrd", drive(count, 2, points=3), 2)
        points.append(sum(map(len, column(path, entities.KEYFRAMES, "Points3D:positions"))))
    assert points[1] < 15 * points[0]


def test_a_position_is_drawn_long_where_a_direction_is_open_and_at_the_cap_without_any_information():
    T = lie.pose_2d(0.0, 0.0, 0.3)
    information = T @ np.diag([1e4, 1e6, 1e8]) @ T.T
    sizes, quaternions = ellipsoid_of(information)
    assert np.sort(sizes)[1:] == pytest.approx([1e-3, 1e-2], rel=1e-4)
    axis = lie.from_quaternion(quaternions)[:, np.argmax(sizes)]
    assert abs(axis @ T[:, 0]) == pytest.approx(1.0, abs=1e-5)
    for nothing in (np.zeros((6, 6)), np.full((6, 6), np.nan)):
        np.testing.assert_allclose(ellipsoid_of(nothing)[0], [0.2] * 3, rtol=1e-5)


def ellipsoid_of(information):
    """Half sizes and orientation of the ellipsoid that stands for an information matrix."""
    return [np.array(c.as_arrow_array().to_pylist()[0][0]) for c in drawing.ellipsoids(information[None], 1.0)]


@pytest.fixture
def ports(monkeypatch):
    """Free ones, which viewers use in this test."""
    monkeypatch.setattr(viewer, "PORT", free_port())
    monkeypatch.setattr(viewer, "WEB_PORT", free_port())
    return viewer.PORT, viewer.WEB_PORT


@pytest.mark.parametrize(("sink", "why"), [("connect", "no viewer at 127.0.0.1"), ("spawn", "no display")])
@pytest.mark.usefixtures("ports")
def test_without_a_viewer_or_a_display_the_file_is_whole_at_once_and_one_line_says_so(
    tmp_path, monkeypatch, sink, why
):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    started = time.perf_counter()
    recording = record(tmp_path / "a.rrd", STEPS[2], 2, sinks=("save", sink))
    assert time.perf_counter() - started < 15.0
    assert len(recording.warnings) == 1 and why in recording.warnings[0] and "\n" not in recording.warnings[0]
    assert rows_of(tmp_path / "a.rrd")[0][entities.INLIERS] == 61


@pytest.mark.parametrize("dies", [False, True])
def test_the_web_viewer_listens_on_this_machine_only_ends_with_the_recording_and_may_die_before(
    tmp_path, ports, dies
):
    web_port, steps = ports[1], drive(600, 2)
    with opened(tmp_path / "a.rrd", sinks=("save", "web")) as recording:
        assert recording.warnings == []
        assert recording.web_address.startswith(f"http://127.0.0.1:{web_port}/?url=")
        assert viewer.is_listening(web_port)
        with socket.socket() as other, pytest.raises(OSError):
            other.settimeout(0.3)
            other.connect(("127.0.0.2", web_port))
        for step in steps:
            if dies and step.scan.index == 300:
                viewer.stop(recording.server)
            recording.log(step)
    assert any("is incomplete" in line for line in recording.warnings) is dies
    wait_until(lambda: not viewer.is_listening(web_port), 20.0)
    assert rows_of(tmp_path / "a.rrd")[0][entities.INLIERS] == 601


@posix
@pytest.mark.slow
@pytest.mark.usefixtures("ports")
def test_a_viewer_that_stops_reading_does_not_stop_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(sinks, "_VIEWER_PATIENCE_S", 1.0)
    steps, server = drive(400, 3, points=8000), viewer.start_web()
    os.killpg(server.pid, signal.SIGSTOP)
    try:
        with opened(tmp_path / "a.rrd", 3, sinks=("save", "connect")) as recording:
            started = time.perf_counter()
            for step in steps:
                recording.log(step)
            assert time.perf_counter() - started < 20.0
        assert any("the viewer at" in line for line in recording.warnings)
    finally:
        os.killpg(server.pid, signal.SIGKILL)
    assert rows_of(tmp_path / "a.rrd")[0][entities.INLIERS] == 401


@posix
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_view_web_prints_one_address_and_takes_its_server_along(recorded, ports, number):
    port, web_port = ports
    script = f"""
import sys
from scanchain.__main__ import main
from scanchain_viz.recording import viewer
viewer.PORT, viewer.WEB_PORT = {port}, {web_port}
sys.exit(main(["view", "--web", sys.argv[1]]))
"""
    child = subprocess.Popen(
        [sys.executable, "-c", script, str(recorded[2])], cwd=ROOT, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert child.stdout.readline() == f"{viewer.web_address()}\n"
    assert viewer.is_listening(port) and viewer.is_listening(web_port)
    servers = psutil.Process(child.pid).children(recursive=True)
    assert servers
    child.send_signal(number)
    output, errors = child.communicate(timeout=20)
    assert (child.returncode, output, errors) == (0, "", "")
    assert psutil.wait_procs(servers, timeout=10)[1] == []
    assert not viewer.is_listening(port) and not viewer.is_listening(web_port)


def test_the_file_has_its_name_only_once_it_can_be_read(tmp_path, monkeypatch):
    real, written = rr.RecordingStream.set_sinks, []

    def set_sinks(stream, *sinks, **options):
        real(stream, *sinks, **options)
        written.extend(path.name for path in tmp_path.iterdir())

    monkeypatch.setattr(rr.RecordingStream, "set_sinks", set_sinks)
    with opened(tmp_path / "a.rrd"):
        assert written == ["a.rrd.new"] and [path.name for path in tmp_path.iterdir()] == ["a.rrd"]


@posix
def test_a_full_disk_is_a_warning_and_the_run_goes_on(tmp_path):
    script = """
import resource, signal, sys
from pathlib import Path
from tests.support.recordings import drive, record
from scanchain_viz.recording import sinks
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
sinks._FILE_PATIENCE_S = 1.0
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
print(record(Path(sys.argv[1]), drive(100, 3, points=8000), 3).warnings)
"""
    command = [sys.executable, "-c", script, str(tmp_path / "a.rrd")]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"}
    told = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=True).stdout
    assert told.count("is incomplete, the run goes on without it") == 1


def test_what_is_recorded_at_once_is_written_whole_or_not_at_all(tmp_path, monkeypatch, capfd):
    """rerun printed lines of its own, and half a file was left."""
    path, up = tmp_path / "a.rrd", [Message("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)]
    write_recording(path, "a", 2, blueprint(2), up, kind="test")
    before = path.read_bytes()
    assert RrdReader(str(path)).blueprints()

    def fill_up(_, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill_up)
    with pytest.raises(OSError, match=r"a\.rrd") as full:
        write_recording(path, "a", 2, blueprint(2), up, kind="test")
    assert full.value.filename == str(path) and capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == [path] and path.read_bytes() == before


def test_a_step_that_cannot_be_drawn_is_told_and_does_not_raise(tmp_path):
    with opened(tmp_path / "a.rrd") as recording:
        for step in (*STEPS[2][:30], replace(STEPS[2][30], T_world_lidar=np.eye(7)), *STEPS[2][31:]):
            recording.log(step)
    assert recording.warnings and "the recording lacks something" in recording.warnings[0]


def table_of(steps):
    table = Steps()
    for step in steps:
        table.append(step)
    return table


@pytest.mark.usefixtures("ports")
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_recording_goes_on_in_file_and_viewer_from_what_was_secured_of_it(tmp_path, dimension):
    steps = drive(300, dimension)
    whole, begun, again = (tmp_path / name for name in ("whole.rrd", "begun.rrd", "again.rrd"))
    config = RecordingConfig(local_map_every=2)
    closures = [closure for step in steps for closure in step.closures]
    last = next(step for step in reversed(steps[:200]) if step.graph is not None)
    first, rest = steps[: last.scan.index + 1], steps[last.scan.index + 1 :]

    def log(recording, some, *, to_the_end=True):
        for step in some:
            recording.log(step)
        if to_the_end:
            recording.log_closures(final_verdicts(closures, steps[280].graph), steps[280].graph)
            recording.log_map(np.concatenate([step.points for step in steps]))

    with opened(whole, dimension, config=config) as recording:
        log(recording, steps)
    with opened(begun, dimension, config=config) as recording:
        log(recording, first, to_the_end=False)
        secured = recording.secure()
        log(recording, rest[:50])  # what a process records that is killed after its checkpoint
    os.truncate(begun, secured)
    server = viewer.start_web()
    try:
        with opened(again, dimension, ("save", "connect"), config) as recording:
            known = [closure for step in first for closure in step.closures]
            recording.resume(begun, table_of(first), known, last.graph)
            log(recording, rest)
    finally:
        viewer.stop(server)
    late = [warning for warning in recording.warnings if "the viewer" in warning]  # on a busy machine
    assert recording.warnings == late
    same_recording(again, whole)


def test_what_lacks_something_is_not_secured_and_without_sinks_nothing_is_kept(tmp_path, monkeypatch):
    with opened(None, sinks=()) as recording:
        recording.log(STEPS[2][0])
        assert recording.secure() == 0
    assert recording.batcher.gathered == [] and recording.warnings == []
    steps = drive(21, 2)
    with opened(tmp_path / "a.rrd") as recording:
        recording.log(steps[0])
        assert recording.secure() == (tmp_path / "a.rrd").stat().st_size > 0
        (tmp_path / "b.rrd").write_bytes(b"no recording")
        recording.resume(tmp_path / "b.rrd", table_of(steps), [], steps[20].graph)
        assert recording.secure() > 0
        monkeypatch.setattr("scanchain_viz.recording.recording.is_readable", lambda path: True)
        recording.resume(tmp_path / "b.rrd", table_of(steps), [], steps[20].graph)
        assert recording.secure() == 0
    damaged, incomplete = recording.warnings
    assert damaged == "b.rrd of the stopped run is damaged: the recording begins where it stopped"
    assert "a.rrd is incomplete, the run goes on without it" in incomplete


def test_a_path_that_cannot_be_written_is_refused_at_the_start(tmp_path):
    with pytest.raises(InputError, match=r"missing/a\.rrd: cannot write the recording"):
        record(tmp_path / "missing" / "a.rrd", drive(10, 2), 2)
    with pytest.raises(InputError, match="no path"):
        record(None, drive(10, 2), 2)


def test_the_verdict_is_recorded_as_text_with_its_segments_as_lines_and_events(tmp_path):
    steps, log = STEPS[2], tmp_path / "a.rrd"
    path = Trajectory(np.array([s.scan.stamp_ns for s in steps]), np.array([s.T_world_lidar for s in steps]))
    segments = (Segment(Kind.LOOPS, 5, 50, 4, 0.5, 5.0, 2.0), Segment(Kind.WHEELS, 20, 30, 9, 2.0, 3.0, 1.5))
    judged = Judged(Verdict.CHECK, "; ".join(each.text for each in segments), segments, "ATE below 1 m")
    with opened(log) as recording:
        for step in steps:
            recording.log(step)
        recording.log_verdict(judged, path)
    assert recording.warnings == []
    texts = [text for row in column(log, entities.EVENTS, "TextLog:text") for text in row]
    assert [text for text in texts if "segment" in text] == [f"segment to check: {s.text}" for s in segments]
    (strips,) = column(log, entities.SEGMENTS, "LineStrips3D:strips", is_static=True)
    assert [len(strip) for strip in strips] == [2, 12]
    document = column(log, entities.VERDICT, "TextDocument:text", is_static=True)[-1]
    assert document[0].startswith("## check these segments\n\notherwise ATE below 1 m\n")
    assert segments[0].text in document[0]


def test_innovations_of_other_sensors_have_a_series_each_where_they_were_compared_and_a_view(tmp_path):
    log, steps = tmp_path / "a.rrd", [replace(each, innovations={"gyro": 0.5}) for each in STEPS[2]]
    steps[7] = replace(steps[7], innovations={})
    with opened(log) as recording:
        recording.log_innovations(table_of(steps))
        assert recording.has_sensors
    assert recording.warnings == []
    (entity,) = [entity for entity in rows_of(log)[0] if entity.startswith(entities.INNOVATIONS)]
    assert column(log, entity, "scan") == [k for k in range(60) if k != 7]
    assert column(log, entity, "Scalars:scalars") == [[0.5]] * 59
    with opened(tmp_path / "b.rrd") as recording:
        recording.log_innovations(table_of(STEPS[2]))
        assert not recording.has_sensors
