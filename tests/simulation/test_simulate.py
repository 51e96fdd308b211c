"""Simulated sequences: the truth is true, the log says what the sensor saw, the same seed gives the same bytes."""

import html
import re
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader

import scanchain
from scanchain import catalog, lie
from scanchain.__main__ import main
from scanchain.errors import InputError
from scanchain.evaluation import path_length
from scanchain.kernels.raycast import BOX, CYLINDER, ELLIPSOID
from scanchain.settings import shipped
from scanchain.simulation import NO_SLIP, SENSORS, WORLDS, Slip, plan, record, simulate
from scanchain.simulation.motion import wheel_odometry
from scanchain.simulation.sensors import take_sweep
from scanchain.simulation.solids import FIXED, Solids
from scanchain.simulation.worlds.indoor import CORRIDOR, CORRIDOR_STRUCTURE_M
from scanchain.trajectory import read_tum
from tests.support import naive_raycast
from tests.support.naive_logs import decoded

LIDARS = [name for name, sensor in SENSORS.items() if sensor.dimension == 3]


@cache
def planned(name, sensor, seed=0):
    """A drive of the world's usual length, without noise and losses."""
    return plan(name, sensor=sensor, seed=seed, noise_m=0.0, dropout=0.0)


def swept(drive, index):
    """A scan of a planned drive."""
    start_s = index * drive.sensor.period_ns * 1e-9
    return take_sweep(drive.solids, drive.motion, drive.sensor, index, start_s, np.random.default_rng(0))


def messages(path, topic):
    return [(message, contents) for _, _, message, contents in decoded(path, [topic])]


