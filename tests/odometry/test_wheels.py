"""Wheel odometry as a prediction: where the lidar sits on the robot, jumps, and corridors without ends."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Scan, State
from scanchain.errors import InputError
from scanchain.odometry import Odometry
from scanchain.odometry.odometry import first_match
from scanchain.odometry.wheels import Wheels
from scanchain.simulation import NO_SLIP, Slip
from tests.support import made
from tests.support.drives import Drive
from tests.support.scenes import configured


def driven(dimension, count=6):
    """Poses of a robot and scans without points that have them as readings, the mounting, and the wheels."""
    k, rng = 3 if dimension == 2 else 6, np.random.default_rng(0)
    T_odom_base, T_base_lidar = lie.exp(rng.normal(0.0, 0.5, (count, k))), lie.exp(rng.normal(0.0, 0.5, k))
    scans = [
        Scan.of(np.empty((0, dimension)), 0.1 * index, index=index, T_odom_base=T)
        for index, T in enumerate(T_odom_base)
    ]
    return T_odom_base, T_base_lidar, scans, wheels_of(dimension, T_base_lidar)


def wheels_of(dimension, T_base_lidar, prior="auto", is_mounted=True):
    return Wheels(configured(dimension, {"odometry.prior": prior}).odometry, T_base_lidar, is_mounted=is_mounted)


def test_the_motion_of_the_lidar_is_that_of_the_base_seen_from_its_mounting(dimension):
    T_odom_base, T_base_lidar, scans, wheels = driven(dimension)
    T_odom_lidar = T_odom_base @ T_base_lidar
    assert wheels.motion(scans[0]) is None
    for before, scan in pairwise(scans):
        wheels.advance(before)
        before.T_odom_base[...] = 7.0  # a driver may fill one array again and again
        true = lie.between(T_odom_lidar[before.index], T_odom_lidar[scan.index])
        np.testing.assert_allclose(wheels.motion(scan), true, atol=1e-12)


def test_a_rejected_reading_gives_no_motion_from_it_and_the_next_one_does_again(dimension):
    _, _, scans, wheels = driven(dimension)
    known = []
    for scan in scans:
        wheels.is_contradicted = False
        known.append(wheels.motion(scan) is not None)
        if scan.index in (1, 4):
            wheels.reject(scan, 2.0 + scan.index)
        wheels.advance(scan)
    assert known == [False, True, False, True, True, False]
    (line,) = wheels.warnings()
    assert "jumps by up to 6 m" in line and "left out at 2 scans (the first: scan 1)" in line


def test_without_readings_or_a_mounting_and_over_a_jump_of_the_clock_there_is_no_motion(dimension):
    _, T_base_lidar, (first, second, *_), wheels = driven(dimension)
    wheels.advance(first)
    assert wheels.motion(replace(second, clock_jump_s=5.0)) is None
    assert wheels.motion(replace(second, T_odom_base=None)) is None
    with pytest.raises(InputError, match="scan 1 has no wheel odometry"):
        wheels_of(dimension, T_base_lidar, "wheel").motion(replace(second, T_odom_base=None))
    assert wheels.motion(second) is not None
    wheels.advance(replace(first, T_odom_base=None))
    assert wheels.motion(second) is None and wheels.warnings() == ()
    for prior, is_mounted in (("constant-velocity", True), ("auto", False)):
        other = wheels_of(dimension, T_base_lidar, prior, is_mounted)
        other.advance(first)
        assert other.motion(second) is None


@pytest.mark.parametrize("delay_s", [-0.3, 0.0, 0.66])
def test_late_wheels_are_told_with_the_key_that_mends_them(delay_s):
    log = made.log("office", seconds=40, wheels_delay_s=delay_s)
    warnings = [tracked_by(Drive.of(log, odometry_delay_s=each)).wheels.warnings() for each in (0.0, delay_s)]
    if delay_s:
        late = "0.66 s late: add 0.66" if delay_s > 0.0 else "0.30 s early: add -0.30"
        assert warnings[0] == (f"wheel odometry: its stamps are {late} to log.odometry_delay_s",)
    assert warnings[1] == ()


def tracked_by(drive):
    """The predictor after a drive."""
    odometry = Odometry(configured(drive.dimension), drive.T_base_lidar)
    for scan in drive.scans:
        odometry.process(scan)
    return odometry.predictor


@pytest.mark.parametrize("slip", [NO_SLIP, Slip(4.0, 6.0, 3.0)])
def test_in_space_distances_by_wheels_are_corrected_by_those_of_the_scans_but_not_while_they_slip(slip):
    wheels = tracked_by(Drive.of(made.log("town", seconds=10, sensor="vlp-16", wheels_slip=slip))).wheels
    assert 1.0 / wheels.scale == pytest.approx(1.011, abs=0.002)  # by the random numbers of the seed
    assert re.fullmatch(r"wheel odometry: its distances are 1\.[012] % too long, which .*", wheels.note())
    assert wheels_of(3, np.eye(4)).note() == ""


def test_the_distances_of_late_wheels_are_not_corrected():
    wheels = tracked_by(Drive.of(made.log("town", seconds=12, sensor="vlp-16", wheels_delay_s=-0.3))).wheels
    assert wheels.by_scans_m < 0.98 * wheels.by_wheels_m
    assert wheels.scale == 1.0 and wheels.note() == ""
    assert "its stamps are 0.30 s early" in wheels.warnings()[0]


def test_wheels_that_differ_from_the_scans_by_more_than_slip_change_no_scale_and_in_the_plane_none_is_estimated():
    for dimension, factor, scale in ((3, 1.05, 1.0 / 1.05), (3, 1.3, 1.0), (2, 1.05, 1.0)):
        wheels, T = wheels_of(dimension, lie.identity(dimension)), lie.identity(dimension)
        match = replace(
            first_match(T, np.zeros((9, dimension)), configured(dimension).matching), observability=50.0
        )
        for index in range(400):
            lidar, base = T.copy(), T.copy()
            lidar[0, -1], base[0, -1] = 0.5 * index, factor * 0.5 * index
            scan = Scan.of(np.empty((0, dimension)), 0.1 * index, index=index, T_odom_base=base)
            wheels.update(scan, lidar, match, is_open=False)
        assert wheels.scale == pytest.approx(scale, abs=1e-3)


def test_wheels_at_the_second_scan_contradict_no_motion():
    drive = Drive.of(made.log("highway", seconds=1, seed=2, sensor="vlp-16"))
    predictor = tracked_by(drive)
    assert predictor.wheels.warnings() == ()


def test_in_a_blank_corridor_the_wheels_lead_along_it_and_the_scans_across():
    """From the ninth second on its ends are out of sight."""
    corridor = Drive.of(made.log("corridor", seconds=18, seed=3, sensor="vlp-16"))
    steps = corridor.tracked()
    blind = [step for step in steps[90:] if step.state is State.DEGENERATE]
    along = [abs(step.match.degeneracy_direction[0]) > np.cos(np.radians(5.0)) for step in blind]
    assert len(blind) > 0.95 * len(steps[90:]) and np.mean(along) > 0.95
    assert sum(step.state is State.DEGENERATE for step in steps[:80]) < 5
    assert corridor.error_m(steps) < 0.05


@pytest.mark.parametrize(("jump_m", "lasts"), [(0.6, True), (3.0, False), (100.0, True), (1e6, False)])
def test_a_jump_of_the_wheels_that_the_scans_contradict_is_left_out(office_drive, jump_m, lasts):
    jumped = office_drive.scans[:60]
    for index in range(30, 60 if lasts else 31):
        T_jump = np.eye(3) + jump_m * np.outer([1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
        jumped[index] = replace(jumped[index], T_odom_base=T_jump @ jumped[index].T_odom_base)
    odometry = Odometry(configured(2), office_drive.T_base_lidar)
    steps, usual = [odometry.process(scan) for scan in jumped], office_drive.tracked(office_drive.scans[:60])
    assert lie.apart(steps[-1].T_odom_lidar, usual[-1].T_odom_lidar)[0] < 0.02
    if jump_m > 1.0:
        (line,) = odometry.predictor.wheels.warnings()
        assert f"jumps by up to {jump_m:.3g} m" in line and "left out at 1 scan (the first: scan 30)" in line
        assert [step.scan.index for step in steps if step.scan.T_odom_base is None] == [30]
