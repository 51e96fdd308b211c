"""Odometry and the whole chain on simulated drives with exact truth, and on the real logs' published bars."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Pose, Prior, Scan, State, Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import read_relations, relation_error
from scanchain.logs import open_log
from scanchain.odometry import FrontEnd, Odometry
from scanchain.odometry.odometry import Tracked, first_match
from scanchain.preprocess import sweep_of
from scanchain.slam import Slam
from tests.benchmarks.harness import ate_m
from tests.support import made
from tests.support.scenes import configured, shared_data


@dataclass(frozen=True)
class Drive:
    """Scans of a drive, the mounting of the lidar, and its true trajectory."""

    scans: list[Scan]
    T_base_lidar: Pose
    truth: Trajectory

    @classmethod
    def of(cls, path, **options):
        """The scans of a log, with the keys of its section."""
        log = open_log(path, **options)
        return cls(list(log.scans()), log.T_base_lidar, log.ground_truth())

    @property
    def dimension(self):
        return len(self.T_base_lidar) - 1

    def tracked(self, scans=None, changes=None):
        """Odometry's results for its scans, or for others in their place, some keys changed."""
        odometry = Odometry(configured(self.dimension, changes), self.T_base_lidar)
        return [odometry.process(scan) for scan in (self.scans if scans is None else scans)]

    def error_m(self, steps):
        """Absolute trajectory error."""
        stamps_ns = np.array([step.scan.stamp_ns for step in steps])
        return ate_m(Trajectory(stamps_ns, np.array([step.T_odom_lidar for step in steps])), self.truth)


@pytest.fixture(scope="module")
def office():
    """A minute in the simulated office."""
    return Drive.of(made.log("office", seconds=60, seed=7))


@pytest.fixture(scope="module")
def town():
    """Six seconds in the simulated town, with 32 rings."""
    return Drive.of(made.log("town", seconds=6, seed=7, sensor="os1-32"))


@pytest.fixture
def drive(request, office, town):
    """The one of the dimension that a test is called with."""
    return office if request.param == 2 else town


in_both = pytest.mark.parametrize("drive", [2, 3], indirect=True)


def test_heading_at_the_stamp_follows_the_acceleration_of_a_turn():
    turns = Drive.of(made.log("turns", seconds=6, sensor="vlp-16"))  # at 120 deg/s
    poses = np.array([step.T_odom_lidar for step in turns.tracked()])
    motions = (lie.between(each[:-10], each[10:]) for each in (turns.truth.poses, poses))
    error = lie.log(lie.between(*motions))
    assert np.degrees(np.linalg.norm(error[:, 3:], axis=1)).max() < 0.8


@pytest.mark.parametrize(
    ("prior", "matcher"), [("auto", "plicp"), ("constant-velocity", "plicp"), ("constant-velocity", "svd")]
)
def test_a_minute_in_the_office_drifts_by_centimeters(office, prior, matcher):
    steps = office.tracked(changes={"odometry.prior": prior, "matching.matcher": matcher})
    assert {step.state for step in steps} == {State.OK}
    assert office.error_m(steps) < (0.03 if matcher == "plicp" else 0.06)


NO_WHEELS = {"odometry.prior": "constant-velocity"}


@pytest.mark.parametrize(
    ("is_kept", "changes", "limit_m"),
    [
        (lambda index: True, None, 0.01),
        (lambda index: index >= 40, None, 0.02),  # it starts at speed
        (lambda index: not 30 <= index < 40, None, 0.05),
        (lambda index: not 40 <= index < 52, NO_WHEELS, 0.05),
    ],
)
def test_six_seconds_in_town_with_gaps_or_none_drift_by_centimeters(town, is_kept, changes, limit_m):
    kept = [scan for scan in town.scans if is_kept(scan.index)]
    assert town.error_m(town.tracked(kept, changes)) < limit_m


@in_both
def test_motion_distortion_is_what_deskewing_takes_out(drive):
    steps = [drive.tracked(drive.scans[:200], {"preprocess.deskew": on}) for on in (True, False)]
    assert drive.error_m(steps[0]) < 0.5 * drive.error_m(steps[1])