def nanoseconds(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


SMOOTH = np.array([-3.0, 0.9, 0.08, 1.0, 0.7, 0.11, 2.0])
ROUGH = np.concatenate([SMOOTH, [0.15, 0.5, 0.4, 1.0], [-0.1, -0.9, 0.5, 0.3]])


def random_solids(rng, ground=SMOOTH):
    yaw = rng.uniform(-np.pi, np.pi, 30)
    places = rng.uniform(-40.0, 40.0, (30, 2))
    bottom = rng.uniform(-3.0, 3.0, 30)
    height = rng.uniform(0.5, 6.0, 30)
    size = rng.uniform(0.1, 6.0, (30, 3))
    kind, upright = np.ones((30, 1)), np.tile([1.0, 0.0], (30, 1))
    groups = (
        (BOX * kind, places, size[:, :2], np.cos(yaw), np.sin(yaw), bottom, bottom + height),
        (CYLINDER * kind, places[::-1] + 3.0, size[:, [0, 0]], upright, bottom, bottom + height),
        (ELLIPSOID * kind, places[:, ::-1], size[:, :2], upright, bottom, size[:, 2]),
    )
    return Solids(np.vstack([np.column_stack(each) for each in groups]), np.full(90, FIXED), ground)


@pytest.mark.parametrize(("seed", "ground"), [(0, SMOOTH), (1, SMOOTH), (4, ROUGH), (5, ROUGH)])
def test_the_kernel_equals_the_naive_ray_caster(seed, ground):
    rng = np.random.default_rng(seed)
    solids = random_solids(rng, ground)
    poses = lie.exp(np.column_stack([rng.uniform(-0.8, 0.8, (20, 3)), rng.normal(0.0, 0.1, (20, 3))]))
    directions = rng.normal(size=(250, 3)) * [1.0, 1.0, 0.25]
    directions[0], directions[1], directions[2] = [0, 0, 1], [0, 0, -1], [1, 0, 0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    pose_of_ray = rng.integers(0, 20, 250).astype(np.int32)
    fast = solids.cast(poses, pose_of_ray, directions, 50.0)
    naive = np.array([
        naive_raycast.cast(poses[p, :3, 3], poses[p, :3, :3] @ d, solids, 50.0)
        for p, d in zip(pose_of_ray, directions, strict=True)
    ])  # fmt: skip
    assert 60 < np.isfinite(naive).sum() < 250  # the test sees both hits and misses
    assert np.array_equal(np.isfinite(fast), np.isfinite(naive))
    assert np.allclose(fast, naive, atol=1e-7, rtol=0.0)


@pytest.mark.parametrize("name", [name for name in WORLDS if name not in ("staircase", "garage", "gap")])
@pytest.mark.parametrize("seed", range(2))
def test_the_path_crosses_no_wall_and_no_furniture(name, seed):
    drive = plan(name, seed=seed, duration_s=120.0)
    places = drive.motion.base(np.arange(0.0, 120.0, 0.05 if name in ("office", "town") else 0.2))[:, :2, 3]
    assert drive.solids.clearance_m(places, below_m=2.0).min() > WORLDS[name].vehicle.radius_m + 0.05


@pytest.mark.parametrize("name", ["office", "town"])
def test_the_drive_starts_from_standstill_within_the_limits_of_the_vehicle(name):
    motion = planned(name, "vlp-16").motion
    vehicle, step = WORLDS[name].vehicle, 1e-3
    times = np.arange(0.0, 50.0, step)
    poses = motion.base(times)
    speed = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1) / step
    assert speed[0] < 1e-3 and 0.9 * vehicle.speed_m_s < speed.max() < 1.01 * vehicle.speed_m_s
    assert np.abs(np.diff(speed)).max() / step < 1.5 * vehicle.acceleration_m_s2
    assert np.abs(lie.wrap(np.diff(lie.yaw(poses)))).max() / step > 0.5  # it does turn
    above_m = poses[:, 2, 3] - planned(name, "vlp-16").solids.ground_height(poses[:, :2, 3])
    assert np.abs(above_m).max() <= 1.1 * vehicle.heave_m
    assert np.ptp(poses[:, 2, 3]) > 0.3 or name == "office"


@pytest.mark.parametrize("name", WORLDS)
def test_the_motion_is_smooth(name):
    motion, step = planned(name, "vlp-16").motion, 1e-3
    poses = motion.lidar(np.arange(0.0, min(WORLDS[name].duration_s, 60.0), step))
    rates = lie.log(lie.inverse(poses[:-1]) @ poses[1:]) / step
    change = np.abs(np.diff(rates, axis=0)).max(axis=0)  # within a millisecond
    assert change[:3].max() < 0.01 and change[3:].max() < 0.02


def test_the_rounds_pass_streets_again_in_both_directions_and_in_the_other_lane():
    poses = planned("rounds", "vlp-16").truth().poses[::5]
    traveled_m = path_length(poses)
    same = opposite = aside = 0
    for k, T in enumerate(poses):
        old = poses[traveled_m < traveled_m[k] - 100.0]
        place = lie.inverse(T) @ old
        near = (np.abs(place[:, 0, 3]) < 3.0) & (np.abs(place[:, 1, 3]) < 6.0)
        ahead = place[near, 0, 0]
        same += np.any(ahead > 0.9)
        opposite += np.any(ahead < -0.9)
        aside += np.any((ahead > 0.9) & (np.abs(place[near, 1, 3]) > 3.0))
    assert min(same, opposite, aside) > 30  # of some 320 places


def test_a_route_is_driven_the_other_way_round_from_any_point_of_it():
    there = plan("town", seed=3, duration_s=80.0).truth().poses
    back = plan("town", seed=3, duration_s=20.0, changed=1, reverse=True, start_m=100.0).truth().poses
    away_m = np.linalg.norm(back[:, None, :2, 3] - there[:, :2, 3], axis=2)
    assert away_m.min(axis=1).max() < 4.0
    along = there[away_m.argmin(axis=1), :3, 0] * back[:, :3, 0]
    assert np.median(along.sum(axis=1)) < -0.9
    assert np.linalg.norm(back[0, :2, 3] - there[0, :2, 3]) > 30.0


def test_all_rooms_of_the_identical_floor_look_the_same():
    drive = plan("identical", noise_m=0.0, dropout=0.0)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = [[2.5, 4.0, 0.3], [17.5, 32.0, 0.3], [32.5, 10.0, 0.3]]
    poses[2, :2, :2] *= -1.0  # the rooms south of a corridor are turned by half
    rays = drive.sensor.rays(0)
    rooms = [
        drive.solids.cast(T[None], np.zeros(len(rays.directions), np.int32), rays.directions, 2.9) for T in poses
    ]
    assert np.isfinite(rooms[0]).sum() > 100
    np.testing.assert_allclose(rooms[1], rooms[0], atol=1e-9)
    np.testing.assert_allclose(rooms[2], rooms[0], atol=1e-9)


def test_turns_are_made_on_the_spot_at_120_degrees_a_second():
    motion = planned("turns", "vlp-16").motion
    times = np.arange(0.0, 40.0, 0.01)
    poses = motion.base(times)
    rate = np.rad2deg(lie.wrap(np.diff(lie.yaw(poses))) / 0.01)
    assert rate.max() == pytest.approx(120.0, abs=1.0) and rate.min() == pytest.approx(-120.0, abs=1.0)
    turning = np.abs(rate) > 5.0
    moved_m = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)
    assert turning.mean() > 0.25 and moved_m[turning].max() < 1e-6
    assert np.linalg.norm(poses[:, :2, 3], axis=1).max() < 5.0


