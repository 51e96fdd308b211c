"""LaserScan and PointCloud2 in every form that drivers give them."""

import numpy as np
import pytest

from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs import open_log
from tests.support.messages import says
from tests.support.naive_logs import (
    ROS,
    STAMP_NS,
    Said,
    cloud_said,
    laser_points,
    laser_scan,
    odometry,
    odometry_said,
    point_cloud,
    scan_said,
    transforms,
    transforms_said,
    write,
)


def only_scan(folder, said, **config):
    """The one scan of a log that holds one message."""
    (scan,) = open_log([write(folder / "one.mcap", [said])], LogConfig(**config)).scans()
    return scan


def laser(folder, ranges, *, config=None, **options):
    data = laser_scan(STAMP_NS, np.asarray(ranges, np.float64), **options)
    return only_scan(folder, scan_said(STAMP_NS, data), **(config or {}))


def cloud(folder, rows, *, config=None, **options):
    return only_scan(folder, cloud_said(STAMP_NS, point_cloud(STAMP_NS, rows, **options)), **(config or {}))


def distances(scan):
    return np.linalg.norm(scan.points.astype(float), axis=1)


# LaserScan


@pytest.mark.parametrize(("order", "frame", "first", "step"), [("<", "las", -1.0, 0.01), (">", "", 1.5, -0.05)])
def test_a_laser_scan_is_read_in_either_byte_order_and_sense(tmp_path, order, frame, first, step):
    ranges = np.linspace(1.0, 5.0, 50)
    scan = laser(tmp_path, ranges, order=order, frame=frame, beam_s=1e-4, first=first, step=step)
    np.testing.assert_allclose(scan.points, laser_points(ranges, first, step), atol=2e-6)
    np.testing.assert_allclose(scan.times_s, 1e-4 * np.arange(50), rtol=1e-5)
    assert scan.stamp_ns == STAMP_NS and scan.points.dtype == scan.times_s.dtype == np.float32


def test_an_increment_of_zero_follows_from_the_angles_of_both_ends_and_without_these_the_scan_is_malformed(
    tmp_path,
):
    ranges = np.linspace(2.0, 3.0, 101)
    told = [ROS.laser_scan(STAMP_NS, ranges.astype("f4"), first=-1.0, step=step) for step in (0.02, 0.02, 0.0)]
    told[1].angle_increment = 0.0
    usual, unset, degenerate = (ROS.serialize(each, "sensor_msgs/msg/LaserScan") for each in told)
    log = open_log(write(tmp_path / "unset.mcap", [scan_said(STAMP_NS, unset)]))
    (scan,) = log.scans()
    np.testing.assert_allclose(scan.points, only_scan(tmp_path, scan_said(STAMP_NS, usual)).points, atol=1e-6)
    says(str(log.damage), "last beam is at -1.000 rad by angle_increment, 1.000 by angle_max: angle_max used")
    with pytest.raises(InputError, match="0 rad apart"):
        only_scan(tmp_path, scan_said(STAMP_NS, degenerate))


@pytest.mark.parametrize(
    ("step", "last", "is_said"),
    [
        (-0.02, 1.0, True),  # of the other sense
        (0.01, 1.0, True),
        (0.02, 1.04, False),  # one or two beams more or fewer, as of drivers that count ends and steps differently
        (0.02, 0.96, False),
        (0.02, np.nan, False),
    ],
)
def test_angles_that_contradict_each_other_are_told(tmp_path, step, last, is_said):
    message = ROS.laser_scan(STAMP_NS, np.full(101, 2.0, "f4"), first=-1.0, step=step)
    message.angle_max = last
    data = ROS.serialize(message, "sensor_msgs/msg/LaserScan")
    log = open_log(write(tmp_path / "a.mcap", [scan_said(STAMP_NS, data)]))
    list(log.scans())
    assert ("1 of 1 scan of /scan contradict themselves (the first: its last beam" in str(log.damage)) == is_said


@pytest.mark.parametrize(
    ("width", "height", "more"), [(12, 1, "12 more points than height 1 × width 12"), (24, 1, ""), (2, 12, "")]
)
def test_points_beyond_width_and_height_are_told(tmp_path, width, height, more):
    message = ROS.point_cloud(STAMP_NS, random_rows(np.dtype([(name, "<f4") for name in "xyz"])))
    message.width, message.height, message.row_step = width, height, width * message.point_step
    data = ROS.serialize(message, "sensor_msgs/msg/PointCloud2")
    log = open_log(write(tmp_path / "a.mcap", [cloud_said(STAMP_NS, data)]))
    (scan,) = log.scans()
    assert len(scan.points) == width * height - scan.dropped
    assert log.damage == [] if not more else more in str(log.damage)


