"""Localization in a map scan by scan, as a driver delivers them, and at the end."""

from pathlib import Path

import numpy as np
import pytest

from scanchain import InputError, Localizer, lie
from scanchain.data import Keyframe, Scan
from scanchain.maps import open_saved_map
from scanchain.sessions.changes import Part
from scanchain.sessions.localizer import MapState, _moved
from tests.support.rooms import BOX, corridor, hall, map_of, part, room, saved


def test_the_localizer_takes_scans_as_a_driver_has_them(tmp_path):
    prior = open_saved_map(saved(tmp_path / "room", part("room", room(BOX))))
    localizer = Localizer(tmp_path / "room", initial=prior.keyframes[0].T_odom_lidar)
    first = prior.keyframes[0].points
    placed = [localizer.process(Scan.of(first, 0.1 * k)) for k in range(5)]
    assert all(each.state is not MapState.SEARCHING for each in placed)
    off_m, off_rad = lie.apart(placed[-1].T_map_lidar, prior.keyframes[0].T_odom_lidar)
    assert off_m < 0.01 and off_rad < 0.01 and placed[-1].covariance.shape == (3, 3)
    with pytest.raises(InputError, match="stamp"):
        localizer.process(Scan.of(first, 0.1))


def localized(solids):
    """Scans of a drive along a room, placed in the map of one with a box, at once and in the end; true poses."""
    prior, drive = map_of(Path("room"), part("room", room(BOX), count=12)), part("drive", solids, count=50)
    localizer = Localizer(prior, is_live=False)
    scans = [Scan.of(each.points, 0.1 * k, index=k) for k, each in enumerate(drive.keyframes)]
    placed, found = [localizer.process(scan) for scan in scans], localizer.finish()
    assert np.array_equal(found.result.graph.poses[:12], prior.poses)
    assert [each.state for each in placed] == found.states.tolist()
    return placed, found, drive.poses


def test_scans_from_before_the_map_was_found_are_placed_in_the_end():
    placed, found, true = localized(room(BOX))
    first = found.found_at
    assert 0 < first < 40 and found.is_placed.all()
    before_m = np.linalg.norm((found.trajectory.poses - true)[:first, :2, 2], axis=1)
    assert (0.2 * before_m < found.final_sigma_m[:first]).all() and found.final_sigma_m[:first].max() < 0.01
    assert np.isnan(found.live[:first]).all() and np.isnan(found.sigma_m[:first]).all()
    assert np.array_equal(found.live[first:], [each.T_map_lidar for each in placed[first:]])
    sigmas = [np.sqrt(np.trace(each.covariance[:2, :2])) for each in placed[first:]]
    assert np.allclose(found.sigma_m[first:], sigmas)
    for poses, sigma_m in ((found.live, found.sigma_m), (found.trajectory.poses, found.final_sigma_m)):
        error_m = np.linalg.norm((poses - true)[first:, :2, 2], axis=1)
        assert 0.1 < np.median(error_m / sigma_m[first:]) < 3.0 and error_m.max() < 0.002
    assert np.abs(found.traveled_m - (true[:, 0, 2] - 1.5)).max() < 0.01


def test_nothing_is_placed_where_the_map_is_of_another_room():
    placed, found, _ = localized(hall())
    assert found.found_at == -1 and not found.is_placed.any() and len(found.placed) == 0
    assert all(each.T_map_lidar is each.covariance is None for each in placed)
    assert np.isnan(found.live).all() and np.isnan(found.final_sigma_m).all()


def test_a_scan_of_which_nothing_matches_is_lost_and_its_pose_is_predicted():
    prior = map_of(Path("room"), part("room", room(BOX), count=50))
    localizer = Localizer(prior, initial=prior.poses[0])
    seen = [each.points for each in prior.keyframes[:10]]
    scans = [Scan.of(points, 0.1 * k) for k, points in enumerate([*seen, 0.05 * seen[-1][:60]])]
    *_, known, lost = (localizer.process(scan) for scan in scans)
    assert (known.state, lost.state) == (MapState.LOCALIZED, MapState.LOST)
    sigma_m = [np.sqrt(np.trace(each.covariance[:2, :2])) for each in (known, lost)]
    assert sigma_m[0] < 0.02 and sigma_m[1] > 1.0  # as of the edge to a keyframe after a lost scan
    assert lie.apart(lost.T_map_lidar, prior.poses[10])[0] < 0.01


def test_a_log_that_leaves_the_map_is_unmatched_then_outside_and_ever_less_certain():
    depths_m, x_m = np.random.default_rng(4).uniform(1.0, 3.0, 60), np.arange(21.0, 38.0, 0.25)
    mapped = [corridor(float(x), k, depths_m) for k, x in enumerate(np.arange(20.0, 31.0, 0.5))]
    log = [corridor(float(x), k, depths_m) for k, x in enumerate(x_m)]
    localizer = Localizer(map_of(Path("map"), Part("map", mapped, np.empty(0))), initial=log[0].T_odom_lidar)
    placed = [localizer.process(Scan.of(each.points, 0.1 * k, index=k)) for k, each in enumerate(log)]
    states = np.array([each.state for each in placed])
    assert (states[(x_m > 22.0) & (x_m < 31.0)] == MapState.LOCALIZED).all()  # the map is within sight, farther on
    assert (states[(x_m > 34.5) & (x_m < 35.5)] == MapState.UNMATCHED).all()
    assert (states[x_m > 36.5] == MapState.OUTSIDE).all()  # 5 m away
    sigma_m = np.array([np.sqrt(np.trace(each.covariance[:2, :2])) for each in placed])
    assert (np.diff(sigma_m[x_m > 34.5]) > 0.0).all() and sigma_m[-1] > 1.5 * sigma_m[x_m < 31.0][-1]
    off_m = [lie.apart(each.T_map_lidar, true.T_odom_lidar)[0] for each, true in zip(placed, log, strict=True)]
    assert (off_m < 5.0 * sigma_m).all()


def test_an_uncertain_heading_becomes_an_uncertain_position_aside_as_the_lidar_moves_ahead():
    keyframe = Keyframe(0, 0, 0, None, lie.pose_2d(3.0, 4.0, 1.0), 0.0)
    ahead = keyframe.T_odom_lidar @ lie.pose_2d(10.0, 0.0, 0.0)
    moved = _moved(np.diag([0.01, 0.01, 0.04]), keyframe, ahead)
    np.testing.assert_allclose(moved, [[0.01, 0.0, 0.0], [0.0, 4.01, 0.4], [0.0, 0.4, 0.04]], atol=1e-12)
