"""The GNSS receiver of a log: its topic, its antenna, the fixes of a scan, and the files of a run."""

import json
from dataclasses import replace
from xml.etree import ElementTree

import laspy
import numpy as np
import pytest
from foxglove import messages as fox
from foxglove.channels import LocationFixChannel
from rosbags.typesys import get_types_from_msg

import scanchain
from scanchain import lie
from scanchain.errors import InputError
from scanchain.geodesy import Geodesy
from scanchain.logs.index import Channel
from scanchain.logs.info import describe
from scanchain.logs.writer import LogWriter, pack_fix
from scanchain.settings import load_settings
from scanchain.simulation import plan
from scanchain.simulation.gnss import ORIGIN, RECEIVERS, T_ENU_WORLD
from tests.support import made, recorders
from tests.support.naive_logs import ROS1, ROS2, Ros

MIDDLE = (49.0, 8.4, 100.0)


@pytest.fixture(scope="module")
def log():
    return made.log("office", seconds=20.0, gnss="rtk")


@pytest.fixture(scope="module")
def run():
    return made.run("office", seconds=20.0, gnss="rtk", maps__write_laz=True, outputs__error_bars="quick")


def with_fixes(log, folder, *said, topic="/b"):
    """Log files: the given one, and one with further fixes of these positions and standard deviations."""
    begin_ns = int(scanchain.open_log(log).expected_stamps("/scan")[0])
    with LogWriter(folder / "more.mcap") as writer:
        for k, (position, sigma_m) in enumerate(said):
            stamp_ns = begin_ns + k * 100_000_000
            writer.append(topic, "sensor_msgs/msg/NavSatFix", pack_fix(stamp_ns, "a", position, sigma_m), stamp_ns)
    return [log, folder / "more.mcap"]


def fixes_of(opened):
    return [scan.fixes for scan in opened if scan.fixes is not None]


def test_the_only_receiver_is_found_with_its_antenna_and_scans_have_each_fix_once(log):
    opened = scanchain.open_log(log)
    assert opened.gnss.topic == "/fix"
    in_base = lie.transform(opened.mounting.T_base_lidar, opened.gnss.T_lidar_sensor[None, :3, 3])[0]
    np.testing.assert_allclose(in_base, RECEIVERS["rtk"].antenna_m, atol=1e-9)
    stamps_ns = np.concatenate([each.stamps_ns for each in fixes_of(opened)])
    assert len(stamps_ns) > 190 and (np.diff(stamps_ns) == 100_000_000).all()
    np.testing.assert_allclose(fixes_of(opened)[0].covariances[0], np.diag(np.square(RECEIVERS["rtk"].sigma_m)))


def test_fixes_are_true_positions_of_the_antenna_within_what_the_receiver_states(log):
    drive = plan("office", duration_s=20.0)
    fixes = fixes_of(scanchain.open_log(log))
    enu_m = Geodesy(*ORIGIN).enu(np.concatenate([each.positions for each in fixes]))
    T = T_ENU_WORLD @ drive.motion.base(0.1 * np.arange(len(enu_m)))
    errors = enu_m - T[:, :3, 3] - T[:, :3, :3] @ RECEIVERS["rtk"].antenna_m
    assert 0.3 < (errors / RECEIVERS["rtk"].sigma_m).std() < 1.7


def test_half_of_the_fixes_are_wrong_by_5_to_20_m_under_multipath():
    drive = plan("rounds", gnss="standard-multipath")
    samples = [
        drive.gnss.measure(drive.motion, np.arange(0.0, 160.0, 0.1), np.random.default_rng(seed))
        for seed in range(5)
    ]
    share = np.mean([each.is_multipath.mean() for each in samples])
    true = drive.gnss.measure(drive.motion, np.arange(0.0, 160.0, 0.1), np.random.default_rng(0))
    assert 0.4 < share < 0.6 and true.is_multipath[:30].sum() == 0


def test_without_a_fix_there_is_none_and_an_unknown_covariance_is_replaced(log, tmp_path):
    logs = with_fixes(log, tmp_path, (MIDDLE, None), (MIDDLE, (0.0, 0.0, 0.0)), (MIDDLE, (1.0, 1.0, 2.0)))
    fixes = fixes_of(scanchain.open_log(logs, gnss_topic="/b"))
    assert sum(len(each.stamps_ns) for each in fixes) == 2
    sigmas = np.sqrt(np.concatenate([each.covariances for each in fixes]).diagonal(axis1=1, axis2=2))
    np.testing.assert_allclose(sigmas, [[5.0, 5.0, 10.0], [1.0, 1.0, 2.0]])
    assert fixes[0].antenna_m is None