def test_at_another_pace_the_same_poses_are_passed_sooner():
    usual, fast = planned("turns", "vlp-16"), plan("turns", sensor="vlp-16", pace=200.0 / 120.0)
    times = np.arange(0.0, 20.0, 0.01)
    poses, sooner = (
        lie.flatten(drive.motion.base(times * pace)) for drive, pace in ((usual, 5.0 / 3.0), (fast, 1.0))
    )
    assert np.allclose(poses, sooner, atol=0.01)  # the body sways as often
    rate = np.rad2deg(lie.wrap(np.diff(lie.yaw(sooner))) / 0.01)
    assert np.abs(rate).max() == pytest.approx(200.0, abs=2.0)
    assert len(fast.scans) == len(usual.scans)


def test_the_car_of_the_garage_stands_on_two_floors_and_pitches_on_the_ramp_between():
    drive = planned("garage", "vlp-16")
    poses = drive.motion.base(np.arange(0.0, 90.0, 0.2))
    above = poses.copy()
    above[:, :3, :3], above[:, 2, 3] = np.eye(3), poses[:, 2, 3] + 1.0
    down = np.tile([0.0, 0.0, -1.0], (len(poses), 1))
    below_m = drive.solids.cast(above, np.arange(len(poses), dtype=np.int32), down, 5.0)
    np.testing.assert_allclose(below_m, 1.0, atol=0.15)  # bends are rounded over 3 m
    heights_m, slopes = poses[:, 2, 3], poses[:, 2, 0]
    assert (np.abs(heights_m) < 0.02).mean() > 0.3 and (np.abs(heights_m - 3.3) < 0.02).mean() > 0.3
    assert slopes.max() > 0.9 * 3.3 / 36.0 and slopes.min() < -0.9 * 3.3 / 36.0
    walls = drive.solids.part(drive.solids.rows[:, 4] > 10.0)
    assert walls.part(walls.rows[:, 3] < 1.0).clearance_m(poses[:, :2, 3], below_m=2.0).min() > 1.0


def test_the_staircase_is_climbed_with_a_swaying_hand():
    drive = planned("staircase", "vlp-16")
    poses = drive.motion.lidar(np.arange(0.0, 40.0, 0.05))
    assert np.ptp(poses[:, 2, 3]) > 6.0
    assert np.abs(poses[:, 2, :2]).max() > 0.03  # rolls and pitches
    assert np.ptp(np.unwrap(lie.yaw(poses))) > 4.0 * np.pi  # turns the same way on every landing
    for seed in range(3):
        path = planned("staircase", "vlp-16", seed)
        places = path.motion.lidar(np.arange(0.0, 40.0, 0.2))[:, :3, 3]
        assert naive_raycast.distance_to_surface(places, path.solids).min() > 0.3