def test_the_second_scan_tells_how_the_first_one_was_distorted(town):
    odometry, truth = Odometry(configured(3), town.T_base_lidar), town.truth
    first, second = town.scans[45:47]  # at 7 m/s
    for scan in (first, second):
        odometry.process(scan)
    sweep = sweep_of(first, configured(3).preprocess)
    velocity = lie.log(lie.inverse(truth.poses[45]) @ truth.poses[46]) / 0.1
    T_stamp_point = lie.exp((sweep.times_s + sweep.middle_s)[:, None] * velocity)
    expected = np.einsum("nij,nj->ni", T_stamp_point[:, :3, :3], sweep.points) + T_stamp_point[:, :3, 3]
    assert np.linalg.norm(velocity[:3]) > 6.0
    assert np.median(np.linalg.norm(sweep.points - expected, axis=1)) > 0.2
    assert np.median(np.linalg.norm(odometry.first_points - expected, axis=1)) < 0.05


def test_scans_without_stamps_are_predicted_by_the_times_of_the_log(office):
    stamped = office.tracked(changes=NO_WHEELS)
    unstamped = office.tracked([replace(scan, stamp_ns=0) for scan in office.scans], NO_WHEELS)
    assert lie.apart(stamped[-1].T_odom_lidar, unstamped[-1].T_odom_lidar)[0] < 0.01


def test_a_scan_of_another_place_is_lost_and_the_next_good_one_is_found_again(office):
    elsewhere = np.random.default_rng(0).uniform(-300.0, 300.0, (500, 2)).astype(np.float32)
    far = elsewhere[np.linalg.norm(elsewhere, axis=1) > 30.0]
    scans = office.scans[:200]
    scans[100:103] = [replace(scan, points=far, times_s=np.zeros(len(far), np.float32)) for scan in scans[100:103]]
    steps = office.tracked(scans, {"preprocess.max_range_m": 500.0, **NO_WHEELS})
    assert [step.state for step in steps[100:103]] == [State.LOST] * 3
    assert "correspondence" in steps[100].reason
    assert {step.state for step in steps[103:]} == {State.OK}
    assert office.error_m([step for step in steps if step.state is State.OK]) < 0.05


@pytest.mark.parametrize(("niche_m", "state"), [(0.0, State.DEGENERATE), (3.0, State.OK)])
def test_after_a_gap_a_room_that_looks_the_same_turned_around_is_ambiguous(niche_m, state):
    odometry = Odometry(configured(2, NO_WHEELS), np.eye(3))
    for index in range(10):
        odometry.process(scan_of_room(lie.pose_2d(0.3, 0.2, 0.0), niche_m, index, index * 10**8))
    T_room_lidar = lie.pose_2d(0.5, -0.3, 1.2)
    step = odometry.process(scan_of_room(T_room_lidar, niche_m, 10, 29 * 10**8))
    T_turned_lidar = lie.pose_2d(0.0, 0.0, np.pi) @ T_room_lidar
    poses = [lie.between(lie.pose_2d(0.3, 0.2, 0.0), T) for T in (T_room_lidar, T_turned_lidar)]
    away_m, other_m = (lie.apart(step.T_odom_lidar, T)[0] for T in poses)
    assert step.state is state
    assert min(away_m, other_m) < 0.02
    if state is State.DEGENERATE:
        assert step.reason.startswith("ambiguous: a pose 1.2 m away, turned by 3.14 rad")
        assert np.linalg.inv(step.match.information)[2, 2] > 3.1**2
    else:
        assert away_m < 0.02


def scan_of_room(T_room_lidar, niche_m, index, stamp_ns):
    """A scan of the walls of a room of 10 m by 6 m, which have a niche or none."""
    corners = [[5, 3], [-5, 3], [-5, -3], [5, -3], [5, 0], [5 + niche_m, 0], [5 + niche_m, 2], [5, 2], [5, 3]]
    wall = np.array(corners, np.float64)
    along = np.linspace(0.0, 1.0, 100)[:, None]
    points = np.concatenate([a + along * (b - a) for a, b in pairwise(wall)])
    points += 0.005 * np.random.default_rng(index).normal(size=points.shape)
    seen = lie.transform(lie.inverse(T_room_lidar), points).astype(np.float32)
    return Scan.of(seen, 1e-9 * stamp_ns, index=index)