def test_a_position_that_is_none_on_earth_or_unset_is_left_out_and_counted(log, tmp_path):
    bad = (91.0, 0.0, 0.0), (np.nan, 0.0, 0.0), (0.0, 0.0, 0.0)
    logs = with_fixes(log, tmp_path, *((each, (1.0,) * 3) for each in bad))
    opened = scanchain.open_log(logs, gnss_topic="/b")
    assert not fixes_of(opened)
    assert any("3 malformed messages of /b left out" in line for line in opened.damage)


def test_fixes_of_another_clock_are_left_out_and_counted(log, tmp_path):
    with LogWriter(tmp_path / "late.mcap") as writer:
        begin_ns = int(scanchain.open_log(log).expected_stamps("/scan")[0])
        for k in range(5):
            data = pack_fix(begin_ns - 37_000_000_000, "a", MIDDLE, (1.0,) * 3)
            writer.append("/b", "sensor_msgs/msg/NavSatFix", data, 0, begin_ns + k * 100_000_000)
    opened = scanchain.open_log([log, tmp_path / "late.mcap"], gnss_topic="/b")
    assert not fixes_of(opened)
    assert any("5 fixes of the GNSS receiver left out: more than 10 s" in note for note in opened.notes)


def test_none_leaves_it_unused_of_several_none_is_used_and_another_topic_is_refused(log, tmp_path):
    assert scanchain.open_log(log, gnss_topic="none").gnss is None
    logs = with_fixes(log, tmp_path, (MIDDLE, (1.0, 1.0, 2.0)))
    opened = scanchain.open_log(logs)
    assert opened.gnss is None
    assert "several GNSS receivers (/b, /fix), none is used; choose with --log.gnss_topic" in opened.notes
    with pytest.raises(InputError, match=r"log.gnss_topic /odom is not a topic of sensor_msgs/NavSatFix"):
        scanchain.open_log(log, gnss_topic="/odom")
    said = describe([log], load_settings(2).config.log)["sensors"]
    ((place, use),) = [each.use.split("; ") for each in said if each.sensor == "GNSS"]
    assert place.startswith("at x ") and place.endswith(" from the lidar")
    assert use == "its fixes give the place on Earth, and correct drift where they show any"


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"positions": np.zeros((3, 3))}, r"fixes.positions .* \(1, 3\)"),
        ({"covariances": np.zeros((1, 3, 3))}, "fixes.covariances are not positive definite"),
        ({"antenna_m": np.zeros(2)}, "fixes.antenna_m"),
    ],
)
def test_fixes_given_in_python_are_checked(changed, words):
    sound = scanchain.Fixes(np.array([1]), np.array([MIDDLE]), np.eye(3)[None], np.zeros(3))
    assert scanchain.Scan.of(np.ones((5, 3)), 1.0, fixes=sound).fixes.positions.shape == (1, 3)
    with pytest.raises(InputError, match=words):
        scanchain.Scan.of(np.ones((5, 3)), 1.0, fixes=sound._replace(**changed))


def test_positions_on_earth_are_those_of_the_ellipsoid_and_of_utm():
    geodesy = Geodesy(*MIDDLE)
    points = np.array([[0.0, 0.0, 0.0], [1000.0, 0.0, 0.0], [0.0, 1000.0, 50.0]])
    found = geodesy.geodetic(points)
    np.testing.assert_allclose(geodesy.enu(found), points, atol=1e-6)
    a, e2, sine = 6378137.0, 0.00669437999014, np.sin(np.radians(49.0))
    prime, meridian = a / np.sqrt(1.0 - e2 * sine**2), a * (1.0 - e2) / (1.0 - e2 * sine**2) ** 1.5  # radii
    assert found[1, 1] - 8.4 == pytest.approx(
        np.degrees(1000.0 / ((prime + 100.0) * np.cos(np.radians(49.0)))), 1e-6
    )
    assert found[2, 0] - 49.0 == pytest.approx(np.degrees(1000.0 / (meridian + 150.0)), 1e-5)
    projected, crs = geodesy.projected(points)
    assert crs.to_epsg() == 32632 and np.linalg.norm(projected[1] - projected[0]) == pytest.approx(999.6, abs=0.3)


