"""A run may be killed at any moment: it goes on to the same result."""

import hmac
import json
import os
import pickle
import random
import signal
import subprocess
import sys
import time
import zlib
from itertools import islice

import numpy as np
import pyarrow.parquet as pq
import pytest

from scanchain.errors import InputError
from scanchain.logs import open_log
from scanchain.runs import resume
from scanchain.runs.directory import POINTS_FILE, RECORDING_FILE
from scanchain.runs.resume import Checkpoints, read_checkpoint
from scanchain.slam import Slam
from scanchain.trajectory import read_tum
from scanchain_viz.recording import entities
from tests.support import killing, made
from tests.support.recordings import column
from tests.support.scenes import ROOT, configured, shared_data

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
LOOPING = ("--loops.min_travel_m", "3", "--loops.min_radius_m", "15")  # else 20 s have no closures
RECORDED = (*LOOPING, "--checkpoint", "0.1", "--error-bars", "quick")
LIVELY = (*RECORDED, "--rerun", "off")


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """Twenty seconds in the simulated office, 200 scans."""
    return made.log("office", tmp_path_factory.mktemp("log"), seconds=20)


@pytest.fixture(scope="module")
def whole(office, tmp_path_factory):
    """A run of it that nobody disturbed."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert killing.start(office, out, *RECORDED).wait() == 0
    return out


@pytest.fixture(scope="module", params=["2D", pytest.param("3D", marks=pytest.mark.slow)])
def undisturbed(request, office, whole, tmp_path_factory):
    """A log and its run."""
    if request.param == "2D":
        return office, whole
    log, out = made.log("town", seconds=10, sensor="vlp-16"), tmp_path_factory.mktemp("town") / "run"
    assert killing.start(log, out, *RECORDED).wait() == 0
    return log, out


def after(code, *words, **options):
    """A command whose process runs some code first."""
    before = "import os, signal, sys, time\nfrom scanchain.__main__ import main\n"
    whole = f"{before}{code}\nsys.exit(main(sys.argv[1:]))"
    return subprocess.Popen([sys.executable, "-c", whole, *words], cwd=ROOT, **options)


def signed(body):
    return body + hmac.digest(resume._key(), body, "sha256")


def left_after(steps, log, out, *words):
    """Kill a run of a log once it has so many steps in its checkpoint."""
    child = killing.start(log, out, *words)
    killing.wait_for_steps(child, out, steps)
    child.kill()
    child.wait()


@pytest.mark.slow
def test_interrupted_again_and_again_a_run_goes_on_to_the_same_result_and_recording(office, whole, tmp_path):
    out, stamps_ns = tmp_path / "run", read_tum(whole / "odometry.tum").stamps_ns
    assert pq.read_table(whole / "loops.parquet").num_rows > 0
    reached = []
    for interruption, share in ((signal.SIGKILL, 0.25), (signal.SIGINT, 0.4), (signal.SIGKILL, 0.5)):
        interrupted = f"""
from scanchain.runs.resume import Checkpoints
act = Checkpoints.write
def interrupted(self, slam, *more):
    act(self, slam, *more)
    if len(slam.steps) >= {share * len(stamps_ns)}:
        Checkpoints.write = act
        os.kill(os.getpid(), {int(interruption)})
Checkpoints.write, Checkpoints.are_due = interrupted, lambda self: True
"""
        words = ["run", str(office), "--out", str(out), *RECORDED, "--resume"]
        assert after(interrupted, *words).wait() != 0
        table = read_checkpoint(killing.partial(out), killing.config_of(killing.partial(out))).slam.steps
        reached.append(len(table))
        assert (killing.partial(out) / RECORDING_FILE).exists()
        np.testing.assert_array_equal(table.trajectory("T_odom_lidar").stamps_ns, stamps_ns[: len(table)])
    assert 0 < reached[0] <= reached[1] <= reached[2] and reached[0] < len(stamps_ns)
    assert killing.start(office, out, *RECORDED, "--resume").wait() == 0
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["run"]
    killing.same_result(out, whole)
    assert "note           resumed after" in (out / "summary.txt").read_text()
    assert not list(out.glob("*.checkpoint"))


def test_killed_at_any_moment_a_run_leaves_files_that_open_and_goes_on_to_the_same_result(undisturbed, tmp_path):
    log, whole = undisturbed
    seed, longest_s = random.randrange(1000), json.loads((whole / "run.json").read_text())["duration_s"] + 1.0
    print(f"seed {seed}; python -m tests.benchmarks.kills kills as often as wanted")
    killed = list(killing.kill_at_random(log, RECORDED, tmp_path, whole, kills=2, seed=seed, longest_s=longest_s))
    assert len(killed) == 2


@pytest.mark.slow
def test_killed_while_it_takes_up_the_recording_a_run_goes_on_to_the_same_one(office, whole, tmp_path):
    out = tmp_path / "run"
    left_after(80, office, out, *RECORDED)
    words = ["run", str(office), "--out", str(out), *RECORDED, "--resume"]
    for module, kind, method in (
        ("scanchain_viz.recording.recording", "Recording", "resume"),
        ("scanchain.runs.resume", "Checkpoints", "write"),
    ):
        dying = f"""