def test_beams_without_return_are_dropped_with_their_times_and_counted(tmp_path):
    ranges = [np.inf, 1.0, np.nan, 0.0, 2.0, 0.05, 30.0, 35.0, -1.0, 3.0, -np.inf]
    scan = laser(tmp_path, ranges, beam_s=0.25)
    assert distances(scan) == pytest.approx([1.0, 2.0, 3.0])
    assert scan.times_s == pytest.approx([0.25, 1.0, 2.25])
    assert scan.dropped == 8


@pytest.mark.parametrize("step", [1.0, -0.5])
def test_angles_in_degrees_are_refused_and_a_turn_and_a_bit_is_not(tmp_path, step):
    with pytest.raises(InputError, match=r"180 beams, -?\d.* rad apart, cover \d.* turns: degrees\? wanted"):
        laser(tmp_path, np.full(180, 2.0), first=-90.0, step=step)
    assert len(laser(tmp_path, np.full(370, 2.0), first=-np.pi, step=np.radians(1.0)).points) == 370


@pytest.mark.parametrize(
    ("ranges", "limits", "kept"),
    [
        ([1.0, 50.0, 0.0, np.inf], {"low": 0.0, "high": 0.0}, [1.0, 50.0]),
        *(([1.0, 70.0, np.inf], {"high": high}, [1.0, 70.0]) for high in (np.inf, np.nan, -1.0)),
        ([0.5, 0.0, 2.0], {"low": np.nan}, [0.5, 2.0]),
        ([1.0, 81.83, 81.91], {"high": 81.83}, [1.0]),  # the SICK's value for no return
    ],
)
def test_range_limits_of_zero_or_nonsense_are_none(tmp_path, ranges, limits, kept):
    scan = laser(tmp_path, ranges, **limits)
    assert distances(scan) == pytest.approx(kept) and scan.dropped == len(ranges) - len(kept)


# PointCloud2

XYZ = [("x", "f4"), ("y", "f4"), ("z", "f4")]


def random_rows(dtype, count=24, seed=0):
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, np.dtype(dtype))
    for name in rows.dtype.names:
        values = rng.uniform(1.0, 100.0, count)
        rows[name] = values if rows.dtype[name].kind == "f" else np.rint(values)
    return rows


def xyz(rows):
    return np.column_stack([rows[name] for name in "xyz"]).astype(np.float32)


@pytest.mark.parametrize("code", ["f4", "f8", "i1", "u1", "i2", "u2", "i4", "u4"])
@pytest.mark.parametrize(("big", "order"), [(False, "<"), (True, "<"), (True, ">")])
def test_coordinates_of_any_number_type_and_byte_order_are_read(tmp_path, code, big, order):
    sign = ">" if big else "<"
    rows = random_rows([("x", sign + code), ("ring", f"{sign}u2"), ("y", sign + code), ("z", sign + code)])
    scan = cloud(tmp_path, rows, order=order)
    assert np.array_equal(scan.points, xyz(rows))
    assert scan.points.dtype == np.float32 and scan.points.flags.c_contiguous


ROWS = random_rows(XYZ)
SCATTERED = np.dtype({
    "names": ["intensity", "z", "x", "y"],
    "formats": ["f4", "f4", "f4", "f8"],
    "offsets": [3, 7, 21, 11],
    "itemsize": 48,
})  # fmt: skip


@pytest.mark.parametrize(
    ("rows", "options"),
    [
        *((ROWS, {"height": height, "padding": padding}) for height in (1, 4) for padding in (0, 7)),
        (ROWS, {"height": 4, "padding": 5, "data": (5 * b"\xff").join(r.tobytes() for r in ROWS.reshape(4, 6))}),
        (ROWS, {"row_step": 0}),
        (ROWS, {"height": 4, "row_step": 0}),  # Velodyne's driver
        (ROWS, {"height": 4, "row_step": ROWS.nbytes}),  # PointCloud2Modifier::resize(width, height)
        (random_rows(SCATTERED), {}),
        (random_rows([*XYZ, ("inten", "u1")]), {"frame": "inten"}),
    ],
)
def test_rows_may_be_padded_and_fields_lie_anywhere(tmp_path, rows, options):
    assert np.array_equal(cloud(tmp_path, rows, **options).points, xyz(rows))