def test_fixes_that_constrain_a_graph_leave_all_that_is_made_of_it(log, tmp_path, monkeypatch):
    monkeypatch.setattr("scanchain.georeference._MOST_ALONE", -1.0)  # as if every trajectory drifted
    slam, opened = scanchain.Slam(dimension=2), scanchain.open_log(log)
    for scan in opened:
        slam.process(scan)
    result = slam.finish()
    graph, place = result.graph, result.georeference
    assert place.origin.is_constrained and graph.is_of_origin.sum() > 4
    assert np.max(lie.apart(result.trajectory.poses[0], np.eye(3))) < 0.05
    assert np.isfinite(graph.covariances()).all() and scanchain.judge(result).verdict == "trustworthy"
    scanchain.write_g2o(tmp_path / "graph.g2o", graph)
    assert scanchain.read_g2o(tmp_path / "graph.g2o").graph.is_of_origin.sum() == graph.is_of_origin.sum()


def test_a_run_writes_its_origin_a_track_and_a_map_with_its_coordinate_system(run):
    origin = json.loads((run / "run.json").read_text())["origin"]
    truth = scanchain.read_tum(made.log("office", seconds=20.0, gnss="rtk").with_suffix(".tum"))
    (first,) = Geodesy(*ORIGIN).geodetic((T_ENU_WORLD @ lie.lift(truth.poses[:1]))[:, :3, 3])
    away_m = Geodesy(*ORIGIN).enu(
        np.array([[origin[f"{name}_deg"] for name in ("latitude", "longitude")] + [0.0]])
    )
    at_m = Geodesy(*ORIGIN).enu(first[None])
    assert np.linalg.norm((away_m - at_m)[0, :2]) < 3.0 * origin["sigma_m"] < 1.0
    assert origin["yaw_rad"] == pytest.approx(np.radians(35.0) + lie.yaw(truth.poses[0]), abs=0.02)
    assert origin["fixes"] > 190 and origin["fixes_rejected"] < 10 and not origin["is_constrained"]
    enu = scanchain.read_tum(run / "trajectory_enu.tum")
    track = json.loads((run / "track.geojson").read_text())["geometry"]["coordinates"]
    geodesy = Geodesy(*(origin[name] for name in ("latitude_deg", "longitude_deg", "altitude_m")))
    np.testing.assert_allclose(geodesy.enu(np.array(track)[:, [1, 0, 2]]), enu.positions, atol=2e-3)
    kml = ElementTree.parse(run / "track.kml").getroot()
    (line,) = kml.iter("{http://www.opengis.net/kml/2.2}coordinates")
    assert [float(each) for each in line.text.split()[0].split(",")] == track[0]
    cloud = laspy.read(run / "map.laz")
    assert cloud.header.parse_crs().to_epsg() == 32632
    (middle,), _ = geodesy.projected(enu.positions.mean(axis=0, keepdims=True))
    assert np.linalg.norm(np.mean([cloud.x, cloud.y], axis=1) - middle[:2]) < 20.0
    assert "note           GNSS: " in (run / "summary.txt").read_text()


GPS_STATUS = """std_msgs/Header header
uint16 satellites_used
int32[] satellite_used_prn
uint16 satellites_visible
int32[] satellite_visible_prn
int32[] satellite_visible_z
int32[] satellite_visible_azimuth
int32[] satellite_visible_snr
int16 status
uint16 motion_source
uint16 orientation_source
uint16 position_source"""
FLOATS = """latitude longitude altitude track speed climb pitch roll dip time gdop pdop hdop vdop tdop
    err err_horz err_vert err_track err_speed err_climb err_time err_pitch err_roll err_dip"""
GPS_FIX = "\n".join([
    "std_msgs/Header header", "GPSStatus status", *(f"float64 {name}" for name in FLOATS.split()),
    "float64[9] position_covariance", "uint8 position_covariance_type",
])  # fmt: skip