def test_the_gap_lacks_one_second_twice_while_wheel_odometry_goes_on_and_log_time_never_steps_back(tmp_path):
    path = tmp_path / "a.mcap"
    truth = simulate("gap", path, sensor="lms-270")
    steps_ns = np.diff(truth.stamps_ns)
    gaps = np.flatnonzero(steps_ns > 100_000_000)
    assert steps_ns[gaps].tolist() == [1_100_000_000] * 2 and set(np.delete(steps_ns, gaps)) == {100_000_000}
    turns_rad = np.abs(lie.wrap(np.diff(lie.yaw(truth.poses))))[gaps]
    assert turns_rad[0] > 0.4 and turns_rad[1] < 0.05  # one in a bend, one on a straight
    with path.open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages(log_time_order=False)]
    assert times == sorted(times)
    stamps_ns = [nanoseconds(odometry) for _, odometry in messages(path, "/odom")]
    assert set(np.diff(stamps_ns)) == {20_000_000} and stamps_ns[-1] - stamps_ns[0] == 30_000_000_000
    assert [nanoseconds(scan) for _, scan in messages(path, "/scan")] == truth.stamps_ns.tolist()


def seen_from(drive, index, twists):
    """Ranges of a scan without noise from where the lidar is, moved by each twist (K, 6) in the world's axes."""
    rays, T = drive.sensor.rays(index), drive.motion.lidar(np.array([index * 0.1]))[0]
    moved = T.copy()[None].repeat(len(twists), axis=0)
    moved[:, :3, :3] = lie.exp(twists)[:, :3, :3] @ T[:3, :3]
    moved[:, :3, 3] += twists[:, :3]
    standing = np.zeros(len(rays.directions), np.int32)
    return T, [
        drive.solids.cast(each[None], standing, rays.directions, drive.sensor.max_range_m) for each in moved
    ]


@pytest.mark.parametrize("sensor", LIDARS)
def test_motion_along_the_middle_of_the_corridor_changes_no_range(sensor):
    drive, seen = planned("corridor", sensor), set()
    bare_m = CORRIDOR_STRUCTURE_M + WORLDS["corridor"].sight_m + 0.5
    for scan in range(0, 400, 40):
        T, (here, along, across) = seen_from(drive, scan, np.eye(6)[[0, 0, 1]] * [[0.0], [0.5], [0.2]])
        if bare_m < T[0, 3] < CORRIDOR.length_m - bare_m:
            assert np.allclose(along, here, atol=1e-9) and not np.allclose(across, here, atol=0.1)
            seen.add("middle")
        elif T[0, 3] > CORRIDOR.length_m - 12.0:
            assert not np.allclose(along, here, atol=0.1)
            seen.add("end")
    assert seen == {"middle", "end"}


@pytest.mark.parametrize("sensor", LIDARS)
def test_place_and_heading_change_no_range_in_the_field_where_no_pole_is_in_sight(sensor):
    drive, seen = planned("field", sensor), set()
    poles, sight_m = drive.solids.rows[:, 1:3], WORLDS["field"].sight_m  # there is nothing else
    for scan in range(0, 400, 20):
        T, (here, *moved) = seen_from(drive, scan, np.eye(6)[[0, 0, 1, 5]] * [[0.0], [0.5], [0.5], [0.1]])
        offsets = (poles - T[:2, 3]) @ T[:2, :2]  # ahead, to the left
        if np.linalg.norm(offsets, axis=1).min() > sight_m + 1.0:
            assert all(np.allclose(each, here, atol=1e-9) for each in moved)
            seen.add("none")
        ahead, left = offsets.T
        if np.any((ahead > 20.0) & (ahead < 40.0) & (np.abs(left) < 0.3 * ahead)):
            assert not any(np.allclose(each, here, atol=0.1) for each in moved)
            seen.add("poles")
    assert seen == {"none", "poles"}


