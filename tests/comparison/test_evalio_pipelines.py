"""Pipelines of evalio as baselines: their poses hold where they are said to, and what they lack is said."""

import importlib.util
import sys

import numpy as np
import pytest

from scanchain import lie
from scanchain.baselines import BASELINES
from scanchain.comparison import worker
from scanchain.comparison.evalio_pipelines import PIPELINES, ScanLines, entry_of
from scanchain.comparison.methods import resolve
from scanchain.data import Inertial, Trajectory
from scanchain.errors import InputError, MissingExtraError, NotApplicableError
from scanchain.evaluation import absolute_error, pair
from scanchain.simulation import plan
from scanchain.simulation.imu import IMUS
from scanchain.simulation.sensors import take_sweep
from tests.support.scenes import kitti_scans

SWEEP_S, START_NS = 0.1, 10**18
NO_TIMES = np.empty(0, np.float32)
with_evalio = pytest.mark.skipif(
    importlib.util.find_spec("evalio") is None,
    reason="evalio is not installed: pip install 'scanchain[evalio]'",
)


@pytest.fixture(scope="module")
def drive():
    """A simulated car starts and turns: its motion, and for each sweep points, times, start and IMU."""
    plan_ = plan("town", seed=1, sensor="os1-32", duration_s=6.0)
    motion, imu, rng = plan_.motion, IMUS["ideal"], np.random.default_rng(0)
    T_lidar_imu = lie.between(motion.lidar(np.zeros(1))[0], motion.base(np.zeros(1))[0]) @ imu.T_base_imu
    sweeps = []
    for index in range(8, 44):
        start_s = SWEEP_S * index
        sweep = take_sweep(plan_.solids, motion, plan_.sensor, index, start_s, rng)
        instants_s = start_s + SWEEP_S * np.arange(1, 21) / 20
        stamps_ns = START_NS + np.rint(1e9 * instants_s).astype(np.int64)
        inertial = Inertial(stamps_ns, *imu.measure(motion, instants_s, rng), T_lidar_imu)
        sweeps.append((sweep.points(), sweep.times_s().astype(np.float32), start_s, inertial))
    return motion, sweeps


def made(name, **settings):
    entry = entry_of(f"evalio:{name}")
    changed = {key: settings.get(key, getattr(entry.settings, key)) for key in entry.settings.__struct_fields__}
    return entry.make(type(entry.settings)(**changed))


class Raw:
    """Instead of AtStamp: the poses as they are."""

    def __init__(self):
        self.poses, self.held_s = [], []

    def move(self, pose, stamp_ns, held_s):
        self.poses.append(pose)
        self.held_s.append(held_s)
        return pose


@with_evalio
@pytest.mark.parametrize(
    ("name", "limit_m"),
    [
        ("ct", 0.01),
        ("dlio", 0.01),
        ("form", 0.03),
        ("genz", 0.03),
        ("kiss", 0.06),
        ("liosam", 0.01),
        ("mad", 0.02),
    ],
)
def test_a_pose_holds_at_the_instant_to_which_it_is_ascribed(name, limit_m, drive):
    """A quarter of a sweep earlier or later, the path of the accelerating car fits worse."""
    motion, sweeps = drive
    pipeline, raw = made(name), Raw()
    pipeline.at_stamp = raw
    for points, times_s, start_s, inertial in sweeps:
        pipeline.add_inertial(inertial)
        pipeline.track(points, times_s, START_NS + round(1e9 * start_s))
    starts_s = np.array([start_s for _, _, start_s, _ in sweeps])
    held_s, stamps_ns = np.array(raw.held_s), np.rint(1e9 * starts_s).astype(np.int64)
    errors_m = []
    for late_s in (-0.25 * SWEEP_S, 0.0, 0.25 * SWEEP_S):
        truth = Trajectory(stamps_ns[4:], motion.lidar((starts_s + held_s)[4:] + late_s))
        pairs = pair(Trajectory(stamps_ns[4:], np.array(raw.poses)[4:]), truth)
        errors_m.append(absolute_error(pairs).translation_m.rmse)
    assert np.argmin(errors_m) == 1, errors_m
    assert errors_m[1] < limit_m


@with_evalio
def test_evalio_has_the_pipelines_that_are_named_and_their_kiss_icp_is_kiss_icp():
    from evalio.pipelines import all_pipelines

    assert {name.partition(":")[2] for name in PIPELINES} == set(all_pipelines())
    theirs, wrapped = BASELINES["kiss-icp"], made("kiss")
    baseline = theirs.make(theirs.settings)
    for scan in kitti_scans(6):
        pose = wrapped.track(scan.points, NO_TIMES, scan.stamp_ns)
        np.testing.assert_allclose(pose, baseline.track(scan.points, NO_TIMES, scan.stamp_ns), atol=1e-6)