def test_undefined_and_zero_points_are_dropped_with_their_times_and_counted(tmp_path):
    rows = random_rows([*XYZ, ("time", "f4")], count=8)
    rows["time"] = np.arange(8) * 0.01
    rows["x"][0], rows["y"][2], rows["z"][4] = np.nan, np.inf, -np.inf
    for name in "xyz":
        rows[name][6] = 0.0
    scan = cloud(tmp_path, rows)
    kept = [1, 3, 5, 7]
    assert np.array_equal(scan.points, xyz(rows)[kept]) and scan.dropped == 4
    np.testing.assert_allclose(scan.times_s, rows["time"][kept], atol=1e-7)


@pytest.mark.parametrize(
    ("points", "config", "kept"),
    [
        ([(0, 0, 1), (0, 2, 0), (1e-3, 0, 0)], {}, [0, 1, 2]),  # on an axis is not at zero
        ([(1, 0, 0), (1e300, 0, 0), (1e25, 0, 0)], {}, [0]),  # beyond float32 comes without a warning
        ([(1, 0, 0), (0, 5, 0), (0, 0, 9)], {"min_range_m": 2.0, "max_range_m": 8.0}, [1]),
    ],
)
def test_points_are_kept_by_their_range(tmp_path, points, config, kept):
    rows = np.array(points, dtype=[("x", "f8"), ("y", "f8"), ("z", "f8")])
    scan = cloud(tmp_path, rows, config=config)
    assert np.array_equal(scan.points, np.array(points)[kept].astype(np.float32))
    assert scan.dropped == len(points) - len(kept)


# times of points


RISING_S = np.linspace(0.0, 0.1, 11)


STAMP_S = STAMP_NS * 1e-9


@pytest.mark.parametrize(
    ("name", "code", "values", "expected_s", "within_s"),
    [
        *(
            (name, code, RISING_S if "f" in code else np.rint(RISING_S * 1e9), RISING_S, 1e-7)
            for name in ("t", "time", "timestamp", "offset_time", "time_offset")
            for code in ("<u4", ">u4", "<i4", "<f4", "<f8")
        ),
        *(
            (name, "<i4", np.rint(RISING_S * 1e9), RISING_S, 1e-7)
            for name in ("time_offset_ns", "point_time_offset")
        ),
        *((name, "<f4", RISING_S, RISING_S, 1e-7) for name in ("ts", "stamps", "Time", "scalar_GpsTime", "t_us")),
        ("timestamp", "<u8", STAMP_NS + np.rint(RISING_S * 1e9).astype("u8"), RISING_S, 1e-9),
        ("timestamp", "<f8", STAMP_S + RISING_S, RISING_S, 1e-6),
        ("timestamp", "<f8", STAMP_NS + RISING_S * 1e9, RISING_S, 1e-6),
        *(("timestamp", "<f8", STAMP_S + off_s + RISING_S, RISING_S, 1e-6) for off_s in (37.0, -37.0, 1800.0)),
        ("time", "<f4", RISING_S - 0.1, RISING_S - 0.1, 1e-7),
        ("timestamp", "<f8", STAMP_S + RISING_S - 0.1, RISING_S - 0.1, 1e-6),
        ("t", "<f8", RISING_S * 1e9, RISING_S, 1e-7),
        ("time", "<f4", RISING_S * 1e9, RISING_S, 1e-7),
        ("t", "<u4", RISING_S * 1e3, RISING_S, 1e-3),
        ("timestamp", "<f4", np.full(11, STAMP_S), [], 0.0),  # which a float32 does not tell apart
        ("t", "<u4", np.zeros(5), [], 0.0),
    ],
)
def test_the_unit_and_the_origin_of_times_are_those_that_their_values_suggest(
    tmp_path, name, code, values, expected_s, within_s
):
    order = code[0]
    rows = np.ones(len(values), [("x", order + "f4"), ("y", order + "f4"), ("z", order + "f4"), (name, code)])
    rows[name] = values
    times_s = cloud(tmp_path, rows).times_s
    assert times_s.dtype == np.float32
    np.testing.assert_allclose(times_s, expected_s, atol=within_s)


def test_of_several_fields_with_times_the_likeliest_that_varies_is_read_and_one_of_another_name_is_none(tmp_path):
    rows = np.ones(11, [*XYZ, ("runs", "f4"), ("stamp", "f4"), ("time", "f4"), ("timestamp", "f4")])
    rows["runs"], rows["stamp"], rows["time"], rows["timestamp"] = RISING_S, 3.0 * RISING_S, 0.0, 2.0 * RISING_S
    np.testing.assert_allclose(cloud(tmp_path, rows).times_s, 2.0 * RISING_S, atol=1e-7)
    assert not len(cloud(tmp_path, rows[["x", "y", "z", "runs"]].astype([*XYZ, ("runs", "f4")])).times_s)