from {module} import {kind}
act = {kind}.{method}
def dying(self, *values):
    act(self, *values)
    os.kill(os.getpid(), signal.SIGKILL)
{kind}.{method} = dying
"""
        assert after(dying, *words).wait() == -signal.SIGKILL
        assert list(killing.partial(out).glob("recording.part_*.rrd"))
    assert killing.start(office, out, *RECORDED, "--resume").wait() == 0
    killing.same_result(out, whole)


@pytest.mark.slow
def test_a_run_recorded_from_the_middle_on_says_so_and_draws_the_whole_graph(office, whole, tmp_path):
    out = tmp_path / "run"
    left_after(90, office, out, *LIVELY)
    assert killing.start(office, out, *RECORDED, "--resume").wait() == 0
    assert "the recording begins there" in (out / "summary.txt").read_text()
    assert "the recording lacks something" not in (out / "summary.txt").read_text()
    for entity, name in ((entities.KEYFRAMES, "Points3D:positions"), (entities.REJECTED, "LineStrips3D:strips")):
        assert column(out / RECORDING_FILE, entity, name)[-1] == column(whole / RECORDING_FILE, entity, name)[-1]


@pytest.mark.parametrize(
    "name, count, changes",
    [
        ("office", 200, {"loops.min_travel_m": 3.0, "loops.min_radius_m": 15.0}),
        ("2d/intel.mcap", 200, {"matching.matcher": "svd", "loops.enabled": False}),
        ("3d/kitti_0001_first54.mcap", 54, {"loops.min_travel_m": 3.0, "loops.place_radius_m": 4.0}),
    ],
)
def test_a_chain_that_is_put_down_and_taken_up_places_every_scan_to_the_same_bit(
    office, tmp_path, name, count, changes
):
    log = open_log(office if name == "office" else shared_data(name))
    config = configured(log.dimension, changes)
    straight, broken = Slam(config, log.T_base_lidar), Slam(config, log.T_base_lidar, tmp_path / POINTS_FILE)
    breaks = set(random.Random(2).sample(range(count), 8)) | {0}
    for scan in islice(log.scans(), count):
        a, b = straight.process(scan), broken.process(scan)
        assert a.T_world_lidar.tobytes() == b.T_world_lidar.tobytes()
        assert a.match.information.tobytes() == b.match.information.tobytes()
        if scan.index in breaks:
            broken = killing.taken_up(broken, tmp_path)
    a, b = straight.finish(), broken.finish()
    assert len(a.closures) == len(b.closures)
    assert len(a.closures) > 0 or not config.loops.enabled
    assert a.trajectory.poses.tobytes() == b.trajectory.poses.tobytes()
    assert a.state.weight.tobytes() == b.state.weight.tobytes()


def test_an_optimization_beside_ends_alike_after_a_break(office, tmp_path, monkeypatch):
    monkeypatch.setattr("scanchain.graph.schedule.LARGE", 10)
    monkeypatch.setattr("scanchain.graph.schedule.LAG", 5)
    monkeypatch.setattr("scanchain.placement.LAG", 5)
    log = open_log(office)
    config = configured(2, {"loops.min_travel_m": 3.0, "loops.min_radius_m": 15.0})
    straight = Slam(config, log.T_base_lidar, is_live=True)
    broken = Slam(config, log.T_base_lidar, tmp_path / POINTS_FILE, is_live=True)
    breaks = 0
    for scan in log.scans():
        was_in_background = broken.back_end.placement.schedule.background is not None
        a, b = straight.process(scan), broken.process(scan)
        assert a.T_world_lidar.tobytes() == b.T_world_lidar.tobytes()
        assert (a.graph is None) == (b.graph is None)
        if broken.back_end.placement.schedule.background is not None and not was_in_background:
            breaks += 1
            broken = killing.taken_up(broken, tmp_path)
    assert breaks > 0
    assert straight.finish().trajectory.poses.tobytes() == broken.finish().trajectory.poses.tobytes()


# dawdles before scan 100, then says "there" and waits
WAITING = """
from scanchain.slam import Slam
process = Slam.process
def waiting(self, scan):
    if scan.index == 99:
        time.sleep(0.2)
    if scan.index == 100:
        print("there", flush=True)
        time.sleep(60)
    return process(self, scan)
