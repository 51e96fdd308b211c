"""Standing lidars: the pose is held, nothing drifts, and every motion is followed."""

from dataclasses import replace

import numpy as np
import pytest

from scanchain import lie
from scanchain.odometry import Odometry
from scanchain.odometry.odometry import first_match
from scanchain.odometry.standstill import Standstill
from tests.support.moving_worlds import standing
from tests.support.scenes import configured

SIGMA_M = 0.005


def matches(positions_m, noise_m=0.001, dimension=3, seed=0):
    """Matches at positions along x, off by a noise that is smaller than their covariance says."""
    random = np.random.default_rng(seed)
    k = 3 if dimension == 2 else 6
    sigma = lie.by_component(k, SIGMA_M, SIGMA_M)
    match = first_match(lie.identity(dimension), np.zeros((1, dimension)), configured(dimension).matching)
    for x in positions_m:
        twist = np.append(x, np.zeros(k - 1)) + 0.2 * noise_m * random.standard_normal(k)
        twist[0] += noise_m * random.standard_normal()
        yield replace(match, T_target_source=lie.exp(twist), information=np.diag(sigma**-2.0))


def held(found, positions_m, **noise):
    """Positions (N, 3) along x as they are published, and whether the lidar was found to stand."""
    x, stands = [], []
    for match in matches(positions_m, **noise):
        stands.append(found.confirms(match))
        x.append((found.T_odom_lidar if stands[-1] else match.T_target_source)[0, -1])
        if not stands[-1]:
            found.update(match)
    return np.array(x), np.array(stands)


def test_a_log_begins_at_a_standstill_that_averages_the_matches(dimension):
    x, stands = held(Standstill(dimension), np.zeros(300), dimension=dimension)
    assert stands.all()
    assert np.abs(np.diff(x)).sum() < 0.005
    assert np.abs(x).max() < 0.001


def test_a_standstill_after_a_motion_is_found_within_a_second():
    x = np.append(np.arange(1.0, 20.0), np.full(30, 20.0))
    _, stands = held(Standstill(3), x)
    assert not stands[:20].any()
    assert stands[30:].all()


@pytest.mark.parametrize(("step_m", "limit_m"), [(0.005, 0.0101), (0.001, 0.008), (0.0002, 0.008)])
def test_slow_motion_is_not_held_back(step_m, limit_m):
    truth = np.append(np.zeros(30), step_m * np.arange(200))
    x, _ = held(Standstill(3), truth)
    assert np.abs(x - truth).max() < limit_m


def test_a_vehicle_that_sets_off_is_followed_from_the_first_centimeter():
    truth = np.append(np.zeros(30), 0.5 * (0.1 * np.arange(1, 20)) ** 2)
    x, stands = held(Standstill(3), truth)
    assert not stands[31:].any()
    assert np.abs(x[31:] - truth[31:]).max() < 0.005


def test_weak_matches_show_no_standstill():
    """Six centimeters a scan are a motion, however little the scans say of it."""
    standstill = Standstill(3)
    for match in matches(0.06 * np.arange(1, 30)):
        weak = replace(match, information=1e-6 * match.information)
        assert not standstill.confirms(weak)
        standstill.update(weak)


@pytest.mark.parametrize(("world", "seed"), [("town", 1), ("town", 4), ("forest", 3)])
def test_a_lidar_that_stands_among_people_and_cars_ends_where_it_began(world, seed):
    odometry = Odometry(dimension=3)
    scans = standing("vlp-16", 80, world, seed, noise_m=0.025, people=8, cars=4)
    p = np.array([odometry.process(scan).T_odom_lidar[:3, 3] for scan in scans])
    assert np.linalg.norm(p[-1]) < 0.005
    assert np.sqrt((p**2).sum(axis=1).mean()) < 0.005


def test_matches_drawn_aside_for_a_while_leave_the_lidar_where_it_stood():
    """A truck passes: for two seconds matches lie 12 mm aside, then where they lay before."""
    aside = np.zeros(120)
    aside[50:70] = 0.012
    x, stands = held(Standstill(3), aside)
    assert np.abs(x[:50]).max() == 0.0
    assert not stands[51:70].any()
    assert np.abs(x[75:]).max() < 0.002


def test_matches_that_all_lie_beside_the_first_scan_do_not_move_it():
    """A map of one scan has its noise: all that are aligned to it lie beside it, by as much."""
    x, stands = held(Standstill(3), np.append(0.0, np.full(60, 0.009)))
    assert stands.all()
    assert np.abs(x).max() < 0.001


def test_wheels_that_come_in_while_the_lidar_stands_end_the_hold():
    standstill = Standstill(3)
    held(standstill, np.zeros(20))
    standstill.end()
    assert not standstill.is_standing


def test_the_map_of_a_standing_lidar_takes_no_more_than_the_first_scans():
    odometry = Odometry(dimension=3)
    p = np.array([odometry.process(scan).T_odom_lidar[:3, 3] for scan in standing("vlp-16", 40)])
    assert odometry.local_map.insertions <= 12
    assert np.linalg.norm(p, axis=1).max() < 0.003
    assert np.linalg.norm(np.diff(p, axis=0), axis=1).sum() < 0.01