@pytest.mark.parametrize(
    ("world", "sensor"),
    [("office", "lms-270"), ("office", "utm-30"), ("office", "vlp-16"), ("town", "hdl-64"), ("town", "os1-32"),
     ("town", "vlp-16"), ("town", "rosette"), ("rounds", "os1-32"), ("identical", "os1-32"), ("highway", "hdl-64"),
     ("corridor", "rosette"), ("field", "vlp-16"), ("forest", "os1-32"), ("staircase", "hdl-64"),
     ("hall", "rosette"), ("turns", "os1-32")],
)  # fmt: skip
def test_undistorted_with_the_truth_every_point_lies_on_the_first_surface(world, sensor):
    drive, index = planned(world, sensor), 123
    start_s = index * drive.sensor.period_ns * 1e-9
    sweep = swept(drive, index)
    poses = drive.motion.lidar(start_s + sweep.rays.instants_ns * 1e-9)[sweep.rays.instant_of_ray]
    at = poses[sweep.returned]
    points = np.einsum("nij,nj->ni", at[:, :3, :3], sweep.points().astype(np.float64)) + at[:, :3, 3]
    random = np.random.default_rng(1)
    some = random.choice(len(points), min(len(points), 1500), replace=False)
    assert len(points) > (0.4 if world == "field" else 0.5) * len(sweep.ranges_m)
    assert naive_raycast.distance_to_surface(points[some], drive.solids).max() < 1e-5
    few, reach_m = random.choice(len(poses), 8, replace=False), drive.sensor.max_range_m
    naive = np.array([
        naive_raycast.cast(poses[k, :3, 3], poses[k, :3, :3] @ sweep.rays.directions[k], drive.solids, reach_m)
        for k in few
    ])  # fmt: skip
    naive[naive < drive.sensor.min_range_m] = np.inf
    assert np.allclose(sweep.ranges_m[few], naive, atol=1e-6, rtol=0.0)


@pytest.mark.parametrize("name", SENSORS)
def test_rays_are_unit_vectors_fired_in_order_within_the_period(name):
    sensor = SENSORS[name]
    rays = sensor.rays(3)
    assert np.allclose(np.linalg.norm(rays.directions, axis=1), 1.0)
    times = rays.instants_ns[rays.instant_of_ray]
    assert times[0] == 0 and np.all(np.diff(times) >= 0) and times[-1] < sensor.period_ns
    assert np.array_equal(rays.directions, sensor.rays(4).directions) == (name != "rosette")


def test_noise_and_losses_are_as_large_as_asked_for():
    drive = planned("town", "hdl-64")
    sensor = replace(drive.sensor, noise_m=0.05, dropout=0.1)
    clean, noisy = swept(drive, 200), swept(replace(drive, sensor=sensor), 200)
    both = clean.returned & noisy.returned
    assert both.sum() / clean.returned.sum() == pytest.approx(0.9, abs=0.01)
    assert np.std(noisy.ranges_m[both] - clean.ranges_m[both]) == pytest.approx(0.05, rel=0.02)


@pytest.mark.parametrize("name", ["office", "town"])
def test_wheel_odometry_is_the_planar_truth_without_drift_and_drifts_more_the_larger_the_drift(name):
    poses = planned(name, "vlp-16").motion.base(np.arange(0.0, 60.0, 0.02))
    planar = lie.flatten(poses)
    truth = lie.inverse(planar[0]) @ planar
    length = np.linalg.norm(np.diff(truth[:, :2, 2], axis=0), axis=1).sum()
    errors = []
    for drift in (0.0, 0.3, 1.0, 3.0):
        odometry = wheel_odometry(poses, drift=drift, rng=np.random.default_rng(5))
        errors.append(np.abs(odometry - truth).max() / length)
    assert errors[0] < 1e-9 < errors[1] < errors[2] < errors[3]
    assert 0.002 < errors[2] < 0.1


