"""Odometry on simulated drives with exact truth and on real logs; what it returns, and scans given twice."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Scan, State
from scanchain.errors import InputError
from scanchain.evaluation import read_relations, relation_error
from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.preprocess import sweep_of
from scanchain.slam import Slam
from tests.support import made
from tests.support.drives import NO_WHEELS, Drive
from tests.support.scenes import configured, shared_data


def test_heading_at_the_stamp_follows_the_acceleration_of_a_turn():
    turns = Drive.of(made.log("turns", seconds=6, sensor="vlp-16"))  # at 120 deg/s
    poses = np.array([step.T_odom_lidar for step in turns.tracked()])
    motions = (lie.between(each[:-10], each[10:]) for each in (turns.truth.poses, poses))
    error = lie.log(lie.between(*motions))
    assert np.degrees(np.linalg.norm(error[:, 3:], axis=1)).max() < 0.8


@pytest.mark.parametrize(
    ("prior", "matcher"), [("auto", "plicp"), ("constant-velocity", "plicp"), ("constant-velocity", "svd")]
)
def test_a_minute_in_the_office_drifts_by_centimeters(office_drive, prior, matcher):
    steps = office_drive.tracked(changes={"odometry.prior": prior, "matching.matcher": matcher})
    assert {step.state for step in steps} == {State.OK}
    assert office_drive.error_m(steps) < (0.03 if matcher == "plicp" else 0.06)


def test_motion_distortion_is_what_deskewing_takes_out(drive):
    steps = [drive.tracked(drive.scans[:200], {"preprocess.deskew": on}) for on in (True, False)]
    assert drive.error_m(steps[0]) < 0.5 * drive.error_m(steps[1])


def test_the_second_scan_tells_how_the_first_one_was_distorted(town_drive):
    odometry, truth = Odometry(configured(3), town_drive.T_base_lidar), town_drive.truth
    first, second = town_drive.scans[45:47]  # at 7 m/s
    for scan in (first, second):
        odometry.process(scan)
    sweep = sweep_of(first, configured(3).preprocess)
    velocity = lie.log(lie.inverse(truth.poses[45]) @ truth.poses[46]) / 0.1
    T_stamp_point = lie.exp((sweep.times_s + sweep.middle_s)[:, None] * velocity)
    expected = np.einsum("nij,nj->ni", T_stamp_point[:, :3, :3], sweep.points) + T_stamp_point[:, :3, 3]
    assert np.linalg.norm(velocity[:3]) > 6.0
    assert np.median(np.linalg.norm(sweep.points - expected, axis=1)) > 0.2
    assert np.median(np.linalg.norm(odometry.first_points - expected, axis=1)) < 0.05


def test_a_corridor_without_ends_is_reported_as_degenerate_along_it():
    rng = np.random.default_rng(0)
    config = configured(2, NO_WHEELS)
    odometry = Odometry(config, np.eye(3))
    for index in range(30):
        x = rng.uniform(-8.0, 8.0, 600)
        walls = np.column_stack([x, np.where(rng.random(600) < 0.5, 1.0, -1.0) + 0.005 * rng.normal(size=600)])
        step = odometry.process(Scan.of(walls.astype(np.float32), 0.1 * index, index=index))
    assert step.state is State.DEGENERATE
    assert abs(step.match.degeneracy_direction[0]) > np.cos(np.radians(5.0))
    assert "is undetermined" in step.reason


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("preprocess.max_range_m", 0.06, r"scan 0 has none of its \d+ points .*; give meters, or widen"),
        ("odometry.prior", "wheel", "scan 1 has no wheel odometry"),
    ],
)
def test_what_cannot_be_tracked_is_named(office_drive, key, value, words):
    with pytest.raises(InputError, match=words):
        office_drive.tracked([replace(scan, T_odom_base=None) for scan in office_drive.scans[:3]], {key: value})
    with pytest.raises(InputError, match="the first one, has no points; begin with one that has some"):
        Odometry(dimension=3).process(Scan.of(np.empty((0, 3)), 0.0))


def test_without_loops_the_world_is_the_odometry_frame(office_drive):
    slam = Slam(configured(2, {"loops.enabled": False}), office_drive.T_base_lidar)
    for scan in office_drive.scans[:100]:
        slam.process(scan)
    result = slam.finish()
    assert not result.closures
    np.testing.assert_allclose(result.trajectory.poses, result.odometry.poses, atol=1e-9)


@pytest.mark.slow
def test_intel_without_wheels_meets_the_published_relations():
    log = open_log(shared_data("2d/intel.mcap"))
    relations = read_relations(shared_data("2d/intel.relations"))
    slam = Slam(configured(2, NO_WHEELS), log.T_base_lidar)
    for scan in log.scans():
        slam.process(scan)
    result = slam.finish()
    assert len(result.trajectory) == 13_631
    before = relation_error(result.odometry, relations)
    after = relation_error(result.trajectory, relations)
    assert before.missing == after.missing == 0
    assert before.translation_m.mean < 0.25
    assert after.translation_m.mean < 0.0229
    assert np.degrees(after.rotation_rad.mean) < 0.453


@pytest.mark.parametrize(
    ("every", "matcher", "limit_m"),
    [
        (1, "plicp", 0.10), (2, "plicp", 0.12), (3, "plicp", 0.15), (5, "plicp", 0.5),
        (1, "svd", 0.10), (2, "svd", 0.12), (3, "svd", 0.15),
    ],
)  # fmt: skip
def test_kitti_stays_within_its_error_of_the_gps_also_at_a_fraction_of_its_scans(every, matcher, limit_m):
    kitti = Drive.of(shared_data("3d/kitti_0001_first54.mcap"), every=every)
    assert kitti.error_m(kitti.tracked(changes={"matching.matcher": matcher})) < limit_m


@pytest.mark.parametrize("late_ns", [1_000, 20_000_000])
def test_a_scan_that_is_logged_twice_changes_no_pose(drive, late_ns):
    scans = drive.scans[:40]
    twice = [each for scan in scans for each in (scan, replace(scan, log_time_ns=scan.log_time_ns + late_ns))]
    steps = drive.tracked(twice)
    for step, copy, expected in zip(steps[::2], steps[1::2], drive.tracked(scans), strict=True):
        assert np.array_equal(step.T_odom_lidar, expected.T_odom_lidar)
        assert np.array_equal(copy.T_odom_lidar, expected.T_odom_lidar)
        assert copy.is_repeated and copy.scan.is_copy and "copy of the previous scan" in copy.reason


def test_a_driver_that_is_given_the_same_cloud_says_so(town_drive):
    first, second = town_drive.scans[:2]
    odometry, buffer = Odometry(configured(3), town_drive.T_base_lidar), first.points.copy()
    for index, scan in enumerate((first, first, second)):
        buffer = np.resize(buffer, scan.points.shape)
        buffer[:] = scan.points  # a driver may fill one buffer again and again
        step = odometry.process(Scan.of(buffer, 0.1 * index))
        assert step.is_repeated == (index == 1)


def scribbled(value, seen=None):
    """Write into every array that is reached from a value that was returned, but for what was given: the scan."""
    seen = set() if seen is None else seen
    if id(value) in seen or isinstance(value, Scan):
        return
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        if value.dtype.kind == "f" and value.flags.writeable:
            value[...] = 7.0
        return
    fields = getattr(value, "__dataclass_fields__", None) or getattr(value, "__struct_fields__", ())
    for each in value if isinstance(value, tuple | list) else (getattr(value, name) for name in fields):
        scribbled(each, seen)


@pytest.mark.parametrize(("make", "has_times"), [(Odometry, True), (Odometry, False), (Slam, True)])
def test_whoever_writes_into_what_is_returned_moves_no_later_pose_and_no_scan_is_written_into(
    drive, has_times, make
):
    scans, poses = drive.scans[: 250 if drive.dimension == 2 and make is Slam else 40], []
    before = [scan.points.copy() for scan in scans]
    if not has_times:
        scans = [replace(scan, times_s=scan.times_s[:0]) for scan in scans]
    for writes in (False, True):
        found = make(configured(drive.dimension), drive.T_base_lidar)
        poses.append([])
        for scan in scans:
            step = found.process(scan)
            poses[-1].append(step.T_odom_lidar.copy())
            if writes:
                scribbled(step)
    assert np.array_equal(*poses)
    assert all(np.array_equal(scan.points, points) for scan, points in zip(scans, before, strict=True))


def test_a_short_silence_begins_no_new_map():
    log = open_log(shared_data("2d/intel.mcap"))
    odometry = Odometry(configured(2), log.T_base_lidar)
    tracked = [
        odometry.process(replace(scan, T_odom_base=None))
        for index, scan in enumerate(islice(log.scans(), 400))
        if not 200 <= index < 205
    ]
    assert not any(each.elsewhere_m for each in tracked)