@with_evalio
@pytest.mark.parametrize("name", ["ct", "form", "loam", "mad"])
def test_a_pipeline_tracks_a_real_drive_without_times_of_points(name):
    pipeline, scans = made(name), kitti_scans(8)
    poses = np.array([pipeline.track(scan.points, NO_TIMES, scan.stamp_ns) for scan in scans])
    steps_m = np.linalg.norm(lie.between(poses[2:-1], poses[3:])[:, :3, 3], axis=1)
    assert (np.abs(steps_m - 1.26) < 0.2).all(), steps_m


@with_evalio
def test_settings_are_evalios_parameters_stated_where_they_differ_from_its_defaults(tmp_path):
    file = tmp_path / "evalio.toml"
    file.write_text('["evalio:kiss"]\nvoxel_size = 2\nmax_range = 50.0\n[fine]\nmethod = "evalio:kiss"\n')
    method, fine = resolve(["evalio:kiss", "fine"], 3, file=file)
    assert (method.settings["voxel_size"], fine.settings["voxel_size"]) == (2.0, 1.0)
    description = worker.start(method, np.eye(4)).description
    assert "0.1 to 50 m, deskew True, voxel_size 2.0, else its defaults" in description
    file.write_text('["evalio:kiss"]\nvoxel_size_m = 0.5\n')
    with pytest.raises(
        InputError, match=r"\[evalio:kiss\]: .*voxel_size_m.*; its keys are min_range, max_range, .*deskew"
    ):
        resolve(["evalio:kiss"], 3, file=file)
    with pytest.raises(InputError, match=r"evalio has no pipeline 'icp'; choose among ct, dlio, form"):
        resolve(["evalio:icp"], 3, file=None)
    assert [each.name for each in resolve(["evalio"], 3, file=None)] == list(PIPELINES)
    (planar,) = resolve(["evalio:kiss"], 2, file=None)
    with pytest.raises(NotApplicableError, match="made for 3D clouds"):
        worker.start(planar, np.eye(3))


@with_evalio
def test_what_a_pipeline_needs_and_the_log_lacks_is_said(drive):
    points, times_s, *_ = drive[1][0]
    with pytest.raises(InputError, match="needs an IMU, of which the first scan has no sample"):
        made("dlio").track(points, times_s, START_NS)
    shuffled = np.random.default_rng(0).permutation(points)
    with pytest.raises(InputError, match="needs the lidar's scan lines"):
        made("loam").track(shuffled, NO_TIMES, START_NS)


def test_without_evalio_a_row_names_the_extra(monkeypatch):
    for module in [m for m in sys.modules if m.split(".")[0] == "evalio"]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "evalio", None)
    (method,) = resolve(["evalio:kiss"], 3, file=None)
    with pytest.raises(MissingExtraError, match=r"pip install 'scanchain\[evalio\]'"):
        worker.start(method, np.eye(4))


@pytest.mark.parametrize("in_order", [True, False])
def test_scan_lines_are_found_by_the_order_of_points_or_by_their_elevations(in_order, drive):
    points = drive[1][0][0].astype(float)
    elevations = np.round(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])), 4)
    levels, lines = np.unique(elevations, return_inverse=True)
    if in_order:  # a turn on a slope: elevations of a line vary
        points = points[np.argsort(lines, kind="stable")]
        points = points @ lie.exp(np.array([0.0, 0.0, 0.0, 0.03, 0.0, 0.0]))[:3, :3].T
        lines = np.sort(lines)
    found = ScanLines(points)
    assert found.rows == len(levels) == 32
    cloud = np.zeros(
        len(points), [(name, "<f4") for name in "xyz"] + [("t", "<u4"), ("row", "<u2"), ("col", "<u2")]
    )
    cloud["x"], cloud["t"] = points[:, 0], np.arange(len(points))
    rows = found.organized(cloud, points).reshape(found.rows, found.columns)
    placed = rows[rows["x"] != 0.0]
    of_line = np.repeat(np.arange(32), np.count_nonzero(rows["x"], axis=1))
    assert len(placed) > 0.999 * len(points)
    assert (lines[placed["t"]] == of_line).mean() > 0.998
    assert (np.diff(placed["t"].astype(int))[np.diff(of_line) == 0] > 0).all()
    assert all((np.diff((row != 0.0).astype(int)) <= 0).all() for row in rows["x"]), "a hole in a line"