def test_wheels_slip_once_between_two_seconds_and_nowhere_else(tmp_path):
    steps_m = {}
    for name, slip in (("straight", NO_SLIP), ("slips", Slip(2.0, 3.0, 1.5)), ("stands", Slip(2.0, 3.0, -0.4))):
        simulate("office", tmp_path / f"{name}.mcap", duration_s=4.0, drift=0.0, wheels_slip=slip)
        places = [each.pose.pose.position for _, each in messages(tmp_path / f"{name}.mcap", "/odom")]
        steps_m[name] = np.hypot(*np.diff([(place.x, place.y) for place in places], axis=0).T)
    for name, size_m in (("slips", 1.5), ("stands", -0.4)):
        more_m = steps_m[name] - steps_m["straight"]
        assert more_m[100:150].sum() == pytest.approx(size_m, abs=0.05)
        assert np.abs(more_m[:99]).max() < 1e-6 and np.abs(more_m[151:]).max() < 1e-6


def test_late_wheels_report_at_each_stamp_what_was_before_it(tmp_path):
    places = []
    for name, delay_s in (("on_time", 0.0), ("late", 0.1)):
        simulate("office", tmp_path / f"{name}.mcap", duration_s=4.0, drift=0.0, wheels_delay_s=delay_s)
        found = [each.pose.pose.position for _, each in messages(tmp_path / f"{name}.mcap", "/odom")]
        places.append(np.array([(place.x, place.y) for place in found]))
    np.testing.assert_allclose(np.diff(places[1][5:], axis=0), np.diff(places[0][:-5], axis=0), atol=1e-6)


def test_wheels_that_slip_are_found_in_space_as_in_the_plane(tmp_path):
    simulate("town", tmp_path / "a.mcap", duration_s=15.0, sensor="vlp-16", wheels_slip=Slip(8.0, 10.0, 15.0))
    reason = scanchain.run(tmp_path / "a.mcap", tmp_path / "run", recording=False).metrics.verdict_reason
    start_s, end_s, size_m = map(
        float, re.findall(r"\(([\d.]+) to ([\d.]+) s\): wheels disagree by ([\d.]+) m", reason)[0]
    )
    assert 7.5 < start_s < 8.5 and 9.5 < end_s < 10.5 and 2.0 < size_m < 4.0


@pytest.mark.slow
def test_wheels_that_slip_are_named_and_doubt_no_run_that_closes_loops_around(tmp_path):
    code = main(
        ["simulate", "office", str(tmp_path / "a.mcap"), "--duration", "60", "--wheels-slip", "20", "24", "6"]
    )
    metrics = scanchain.run(tmp_path / "a.mcap", tmp_path / "run", recording=False).metrics
    assert code == 0 and metrics.verdict == "trustworthy" and metrics.segments == ()
    start_s, end_s, size_m = map(
        float, re.findall(r"wheels slip at ([\d.]+) to ([\d.]+) s \(([\d.]+) m\)", metrics.verdict_reason)[0]
    )
    assert 19.0 < start_s < 21.0 and 23.0 < end_s < 25.0 and 4.0 < size_m < 6.5
    stated = metrics.ground_truth.optimized.kitti_definition
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "segments of 10, 20, 40 m from every pose" in stated and stated in html.unescape(page)


@pytest.mark.parametrize("world", WORLDS)
def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path, world):
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        sensor = "lms-270" if world == "office" else "vlp-16"
        simulate(world, tmp_path / f"{name}.mcap", seed=seed, duration_s=0.3, sensor=sensor)
    for suffix in (".mcap", ".tum"):
        first, same, other = ((tmp_path / f"{name}{suffix}").read_bytes() for name in "abc")
        assert first == same and (
            first != other or (suffix, world) == (".tum", "hall")
        )  # where it stands at first


