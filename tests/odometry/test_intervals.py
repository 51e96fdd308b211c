"""Intervals between scans: implausible stamps and bursts, and stamps of live scans that cannot be seconds."""

from dataclasses import replace

import numpy as np
import pytest

import scanchain as sc
from scanchain import lie
from scanchain.data import Scan, State
from scanchain.errors import InputError
from scanchain.odometry.intervals import Intervals
from tests.support.drives import NO_WHEELS


def stamped(stamp_s, logged_s=None, **changes):
    """A scan without points, logged as it is stamped where nothing else is said."""
    log_time_ns = round(1e9 * (stamp_s if logged_s is None else logged_s))
    return replace(Scan.of(np.empty((0, 2)), stamp_s, index=0), log_time_ns=log_time_ns, **changes)


def fed(stamps_s):
    """Intervals after scans of these stamps."""
    times = Intervals()
    for stamp_s in stamps_s:
        scan = stamped(stamp_s)
        times.update(scan, times.to(scan))
    return times


USUAL_S = np.arange(0.0, 0.95, 0.1)


@pytest.mark.parametrize(
    ("stamp_s", "logged_s", "interval_s", "silence_s", "is_gap"),
    [
        (1.0, 1.0, 0.1, 0.1, False),
        (1.02, 1.0, 0.12, 0.12, False),
        (1.9, 1.9, 1.0, 1.0, True),  # scans are missing: both say so
        (1.9, 1.0, 0.1, 0.0, False),  # a wrong stamp
        (0.8, 1.0, 0.1, 0.0, False),
        (1.0, 1.9, 0.1, 0.0, False),  # logged late
        (60.9, 60.9, 0.1, 60.0, False),  # too long for a plausible interval, which a silence may be
    ],
)
def test_an_interval_is_that_of_the_stamps_where_the_usual_one_or_the_log_confirms_it(
    stamp_s, logged_s, interval_s, silence_s, is_gap
):
    times, scan = fed(USUAL_S), stamped(stamp_s, logged_s)
    assert times.usual_s == pytest.approx(0.1) and fed(USUAL_S[:1]).usual_s == 0.0
    assert times.to(scan) == pytest.approx(interval_s) and times.silence_s(scan) == pytest.approx(silence_s)
    assert times.is_gap(times.to(scan)) is is_gap
    times.update(scan, times.to(scan))
    assert times.usual_s == pytest.approx(0.1, rel=0.03)  # a gap leaves it as it is


@pytest.mark.parametrize(("jump_s", "interval_s"), [(-3600.0, 10.0), (3.0, 3.0), (0.2, 1.0)])
def test_a_jump_of_the_clock_is_a_gap_of_plausible_length_and_a_silence_of_its_own(jump_s, interval_s):
    times, scan = fed(USUAL_S), stamped(5000.0, clock_jump_s=jump_s)
    assert times.to(scan) == pytest.approx(interval_s) and times.is_gap(times.to(scan))
    assert times.silence_s(scan) == abs(jump_s)


@pytest.mark.parametrize(
    ("stamp_s", "logged_s", "span_s", "interval_s"),
    [(0.1, 0.2, 0.0, 0.1), (-0.1, 0.2, 0.0, 0.2), (0.1, 0.1, 0.15, 0.1), (0.001, 0.001, 0.1, 0.1)],
)
def test_the_first_interval_is_that_of_stamps_or_log_but_no_less_than_half_a_scan(
    stamp_s, logged_s, span_s, interval_s
):
    scan = Scan.of(np.ones((2, 2)), stamp_s, np.array([0.0, span_s]), index=0)
    scan = replace(scan, log_time_ns=round(1e9 * logged_s))
    assert fed([0.0]).to(scan) == pytest.approx(interval_s)


def test_the_usual_interval_of_a_burst_is_replaced_once_most_of_the_last_ones_are_longer():
    stamps_s = np.concatenate([0.0001 * np.arange(4), np.arange(0.1, 1.0, 0.1)])
    usual_s = [fed(stamps_s[:count]).usual_s for count in range(1, len(stamps_s) + 1)]
    assert usual_s[3] == pytest.approx(0.0001) and usual_s[-1] == pytest.approx(0.1, rel=0.01)


def test_intervals_shorter_than_any_lidars_show_a_gap_once_a_few_are_known():
    assert [fed(0.001 * np.arange(count)).is_gap(1.0) for count in (2, 4, 5, 9)] == [False, False, True, True]