def test_an_undefined_time_of_a_dropped_point_harms_no_other(tmp_path):
    rows = random_rows([*XYZ, ("time", "f8")], count=4)
    rows["time"] = [np.nan, 0.01, 0.02, 0.03]
    rows["x"][0] = np.nan
    np.testing.assert_allclose(cloud(tmp_path, rows).times_s, [0.01, 0.02, 0.03], atol=1e-7)


@pytest.mark.parametrize(
    ("unit", "per_second"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9), ("none", 1.0)]
)
def test_the_unit_of_times_can_be_set_or_times_left_alone(tmp_path, unit, per_second):
    rows = random_rows([*XYZ, ("t", "f8")], count=3)
    rows["t"] = np.array([0.0, 0.002, 0.005]) * per_second
    scan = cloud(tmp_path, rows, config={"point_times": unit})
    np.testing.assert_allclose(scan.times_s, [] if unit == "none" else [0.0, 0.002, 0.005], atol=1e-7)


@pytest.mark.parametrize(
    ("sense", "start_rad", "expected_s"),
    [
        ("clockwise", np.pi, [0.1, 0.05, 0.15, 0.0]),
        ("counterclockwise", np.pi, [0.1, 0.15, 0.05, 0.0]),
        ("clockwise", 0.5 * np.pi, [0.05, 0.0, 0.1, 0.15]),
    ],
)
def test_a_lidar_without_times_can_be_timed_by_its_azimuth(tmp_path, sense, start_rad, expected_s):
    rows = np.array([(2, 0, 0), (0, 2, 1), (0, -2, 0), (-2, 0, 0)], dtype=XYZ)
    config = LogConfig(point_times=sense, revolution_s=0.2, revolution_start_rad=start_rad)
    log = open_log(write(tmp_path / "a.mcap", [cloud_said(STAMP_NS, point_cloud(STAMP_NS, rows))]), config)
    (scan,) = log.scans()
    np.testing.assert_allclose(scan.times_s, expected_s, atol=1e-6)
    assert f"point times by the azimuth: {sense} from {start_rad:.3g} rad" in log.notes[-1]


# poses


@pytest.mark.parametrize("kind", ["PoseStamped", "PoseWithCovarianceStamped"])
def test_stamped_poses_lead_where_they_are_asked_for(tmp_path, kind):
    """Of the robot's base: the static transform from base_link says where the lidar is."""
    pose, name = ROS.pose(3.0, 4.0, 0.5, 6.0), f"geometry_msgs/msg/{kind}"
    pose = ROS.with_covariance(pose) if "Covariance" in kind else pose
    data = ROS.serialize(ROS.new(name, header=ROS.header(STAMP_NS, "map"), pose=pose), name)
    said = [
        transforms_said(STAMP_NS, transforms(("base_link", "lidar", 1.0, 2.0, 0.3, 0.1))),
        Said("/gps", name, STAMP_NS, data),
        cloud_said(STAMP_NS, point_cloud(STAMP_NS, random_rows(XYZ))),
    ]
    path = write(tmp_path / "a.mcap", said)
    assert open_log(path).odometry_topic == ""
    log = open_log(path, LogConfig(odometry_topic="/gps", ground_truth_topic="/gps"))
    (scan,) = log.scans()
    np.testing.assert_allclose(scan.T_odom_base[:3, 3], [3.0, 4.0, 6.0])
    np.testing.assert_allclose(log.ground_truth().poses[0], scan.T_odom_base)
    assert log.T_base_lidar[0, 3] == 1.0 and log.T_base_lidar[1, 3] == 2.0


def test_a_quaternion_that_is_not_quite_unit_is_normalized(tmp_path):
    data = bytearray(odometry(STAMP_NS, 1.0, 2.0, 0.5))
    rows = random_rows(XYZ)
    quat = np.array([0.0, 0.0, np.sin(0.25), np.cos(0.25)])
    at = bytes(data).index(np.array(quat[2:]).astype("<f8").tobytes()) - 16
    data[at : at + 32] = (1.01 * quat).astype("<f8").tobytes()
    said = [odometry_said(STAMP_NS, bytes(data)), cloud_said(STAMP_NS, point_cloud(STAMP_NS, rows))]
    (scan,) = open_log([write(tmp_path / "a.mcap", said)], LogConfig()).scans()
    np.testing.assert_allclose(scan.T_odom_base[:3, :3] @ scan.T_odom_base[:3, :3].T, np.eye(3), atol=1e-12)