def gps_fix(store, package, stamp_ns, status):
    """A serialized GPSFix at MIDDLE with standard deviations of 1, 1 and 2 m."""
    ros, prn = Ros(store), np.arange(3, dtype=np.int32)
    for name, definition in (("GPSStatus", GPS_STATUS), ("GPSFix", GPS_FIX)):
        store.register(get_types_from_msg(definition, f"{package}/msg/{name}"))
    head, kind = ros.header(stamp_ns, "a"), f"{package}/msg/GPSFix"
    of_status = store.types[f"{package}/msg/GPSStatus"](head, 3, prn, 3, prn, prn, prn, prn, status, 1, 1, 1)
    covariance = np.diag([1.0, 1.0, 4.0]).ravel()
    return ros.serialize(store.types[kind](head, of_status, *MIDDLE, *np.arange(22.0), covariance, 2), kind)


def of_ros2(channel, stamp_ns, status):
    data = gps_fix(ROS2, "gps_msgs", stamp_ns, status)
    return replace(channel, type_name="gps_msgs/msg/GPSFix"), data


def of_ros1(channel, stamp_ns, status):
    data = gps_fix(ROS1, "gps_common", stamp_ns, status)
    return replace(channel, type_name="gps_common/GPSFix", encoding="ros1"), data


def of_json(channel, stamp_ns, status):
    sec, nsec = divmod(stamp_ns, 1_000_000_000)
    told = {"timestamp": {"sec": sec, "nsec": nsec}, "frame_id": "a"}
    told |= dict(zip(("latitude", "longitude", "altitude"), MIDDLE, strict=True))
    told |= (
        {"position_covariance": [1, 0, 0, 0, 1, 0, 0, 0, 4], "position_covariance_type": 2} if status >= 0 else {}
    )
    data = json.dumps(told).encode()
    return replace(channel, type_name="foxglove.LocationFix", encoding="json", schema_encoding="jsonschema"), data


@pytest.mark.parametrize(("written", "without_fix"), [(of_ros2, 0), (of_ros1, 0), (of_json, 1)])
def test_fixes_of_gps_receivers_and_of_foxglove_are_read(log, tmp_path, written, without_fix):
    begin_ns = int(scanchain.open_log(log).expected_stamps("/scan")[0])
    bare = Channel((0, 0), "/b", "cdr", 0, "", "ros2msg", b"")
    with LogWriter(tmp_path / "more.mcap") as writer:
        for k, status in enumerate((0, 2, -1)):
            channel, data = written(bare, begin_ns + k * 100_000_000, status)
            writer.copy(channel, begin_ns + k * 100_000_000, data)
    fixes = fixes_of(scanchain.open_log([log, tmp_path / "more.mcap"], gnss_topic="/b"))
    stamps_ns = np.concatenate([each.stamps_ns for each in fixes])
    np.testing.assert_array_equal(stamps_ns, begin_ns + np.arange(2 + without_fix) * 100_000_000)
    np.testing.assert_array_equal(np.concatenate([each.positions for each in fixes])[:2], [MIDDLE] * 2)
    sigmas = np.sqrt(np.concatenate([each.covariances for each in fixes]).diagonal(axis1=1, axis2=2))
    np.testing.assert_allclose(sigmas, [[1.0, 1.0, 2.0]] * 2 + [[5.0, 5.0, 10.0]] * without_fix)


def test_fixes_of_foxglove_in_protobuf_are_read(log, tmp_path):
    begin_ns = int(scanchain.open_log(log).expected_stamps("/scan")[0])
    sec, nsec = divmod(begin_ns, 1_000_000_000)
    position = dict(zip(("latitude", "longitude", "altitude"), MIDDLE, strict=True))
    context = recorders.Context()
    with recorders.open_mcap(tmp_path / "more.mcap", context=context):
        fix = fox.LocationFix(timestamp=fox.Timestamp(sec=sec, nsec=nsec), frame_id="a", **position)
        LocationFixChannel("/b", context=context).log(fix, log_time=begin_ns)
    (fixes,) = fixes_of(scanchain.open_log([log, tmp_path / "more.mcap"], gnss_topic="/b"))
    assert fixes.stamps_ns.tolist() == [begin_ns]
    np.testing.assert_array_equal(fixes.positions, [MIDDLE])
    np.testing.assert_allclose(np.sqrt(fixes.covariances[0].diagonal()), [5.0, 5.0, 10.0])
