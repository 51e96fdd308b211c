"""results.mcap as other people's readers see it."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.__main__ import main
from scanchain.logs import open_log
from scanchain.maps import read_map, read_ply
from scanchain.runs.results_mcap import ros_covariance
from scanchain.trajectory import read_tum
from tests.support import naive_logs
from tests.support.naive_logs import SECOND, STAMP_NS, decoded


def matrix(p, q):
    """Of a position and an orientation."""
    T = np.eye(4)
    T[:3, :3] = lie.from_quaternion(np.array([q.x, q.y, q.z, q.w]))
    T[:3, 3] = p.x, p.y, p.z
    return T


def matrix_of(transform):
    return matrix(transform.translation, transform.rotation)


def room(folder):
    """A lidar, mounted off the base, that drives through a square room."""
    mounting = naive_logs.transforms(("base_link", "laser", 0.2, 0.1, 0.3, 0.0))
    said = [naive_logs.transforms_said(STAMP_NS, mounting)]
    angles = -3.0 + 0.0125 * np.arange(480)
    for k in range(8):
        stamp_ns = STAMP_NS + k * SECOND // 10
        x = 0.05 * k
        with np.errstate(divide="ignore"):
            along = np.where(np.cos(angles) > 0, (4.0 - x) / np.cos(angles), (-5.0 - x) / np.cos(angles))
            across = np.where(np.sin(angles) > 0, 3.0 / np.sin(angles), -2.0 / np.sin(angles))
        scan = naive_logs.laser_scan(stamp_ns, np.minimum(along, across), first=-3.0, step=0.0125)
        said.append(naive_logs.scan_said(stamp_ns + 5_000_000, scan))
    return naive_logs.write(folder / "room.mcap", said)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    log = room(folder)
    assert main(["run", str(log), "--out", str(folder / "run"), "--rerun", "off", "--outputs.mcap", "true"]) == 0
    told = {}  # messages by topic: (log time, message)
    for _, channel, message, value in decoded(folder / "run" / "results.mcap"):
        told.setdefault(channel.topic, []).append((message.log_time, value))
    return log, folder / "run", told


def test_every_topic_is_there_and_has_its_schema(finished):
    _, _, told = finished
    assert {topic: len(messages) for topic, messages in told.items()} == {
        "/tf": 8, "/odometry": 8, "/path": 1, "/map": 1, "/map_cloud": 1,
    }  # fmt: skip


def test_transforms_lead_from_the_world_to_the_scans_of_the_log(finished):
    log, run, told = finished
    opened, trajectory = open_log(log), read_tum(run / "trajectory.tum")
    for (log_ns, message), T_world_lidar, scan in zip(told["/tf"], trajectory.poses, opened.scans(), strict=True):
        assert log_ns == scan.log_time_ns
        world, odom = message.transforms
        names = [world.header.frame_id, world.child_frame_id, odom.header.frame_id, odom.child_frame_id]
        assert names == ["world", "odom", "odom", "base_link"]
        T_world_base = matrix_of(world.transform) @ matrix_of(odom.transform)
        T_world_found = T_world_base @ lie.lift(opened.T_base_lidar)
        np.testing.assert_allclose(T_world_found, lie.lift(T_world_lidar), atol=1e-6)


def test_odometry_is_that_of_the_transforms_and_has_a_covariance(finished):
    _, _, told = finished
    for (_, odometry), (_, tf) in zip(told["/odometry"], told["/tf"], strict=True):
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
        pose = odometry.pose.pose
        np.testing.assert_allclose(matrix(pose.position, pose.orientation), matrix_of(tf.transforms[1].transform))
    covariance = np.array(told["/odometry"][-1][1].pose.covariance).reshape(6, 6)
    planar = covariance[np.ix_([0, 1, 5], [0, 1, 5])]
    np.testing.assert_allclose(planar, planar.T)
    assert np.linalg.eigvalsh(planar)[0] > 0.0
    assert np.count_nonzero(covariance) <= 9


def test_the_path_is_the_optimized_one_of_the_robot(finished):
    log, run, told = finished
    (log_ns, path), trajectory = told["/path"][0], read_tum(run / "trajectory.tum")
    T_lidar_base = lie.inverse(open_log(log).T_base_lidar)
    assert path.header.frame_id == "world" and log_ns == STAMP_NS + 5_000_000
    found = [matrix(each.pose.position, each.pose.orientation) for each in path.poses]
    np.testing.assert_allclose(found, lie.lift(trajectory.poses) @ lie.lift(T_lidar_base), atol=1e-6)


def test_maps_are_those_of_the_files(finished):
    _, run, told = finished
    cells, resolution_m, origin_m = read_map(run)
    grid = told["/map"][0][1]
    np.testing.assert_array_equal(np.array(grid.data).reshape(grid.info.height, grid.info.width), cells)
    assert grid.info.resolution == pytest.approx(resolution_m)
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == origin_m
    cloud = told["/map_cloud"][0][1]
    points = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 3)
    np.testing.assert_array_equal(points, read_ply(run / "map.ply").astype("<f4"))


def test_a_covariance_turns_with_the_lidar_and_is_zero_where_it_is_unknown():
    told = ros_covariance(np.diag([4.0, 1.0, 0.01]), lie.pose_2d(5.0, 6.0, np.pi / 2))
    np.testing.assert_allclose(np.diag(told), [1.0, 4.0, 0.0, 0.0, 0.0, 0.01], atol=1e-12)
    assert not ros_covariance(np.full((3, 3), np.nan), np.eye(3)).any()
    spread = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    np.testing.assert_allclose(ros_covariance(spread, np.eye(4)), spread)
