"""Recovery of scans that fit poorly at the predicted pose: other initial poses, ambiguous ones, a new map."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LocalMapConfig
from scanchain.data import Scan, State
from scanchain.odometry import Odometry
from scanchain.odometry.recovery import Recovery, from_above
from scanchain.registration import VoxelMap, Window
from tests.support.drives import NO_WHEELS
from tests.support.scenes import configured, sloping_street


def test_a_scan_of_another_place_is_lost_and_the_next_good_one_is_found_again(office_drive):
    elsewhere = np.random.default_rng(0).uniform(-300.0, 300.0, (500, 2)).astype(np.float32)
    far = elsewhere[np.linalg.norm(elsewhere, axis=1) > 30.0]
    scans = office_drive.scans[:200]
    scans[100:103] = [replace(scan, points=far, times_s=np.zeros(len(far), np.float32)) for scan in scans[100:103]]
    steps = office_drive.tracked(scans, {"preprocess.max_range_m": 500.0, **NO_WHEELS})
    assert [step.state for step in steps[100:103]] == [State.LOST] * 3
    assert "correspondence" in steps[100].reason
    assert {step.state for step in steps[103:]} == {State.OK}
    assert office_drive.error_m([step for step in steps if step.state is State.OK]) < 0.05


def test_a_turn_that_matching_alone_does_not_follow_is_found_by_a_search():
    config = configured(2, NO_WHEELS)
    odometry = Odometry(config, np.eye(3))
    T_room_first, T_room_lidar = lie.pose_2d(0.3, 0.2, 0.0), lie.pose_2d(0.5, 0.1, 0.75)
    for index in range(10):
        first = odometry.process(scan_of_room(T_room_first, 3.0, index, index * 10**8))
    scan, truth = scan_of_room(T_room_lidar, 3.0, 10, 13 * 10**8), lie.between(T_room_first, T_room_lidar)
    alone = odometry.matcher.align(scan.points, odometry.local_map, first.T_odom_lidar, wide=True)
    assert lie.apart(alone.T_target_source, truth)[1] > 0.3
    step = odometry.process(scan)
    off_m, off_rad = lie.apart(step.T_odom_lidar, truth)
    assert step.state is State.OK and off_m < 0.02 and off_rad < 0.005


def test_the_map_is_extended_from_the_fifth_lost_scan_and_searches_stay_wide_for_three():
    recovery = Recovery(configured(2).matching, None)
    states = [State.OK] * 4 + [State.LOST] * 6 + [State.OK] * 4
    after = [(recovery.needs_extension(state), recovery.wide_scans) for state in states]
    assert [is_extended for is_extended, _ in after] == [False] * 8 + [True] * 2 + [False] * 4
    assert [wide for _, wide in after] == [2, 1, 0, 0, *[3] * 6, 2, 1, 0, 0]


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


def test_a_scan_in_space_is_found_meters_away_and_turned():
    ground, high = sloping_street(np.random.default_rng(4))
    target = VoxelMap(3, LocalMapConfig())
    target.insert(np.concatenate([ground, high]), lie.identity(3))
    truth = lie.lift(lie.pose_2d(9.0, -5.0, 0.6))
    truth[2, 3] = 0.45
    scan = lie.transform(lie.inverse(truth), np.concatenate([ground[::3], high]))
    window = Window(lie.identity(2), 15.0, 1.0)
    first = next(from_above(scan, target, lie.identity(3), window, 60.0))
    away_m, away_rad = lie.apart(truth, first)
    assert away_m < 1.0 and away_rad < 0.1
    assert not list(from_above(ground, target, lie.identity(3), window, 60.0))