@pytest.mark.parametrize("odd_ns", [1_000, -3_600_000_000_000])
def test_a_stamp_that_makes_no_sense_moves_nothing(town, odd_ns):
    scans = [*town.scans]
    scans[30] = replace(scans[30], stamp_ns=scans[29].stamp_ns + odd_ns)
    steps = town.tracked(scans, NO_WHEELS)
    assert {step.state for step in steps} == {State.OK}
    poses = town.truth.poses[0] @ np.array([step.T_odom_lidar for step in steps])
    off_m = np.linalg.norm(lie.between(poses, town.truth.poses[: len(poses)])[:, :3, 3], axis=1)
    assert np.delete(off_m, 30).max() < 0.05


def test_a_covered_lidar_is_lost_and_found_again_and_closures_can_bend_the_edge_over_it(town):
    slam, scans = Slam(configured(3), town.T_base_lidar), [*town.scans]
    scans[30:33] = [replace(scan, points=0.001 * scan.points) for scan in scans[30:33]]
    steps = [slam.process(scan) for scan in scans]
    assert [step.state for step in steps[29:34]] == [State.OK, *[State.LOST] * 3, State.OK]
    assert "preprocess.min_range_m (0.5)" in steps[31].reason
    result = slam.finish()
    assert ate_m(result.odometry, town.truth) < 0.05
    after = next(keyframe.index for keyframe in result.keyframes if keyframe.scan_index >= 33)
    sigma_m = [np.sqrt(np.linalg.inv(information)[0, 0]) for information in result.graph.information]
    assert sigma_m[after - 1] > 0.5 and max(sigma_m[: after - 1] + sigma_m[after:]) < 0.1


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


def covariances(dimension, information, scans):
    """Of the motion since the keyframe, after scans 0.1 m apart: (fit, whether it is measured, state, error)."""
    front_end = FrontEnd(configured(dimension, {"odometry.keyframe_distance_m": 100.0}), np.eye(dimension + 1))
    nothing, k, told = np.empty((0, dimension)), len(information), []
    for index, (fit, is_measured, state, off) in enumerate(scans):
        T = lie.pose_2d(0.1 * index, 0.0, 0.0)
        T = T if dimension == 2 else lie.lift(T)
        prior = Prior(T @ lie.exp(off), 1e-4 * np.eye(k), np.ones(k), is_measured)
        match = first_match(T, np.zeros((9, dimension)), configured(dimension).matching)
        match = replace(match, information=information, fit=fit)
        tracked = Tracked(None, nothing, nothing, T, match, state, "", prior, 0.0, 0.0, 0.0)
        front_end.odometry.process = lambda scan, tracked=tracked: tracked
        front_end.locate(None)
        told.append(np.linalg.inv(front_end.information + 1e-9 * np.eye(k)))
    return np.array(told)


def test_where_scans_see_nothing_along_uncertainty_grows_over_those_without_a_wheel_reading_too():
    def sigmas_m(is_read):
        scans = [(1.0, each, State.DEGENERATE, np.zeros(3)) for each in is_read]
        return np.sqrt(covariances(2, np.diag([0.0, 1e6, 1e6]), scans)[:, 0, 0])

    scan = np.arange(24)
    whole, holed, without = (
        sigmas_m(read) for read in (scan > 0, (scan > 0) & ((scan < 5) | (scan > 14)), scan == 9)
    )
    assert np.allclose(whole[1:], 0.01 * scan[1:], rtol=1e-3) and np.allclose(holed, whole)
    assert (without > 1e4).all()  # what came before the first reading is unknown up to the next keyframe


@pytest.mark.parametrize("is_measured", [True, False])
def test_a_motion_over_a_scan_that_correspondences_contradict_is_known_as_predicted(is_measured):
    off = np.array([0.0, 0.4, 0.0, 0.0, 0.0, 0.1])
    scans = [(fit, is_measured, State.OK, off) for fit in (1.0, 1.0, 0.5, 1.0)]
    sigmas = np.sqrt(np.diagonal(covariances(3, 1e6 * np.eye(6), scans), axis1=1, axis2=2))
    assert np.all(sigmas[:2] <= 1e-3 * (1.0 + 1e-9))
    assert np.allclose(sigmas[2:], np.hypot(np.abs(off), 0.01), atol=0.02) and sigmas[3, 0] > 0.009