Slam.process = waiting
"""


def test_ctrl_c_ends_a_run_in_good_order_with_exit_code_1(office, tmp_path):
    out = tmp_path / "run"
    child = killing.start(office, out, *RECORDED, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    killing.wait_for_steps(child, out, 30)
    child.send_signal(signal.SIGINT)
    output, errors = (text.decode() for text in child.communicate(timeout=60))
    assert child.returncode == 1 and errors.count("\n") == 1 and "PARTIAL" in output
    assert errors.startswith("error: stopped by the user after ") and str(killing.partial(out)) in errors
    assert errors.endswith(f"to resume: scanchain run {office} --out {out} {' '.join(RECORDED)} --resume\n")
    assert 30 <= killing.assert_readable(killing.partial(out)) < 200


@pytest.mark.slow
def test_ctrl_c_twice_ends_a_run_at_once_and_it_can_go_on(office, whole, tmp_path):
    out = tmp_path / "run"
    words = ["run", str(office), "--out", str(out), *LIVELY, "--checkpoint", "0"]
    child = after(WAITING, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "there\n"
    child.send_signal(signal.SIGINT)
    time.sleep(0.5)
    assert child.poll() is None
    child.send_signal(signal.SIGINT)
    errors = child.communicate(timeout=20)[1]
    assert child.returncode == 1 and errors.count("\n") == 1
    assert "interrupted; 100 scans until then are in" in errors
    assert f"to resume: scanchain {' '.join(words)} --resume\n" in errors
    assert killing.assert_readable(killing.partial(out)) == 100
    assert killing.start(office, out, *LIVELY, "--resume").wait() == 0
    killing.same_result(out, whole)


def test_resuming_is_refused_where_something_else_was_run(office, call, tmp_path):
    out, other = tmp_path / "run", made.log("office", seconds=3, seed=5)
    child = killing.start(office, out, *LIVELY)
    killing.wait_for_steps(child, out, 1)

    def refusal(log, *words):
        code, _, errors = call("run", log, "--out", out, *LIVELY, "--resume", *words)
        assert code == 2 and errors.count("error: ") == 1
        return errors

    child.send_signal(signal.SIGSTOP)
    assert f"is being written by process {child.pid}" in refusal(office)
    child.kill()
    child.wait()
    assert "another configuration" in refusal(office, "--matching.matcher", "svd")
    assert "scan 0 of the log is not the one that was run" in refusal(other)
    checkpoint = killing.partial(out) / "state.checkpoint"
    data = checkpoint.read_bytes()
    checkpoint.write_bytes(signed(data[:-32].replace(b"(code ", b"(c0de ", 1)))
    assert "state.checkpoint: was made by scanchain" in refusal(office)
    for cut in (0, 1, 31, 32, len(data) // 2, len(data) - 1):
        checkpoint.write_bytes(data[:cut])
        assert "is damaged, or of another user" in refusal(office)
    for at in (0, len(data) // 2, len(data) - 1):
        damaged = bytearray(data)
        damaged[at] ^= 1
        checkpoint.write_bytes(damaged)
        assert "is damaged, or of another user" in refusal(office)
    checkpoint.write_bytes(data)
    points = checkpoint.with_name(POINTS_FILE)
    changed = bytearray(points.read_bytes())
    changed[0] ^= 1
    points.write_bytes(changed)
    assert "points.store: is missing, too short or damaged" in refusal(office)


@pytest.mark.parametrize(("limit_kib", "words"), [(64, LIVELY), (400, RECORDED)])
def test_a_full_disk_is_an_error_and_what_is_on_it_is_whole(office, tmp_path, limit_kib, words):
    full = f"signal.signal(signal.SIGXFSZ, signal.SIG_IGN); limit = {limit_kib} << 10\n"
    full += "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))\n"
    out = tmp_path / "run"
    words = ["run", str(office), "--out", str(out), *words]
    child = after(full, *words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    errors = child.communicate()[1]
    assert child.returncode == 1 and errors.startswith("error: ") and errors.count("\n") == 1
    assert "File too large" in errors and not out.exists()
    folder = killing.partial(out)
    assert b'"complete": false' in (folder / "run.json").read_bytes()
    for table in folder.glob("*.parquet"):
        pq.read_table(table)
    assert not list(folder.glob("*.new"))


class Called:
    """Pickled, a call of any method of anything by a function of NumPy, which once was admitted."""

    def __init__(self, *parts):
        self.parts = parts

    def __reduce__(self):
        return np._core.fromnumeric._wrapfunc, self.parts


def attack(path):
    """A pickle that makes a file when it is read."""
    of_numpy = Called(np._core.fromnumeric._wrapfunc, "__getattribute__", "__globals__")
    run = Called(Called(of_numpy, "get", "__builtins__"), "get", "exec")
    return pickle.dumps(Called(run, "__call__", f"open({str(path)!r}, 'w').close()"))


def test_a_checkpoint_of_somebody_else_is_refused_before_it_is_unpickled(office, call, tmp_path, monkeypatch):
    out, executed = tmp_path / "run", tmp_path / "executed"
    left = tmp_path / "run.partial-99999999"
    left.mkdir()
    (left / "run.json").write_text("{}")
    pickle.loads(attack(executed))
    assert executed.exists()
    executed.unlink()
    body = resume._version() + attack(executed)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "attacker"))
    signatures = signed(body)[-32:], zlib.crc32(body).to_bytes(4, "little"), bytes(32), b""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "mine"))
    for signature in signatures:
        (left / "state.checkpoint").write_bytes(body + signature)
        code, _, errors = call("run", office, "--out", out, "--resume")
        assert code == 2 and errors.count("\n") == 1 and not executed.exists()
        assert "is damaged, or of another user or machine: not signed with" in errors
        assert "run without --resume" in errors
    assert sorted(path.name for path in left.iterdir()) == ["run.json", "state.checkpoint"] and not out.exists()


def test_the_key_of_checkpoints_is_the_same_for_all_processes_of_a_user_and_nobody_else_s(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "new" / "state"))
    code = "import sys; from scanchain.runs.resume import _key; sys.stdout.write(_key().hex())"
    together = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) for _ in range(2)]
    assert {child.communicate()[0].decode() for child in together} == {resume._key().hex()}
    (file,) = (tmp_path / "new" / "state" / "scanchain").iterdir()
    assert file.stat().st_mode & 0o777 == 0o600 and len(resume._key()) == 32
    for damage in (lambda: file.chmod(0o644), lambda: file.write_bytes(b""), lambda: file.write_bytes(bytes(33))):
        damage()
        with pytest.raises(InputError, match=r"is not a key of this user alone .*; remove it"):
            resume._key()
        file.chmod(0o600)
    file.unlink()
    assert len(resume._key()) == 32


def test_without_a_place_for_a_key_a_run_says_that_it_has_no_checkpoints(office, call, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    words = ("run", office, "--out", tmp_path / "run", "--checkpoint", "0", "--rerun", "off")
    code, output, errors = call(*words)
    assert code == 0
    (line,) = (line for line in (output + errors).splitlines() if "checkpoint" in line)
    assert line.startswith("no checkpoints, so that --resume would start over: no key to sign them with: ")
    assert line.endswith("; set XDG_STATE_HOME to a folder of yours")


def test_a_state_that_cannot_be_pickled_leaves_the_checkpoint_before(tmp_path):
    slam = Slam(configured(2), dimension=2, points_file=tmp_path / POINTS_FILE)
    Checkpoints(tmp_path, 10.0).write(slam)
    slam.harm = lambda: None
    before = (tmp_path / "state.checkpoint").read_bytes()
    with pytest.raises((AttributeError, pickle.PicklingError)):
        Checkpoints(tmp_path, 10.0).write(slam)
    assert (tmp_path / "state.checkpoint").read_bytes() == before
    assert not list(tmp_path.glob("*.new"))


def test_a_checkpoint_that_names_code_or_another_configuration_is_not_resumed(office, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "evil_matcher.py").write_text("open('executed', 'w')\nclass Cls:\n    align = print\n")
    monkeypatch.chdir(tmp_path)
    config = configured(2)
    slam = Slam(config, open_log(office).T_base_lidar, tmp_path / POINTS_FILE)
    for changed in ("evil_matcher:Cls", "svd"):
        slam.config = slam.front_end.odometry.config = configured(2, {"matching.matcher": changed})
        Checkpoints(tmp_path, 10.0).write(slam)
        with pytest.raises(InputError, match="has another config"):
            read_checkpoint(tmp_path, config)
    assert not (tmp_path / "executed").exists()
    slam.config = slam.front_end.odometry.config = config
    Checkpoints(tmp_path, 10.0).write(slam)
    assert read_checkpoint(tmp_path, config).slam.config == config