def test_an_office_log_reads_back(tmp_path):
    seen, path = [], tmp_path / "office.mcap"
    options = {"duration_s": 4.0, "noise_m": 0.0, "dropout": 0.0}
    truth = simulate("office", path, progress=lambda *done: seen.append(done), **options)
    assert seen == [(count + 1, 40) for count in range(40)]
    assert truth.poses.shape == (40, 3, 3)
    scans, poses = messages(path, "/scan"), messages(path, "/ground_truth")
    for read in (scans, poses):
        assert [nanoseconds(each) for _, each in read] == truth.stamps_ns.tolist()
    assert [record.log_time - nanoseconds(scan) for record, scan in scans] == [100_000_000] * 40
    stated = [pose.pose.pose for _, pose in poses]
    flat = [(p.position.x, p.position.y, 2.0 * np.arctan2(p.orientation.z, p.orientation.w)) for p in stated]
    assert np.allclose([lie.pose_2d(*pose) for pose in flat], truth.poses, atol=1e-9)

    scan = scans[0][1]  # the robot stands still
    angles = scan.angle_min + np.arange(len(scan.ranges)) * scan.angle_increment
    assert (len(angles), scan.range_max) == (541, 30.0)
    assert np.rad2deg([scan.angle_min, scan.angle_max]) == pytest.approx([-135.0, 135.0], abs=1e-3)
    assert scan.time_increment * 720 == pytest.approx(0.1)
    ranges = np.array(scan.ranges)
    flat = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])[np.isfinite(ranges)]
    height_m = WORLDS["office"].vehicle.T_base_lidar[2, 3]
    lifted = np.pad(lie.transform(truth.poses[0], flat), ((0, 0), (0, 1)), constant_values=height_m)
    assert naive_raycast.distance_to_surface(lifted, plan("office").solids).max() < 2e-5


def test_a_town_log_reads_back(tmp_path):
    path = tmp_path / "town.mcap"
    truth = simulate("town", path, duration_s=0.5, sensor="vlp-16")
    assert truth.poses.shape == (5, 4, 4)
    clouds = messages(path, "/points")
    assert [nanoseconds(cloud) for _, cloud in clouds] == truth.stamps_ns.tolist()
    layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4"), ("ring", "<u2")])
    for _, cloud in clouds:
        assert [field.name for field in cloud.fields] == list(layout.names) and cloud.point_step == layout.itemsize
        rows = np.frombuffer(cloud.data, dtype=layout)
        assert rows["t"][0] < 1_000_000 and rows["t"].max() < 100_000_000
        elevation_deg = np.rad2deg(np.arctan2(rows["z"], np.hypot(rows["x"], rows["y"])))
        assert np.allclose(elevation_deg, 2.0 * rows["ring"] - 15.0, atol=1e-3)
    ((_, static),) = messages(path, "/tf_static")
    assert static.transforms[0].transform.translation.z == 1.73
    stamps = [nanoseconds(odometry) for _, odometry in messages(path, "/odom")]
    assert stamps == list(range(truth.stamps_ns[0], truth.stamps_ns[0] + 500_000_001, 20_000_000))
    written = read_tum(tmp_path / "town.tum")
    assert np.array_equal(written.stamps_ns, truth.stamps_ns) and np.allclose(
        written.poses, truth.poses, atol=1e-8
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"world": "moon"}, "choose one of office, town"),
        ({"sensor": "sonar"}, "choose one of lms-270"),
        ({"duration_s": 0.0}, "duration_s 0 is out of range"),
        ({"duration_s": float("nan")}, "duration_s nan"),
        ({"drift": float("inf")}, "drift inf"),
        ({"drift": -1.0}, "drift -1 is out of range"),
        ({"dropout": 1.5}, "choose one from 0 to 1"),
        ({"noise_m": float("nan")}, "noise_m nan"),
        ({"seed": -1}, "seed -1"),
        ({"pace": 0.0}, "pace 0 is out of range"),
        ({"start_m": -1.0}, "start_m -1 is out of range"),
        ({"world": "turns", "reverse": True}, "turns has no closed route"),
        ({"wheels_slip": Slip(3.0, 2.0, 1.0)}, "wheels_slip from 3 to 2 s"),
        ({"wheels_delay_s": 11.0}, "wheels_delay_s 11 is out of range; choose one from -10 to 10"),
    ],
)
def test_a_wrong_argument_is_one_line_and_leaves_no_file(tmp_path, arguments, message):
    world = arguments.pop("world", "office")
    with pytest.raises(InputError, match=message) as caught:
        simulate(world, tmp_path / "a.mcap", **{"duration_s": 1.0, **arguments})
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("existing", ["a.mcap", "a.tum"])
def test_nothing_is_overwritten_without_force(tmp_path, existing):
    (tmp_path / existing).write_text("precious")
    with pytest.raises(InputError, match="exists"):
        simulate("office", tmp_path / "a.mcap", duration_s=0.2)
    assert (tmp_path / existing).read_text() == "precious"
    simulate("office", tmp_path / "a.mcap", duration_s=0.2, force=True)