def test_scans_without_stamps_are_predicted_by_the_times_of_the_log(office_drive):
    stamped = office_drive.tracked(changes=NO_WHEELS)
    unstamped = office_drive.tracked([replace(scan, stamp_ns=0) for scan in office_drive.scans], NO_WHEELS)
    assert lie.apart(stamped[-1].T_odom_lidar, unstamped[-1].T_odom_lidar)[0] < 0.01


@pytest.mark.parametrize("odd_ns", [1_000, -3_600_000_000_000])
def test_a_stamp_that_makes_no_sense_moves_nothing(town_drive, odd_ns):
    scans = [*town_drive.scans]
    scans[30] = replace(scans[30], stamp_ns=scans[29].stamp_ns + odd_ns)
    steps = town_drive.tracked(scans, NO_WHEELS)
    assert {step.state for step in steps} == {State.OK}
    poses = town_drive.truth.poses[0] @ np.array([step.T_odom_lidar for step in steps])
    off_m = np.linalg.norm(lie.between(poses, town_drive.truth.poses[: len(poses)])[:, :3, 3], axis=1)
    assert np.delete(off_m, 30).max() < 0.05


@pytest.mark.parametrize(("early", "apart_ns"), [(1, 1_000_000), (3, 1_000), (6, 1_000_000)])
def test_a_burst_at_the_start_of_a_log_is_no_usual_interval(drive, early, apart_ns):
    usual, burst = drive.scans[:50], drive.scans[:50]
    for k, scan in enumerate(usual[:early]):
        late_ns = usual[early].stamp_ns - (early - k) * apart_ns - scan.stamp_ns
        burst[k] = replace(scan, stamp_ns=scan.stamp_ns + late_ns, log_time_ns=scan.log_time_ns + late_ns)
    for timed in (lambda scan: scan, lambda scan: replace(scan, times_s=scan.times_s[:0])):
        steps, wanted = drive.tracked(map(timed, burst)), drive.tracked(map(timed, usual))
        assert lie.apart(steps[-1].T_odom_lidar, wanted[-1].T_odom_lidar)[0] < 0.03
        assert State.LOST not in {step.state for step in steps}


ROOM = np.random.default_rng(1).uniform(-8.0, 8.0, (400, 3)).round()  # points on planes


def live(stamps_s, span_s=0.0, kind=sc.Odometry):
    """What was given a scan at each of these stamps, its points measured over so many seconds."""
    made = kind()
    for stamp_s in stamps_s:
        made.process(sc.Scan.of(ROOM, stamp_s, np.linspace(0.0, span_s, len(ROOM)) if span_s else None))
    return made


@pytest.mark.parametrize(
    ("stamps_s", "span_s", "words"),
    [
        ([5.0, 5.0], 0.0, "stamp_s is 5.0+, that of the scan before 5.0+; wanted seconds that increase"),
        ([5.0, 4.9], 0.0, "stamp_s is 4.9"),
        (1e3 * np.arange(0.0, 0.5, 0.1), 0.0, "stamp_s grows by 100 from scan to scan.*1e-3"),
        (1e9 * np.arange(0.0, 0.1, 0.02), 0.0, r"stamp_s grows by 2e\+07 from scan to scan.*nanoseconds: 1e-9"),
        (
            np.arange(0.0, 0.5, 0.1),
            1.0,
            "times_s spans 1 s, but scans follow each other within 0.1 s.*from 0 to 1",
        ),
        ([1.7e12], 0.0, "stamp_s is 17.*from milliseconds: 1e-3"),
    ],
)
def test_stamps_and_times_that_cannot_be_seconds_are_refused(stamps_s, span_s, words):
    for kind in (sc.Odometry, sc.Slam):
        with pytest.raises(InputError, match=words):
            live(stamps_s, span_s, kind)


@pytest.mark.parametrize(
    "stamps_s",
    [
        [0.0, 0.1, 0.2, 300.0, 300.1, 300.2],  # a gap of minutes
        [0.0, 60.0, 75.0, 130.0],  # stop and go
        [0.0, 0.02, 0.04, 0.3, 0.4],  # stamps on arrival, after a burst
        [0.0, 0.001, 0.002, 0.003, 0.004, 0.1, 0.2],
    ],
)
def test_gaps_and_bursts_are_stamps_too(stamps_s):
    assert live(stamps_s, 0.05).scans == len(stamps_s)


def test_a_scan_that_was_refused_is_forgotten():
    odometry = live([0.0, 0.1])
    for _ in range(2):
        with pytest.raises(InputError, match="wanted seconds that increase"):
            odometry.process(sc.Scan.of(ROOM, 0.1))
    assert odometry.process(sc.Scan.of(ROOM, 0.2)).scan.index == 2