def test_in_a_blank_corridor_the_wheels_lead_along_it_and_the_scans_across():
    """From the ninth second on its ends are out of sight."""
    corridor = Drive.of(made.log("corridor", seconds=18, seed=3, sensor="vlp-16"))
    steps = corridor.tracked()
    blind = [step for step in steps[90:] if step.state is State.DEGENERATE]
    along = [abs(step.match.degeneracy_direction[0]) > np.cos(np.radians(5.0)) for step in blind]
    assert len(blind) > 0.95 * len(steps[90:]) and np.mean(along) > 0.95
    assert sum(step.state is State.DEGENERATE for step in steps[:80]) < 5
    assert corridor.error_m(steps) < 0.15


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("preprocess.max_range_m", 0.06, r"scan 0 has none of its \d+ points .*; give meters, or widen"),
        ("odometry.prior", "wheel", "scan 1 has no wheel odometry"),
    ],
)
def test_what_cannot_be_tracked_is_named(office, key, value, words):
    with pytest.raises(InputError, match=words):
        office.tracked([replace(scan, T_odom_base=None) for scan in office.scans[:3]], {key: value})
    with pytest.raises(InputError, match="the first one, has no points; begin with one that has some"):
        Odometry(dimension=3).process(Scan.of(np.empty((0, 3)), 0.0))


def test_without_loops_the_world_is_the_odometry_frame(office):
    slam = Slam(configured(2, {"loops.enabled": False}), office.T_base_lidar)
    for scan in office.scans[:100]:
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


@pytest.mark.parametrize(("early", "apart_ns"), [(1, 1_000_000), (3, 1_000), (6, 1_000_000)])
@in_both
def test_a_burst_at_the_start_of_a_log_is_no_usual_interval(drive, early, apart_ns):
    usual, burst = drive.scans[:50], drive.scans[:50]
    for k, scan in enumerate(usual[:early]):
        late_ns = usual[early].stamp_ns - (early - k) * apart_ns - scan.stamp_ns
        burst[k] = replace(scan, stamp_ns=scan.stamp_ns + late_ns, log_time_ns=scan.log_time_ns + late_ns)
    for timed in (lambda scan: scan, lambda scan: replace(scan, times_s=scan.times_s[:0])):
        steps, wanted = drive.tracked(map(timed, burst)), drive.tracked(map(timed, usual))
        assert lie.apart(steps[-1].T_odom_lidar, wanted[-1].T_odom_lidar)[0] < 0.03
        assert State.LOST not in {step.state for step in steps}


@pytest.mark.parametrize("late_ns", [1_000, 20_000_000])
@in_both
def test_a_scan_that_is_logged_twice_changes_no_pose(drive, late_ns):
    scans = drive.scans[:40]
    twice = [each for scan in scans for each in (scan, replace(scan, log_time_ns=scan.log_time_ns + late_ns))]
    steps = drive.tracked(twice)
    for step, copy, expected in zip(steps[::2], steps[1::2], drive.tracked(scans), strict=True):
        assert np.array_equal(step.T_odom_lidar, expected.T_odom_lidar)
        assert np.array_equal(copy.T_odom_lidar, expected.T_odom_lidar)
        assert copy.is_repeated and copy.scan.is_copy and "copy of the previous scan" in copy.reason


def test_a_driver_that_is_given_the_same_cloud_says_so(town):
    first, second = town.scans[:2]
    odometry, buffer = Odometry(configured(3), town.T_base_lidar), first.points.copy()
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
@in_both
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


@pytest.mark.parametrize(("jump_m", "lasts"), [(0.6, True), (3.0, False), (100.0, True), (1e6, False)])
def test_a_jump_of_the_wheels_that_the_scans_contradict_is_left_out(office, jump_m, lasts):
    jumped = office.scans[:60]
    for index in range(30, 60 if lasts else 31):
        T_jump = np.eye(3) + jump_m * np.outer([1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
        jumped[index] = replace(jumped[index], T_odom_base=T_jump @ jumped[index].T_odom_base)
    odometry = Odometry(configured(2), office.T_base_lidar)
    steps, usual = [odometry.process(scan) for scan in jumped], office.tracked(office.scans[:60])
    assert lie.apart(steps[-1].T_odom_lidar, usual[-1].T_odom_lidar)[0] < 0.02
    if jump_m > 1.0:
        (line,) = odometry.predictor.wheels.warnings()
        assert f"jumps by up to {jump_m:.3g} m" in line and "left out at 1 scan (the first: scan 30)" in line
        assert [step.scan.index for step in steps if step.scan.T_odom_base is None] == [30]