def test_every_sequence_of_the_catalog_can_be_read_and_others_or_a_misspelt_key_are_refused(tmp_path, monkeypatch):
    assert {"office", "town", "demo-office", "demo-town", "intel", "kitti"} <= set(catalog.names())
    for name in catalog.names():
        source = catalog.load(name).source
        if isinstance(source, catalog.Simulated):
            assert source.world in WORLDS and source.sensor in SENSORS
    with pytest.raises(InputError, match="demo-office, demo-town"):
        catalog.load("mars")
    text = (shipped("sequences") / "office.toml").read_text()
    (tmp_path / "office.toml").write_text(text.replace("seed", "sede"))
    monkeypatch.setattr(catalog, "shipped", lambda folder: tmp_path)
    with pytest.raises(InputError, match="sede"):
        catalog.load("office")


def test_a_simulated_sequence_is_made_once(tmp_path, monkeypatch):
    short = catalog.Simulated(world="office", sensor="lms-270", seed=0, duration_s=0.5)
    sequence = catalog.load("demo-office")
    monkeypatch.setattr(catalog, "load", lambda name: msgspec.structs.replace(sequence, source=short))
    path = catalog.prepare("demo-office", tmp_path)
    assert path == tmp_path / "demo-office.mcap" and len(messages(path, "/scan")) == 5
    written = path.stat().st_mtime_ns
    assert catalog.prepare("demo-office", tmp_path).stat().st_mtime_ns == written


def test_another_day_changes_movable_objects_alone_keeps_the_path_free_and_is_listed_beside_the_log(tmp_path):
    first, later = (plan("office", seed=3, duration_s=20.0, changed=changed) for changed in (None, 1))
    assert {change.kind for change in later.changes} == {"vanished", "moved", "appeared"}
    kept = set(map(tuple, first.solids.rows)) & set(map(tuple, later.solids.rows))
    assert {row[0] for row in kept} == {BOX, CYLINDER, ELLIPSOID}
    fixed = [drive.solids.part(drive.solids.owner == FIXED).rows for drive in (first, later)]
    assert np.array_equal(*fixed)
    path = later.motion.base(np.arange(0.0, 20.0, 0.1))[:, :2, 3]
    assert later.solids.clearance_m(path, 2.0).min() > 0.1
    record(replace(later, scans=later.scans[:10]), tmp_path / "later.mcap")
    lines = (tmp_path / "later.changes.csv").read_text().splitlines()
    assert lines[0].startswith("kind,x_before,") and len(lines) == 1 + len(later.changes)


def test_changes_are_listed_in_the_frame_of_the_map_of_the_first_day():
    first, later = (plan("office", seed=3, duration_s=20.0, changed=changed) for changed in (None, 1))
    first_pose, later_pose = (drive.motion.lidar(np.zeros(1))[0] for drive in (first, later))
    assert not np.allclose(first_pose, later_pose) and not np.allclose(first_pose, np.eye(4))
    gone = [change for change in later.changes if change.kind == "vanished"]
    for change in gone:
        rows = first.solids.part(first.solids.owner == change.owner).rows
        away_m = np.linalg.norm(rows[:, 1:3] - lie.transform(first_pose, change.before)[:2], axis=1)
        assert away_m.max() < 0.5 * np.linalg.norm(change.size_m[:2]) + 1e-6
