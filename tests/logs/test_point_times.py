"""Times of points that a majority, the period or neighbors refute: repaired, left out, or not used."""

import re

import numpy as np
import pytest

import scanchain
from scanchain.logs import open_log
from tests.support.naive_logs import SECOND, STAMP_NS, cloud_said, laser_scan, point_cloud, scan_said, write
from tests.support.scenes import shared_data

ROW = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", "u4")]
COUNT, POINTS, PERIOD_NS = 20, 1000, SECOND // 10
TRUE_S = np.linspace(0.0, 0.0999, POINTS)
LEFT_OUT, REPAIRED, UNUSED = "these points are left out", "repaired", "matched without them"


def swept(folder, change, *, scans=COUNT, period_ns=PERIOD_NS, order=slice(None), kind="i8"):
    """A log of sweeps in the order of firing; ``change`` makes the times of scan k in ns of the true ones."""
    said, rng = [], np.random.default_rng(1)
    for k in range(scans):
        rows = np.zeros(POINTS, [*ROW[:3], ("t", kind)])
        for name in "xyz":
            rows[name] = rng.uniform(1.0, 20.0, POINTS)
        rows["t"] = change(k, np.rint(1e9 * TRUE_S).astype(np.int64))
        stamp_ns = STAMP_NS + k * period_ns
        rows = rows.astype([(name, "u4" if name == "t" and kind == "i8" else t) for name, t in rows.dtype.descr])
        said.append(cloud_said(stamp_ns, point_cloud(stamp_ns, rows[order])))
    log = open_log(write(folder / "a.mcap", said))
    return log, list(log.scans())


def bad(count, at_ns, every=1):
    """That many points of every n-th sweep have other times, the same for all or random ones below ``at_ns``."""

    def change(k, t):
        t = t.astype(np.float64)
        if k % every == 0:
            places = np.random.default_rng(k).choice(POINTS - 2, count, replace=False) + 1
            t[places] = at_ns if count == 1 else np.linspace(0.5, 1.0, count) * at_ns
        return t

    return change


def of_notes(log):
    return [line for line in log.notes if line.startswith("times of")]


@pytest.mark.parametrize("kind", ["i8", "f8"])
@pytest.mark.parametrize(
    ("count", "at_ns", "every"),
    [(1, 3.6e9, 100), (1, 0.14e9, 1), (1, 0.3e9, 5), (20, 4.2e9, 10), (100, 4.2e9, 1), (1, 4.2e9, 1)],
)
def test_a_few_points_with_other_times_are_left_out_counted_and_named(tmp_path, kind, count, at_ns, every):
    log, scans = swept(tmp_path, bad(count, at_ns, every), kind=kind)
    hit = -(-COUNT // every)
    assert sum(len(scan.points) for scan in scans) == COUNT * POINTS - hit * count
    assert sum(scan.dropped for scan in scans) == hit * count
    for scan in scans:
        assert len(scan.times_s) == len(scan.points) and np.ptp(scan.times_s) <= 0.1
    (line,) = of_notes(log)
    assert f"in {hit} of {COUNT} scans of /points" in line and LEFT_OUT in line and "the first: scan 0" in line
    assert log.damage == []


@pytest.mark.parametrize(
    ("clock_s", "unit_s", "step_ms"),
    [(0.0, 1.0, ""), (5e3, 1.0, ""), (43_200.0, 1.0, "3.9"), (345_600.0, 1.0, "31"), (345_600.0, 1e-3, "32")],
)
def test_times_of_a_clock_that_float32_does_not_resolve_are_a_warning(tmp_path, clock_s, unit_s, step_ms):
    def change(k, t):
        return (clock_s + k * 1e-9 * PERIOD_NS * (clock_s > 0.0) + 1e-9 * t) / unit_s

    log, _ = swept(tmp_path, change, kind="f4")
    assert [f"are {step_ms} ms apart, as float32 is" in line for line in log.damage] == [True] * bool(step_ms)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -5.0, -0.06, 50.0, 1e30])
def test_a_point_whose_time_is_no_number_or_negative_costs_no_other_point_its_time(tmp_path, value):
    def change(k, t):
        times_s = 1e-9 * t
        times_s[500] = value
        return times_s

    log, scans = swept(tmp_path, change, kind="f4")
    for scan in scans:
        np.testing.assert_allclose(scan.times_s, np.delete(TRUE_S, 500), atol=1e-7)
    assert LEFT_OUT in of_notes(log)[0] and "taken as s after the stamp" in "".join(log.notes)


def running(offset_ns, unit_ns, most):
    """A counter that runs from sweep to sweep and wraps."""
    return lambda k, t: (offset_ns + k * PERIOD_NS + t) // unit_ns % most


IN_RINGS = np.argsort(np.arange(POINTS) % 10, kind="stable")


@pytest.mark.parametrize(
    ("change", "repaired"),
    [
        (running((1 << 32) - int(1.25e9), 1, 1 << 32), 1),
        (running(1000 * (1 << 32) - int(0.75e9), 1000, 1 << 32), 1),
        (running(int(3598.75e9), 1000, 3_600_000_000), 1),  # since the full hour
        (running(int(0.25e9), 1, 1_000_000_000), 2),  # the nanoseconds of a second
        (lambda k, t: np.where((t > 5e7) & (k % 5 == 3), t - 5e7, t), 4),
        (lambda k, t: np.where((t > 3e7) & (k == 0), t - 3e7, t), 1),
        (lambda k, t: (t - 50_000_000) % (1 << 32) if k % 5 == 3 else t, 4),
    ],
)
def test_a_counter_that_wraps_or_is_reset_within_a_sweep_is_repaired(tmp_path, change, repaired):
    log, scans = swept(tmp_path, change)
    for scan in scans:
        np.testing.assert_allclose(scan.times_s, TRUE_S, atol=6e-4)
    (line,) = of_notes(log)
    assert f"times of {repaired} of {COUNT} scans of /points" in line and REPAIRED in line


def test_a_wrap_among_rings_costs_points_of_that_sweep_alone_and_is_said(tmp_path):
    log, scans = swept(tmp_path, running((1 << 32) - int(1.27e9), 1, 1 << 32), order=IN_RINGS)
    assert [k for k, scan in enumerate(scans) if len(scan.times_s) < POINTS] == [12]
    for scan in scans:
        assert len(scan.times_s) == len(scan.points) > POINTS // 2 and np.ptp(scan.times_s) < 0.1
    assert f"in 1 of {COUNT} scans" in of_notes(log)[0] and LEFT_OUT in of_notes(log)[0]


def test_a_reset_among_rings_costs_the_times_of_that_sweep_alone_and_is_said(tmp_path):
    log, scans = swept(tmp_path, lambda k, t: np.where((t > 5e7) & (k == 3), t - 5e7, t), order=IN_RINGS)
    assert [k for k, scan in enumerate(scans) if not len(scan.times_s)] == [3]
    assert f"times of 1 of {COUNT} scans" in of_notes(log)[0] and UNUSED in of_notes(log)[0]


@pytest.mark.parametrize(
    "junk",
    [
        lambda t: 0 * t,
        lambda t: 0 * t + 77_777_777,
        lambda t: np.random.default_rng(0).integers(0, 1 << 32, POINTS),
        lambda t: t + 500_000_000,
    ],
)
def test_a_sweep_whose_times_are_beyond_repair_has_none_and_its_neighbors_keep_theirs(tmp_path, junk):
    log, scans = swept(tmp_path, lambda k, t: junk(t) if k in (0, 7, 8) else t)
    assert [k for k, scan in enumerate(scans) if not len(scan.times_s)] == [0, 7, 8]
    assert all(len(scan.points) == POINTS for scan in scans)
    (line,) = of_notes(log)
    assert line.startswith(f"times of 3 of {COUNT} scans of /points") and UNUSED in line


HEALTHY = {
    "in the order of rings": {"order": IN_RINGS},
    "backward": {"order": slice(None, None, -1)},
    "by chance": {"order": np.random.default_rng(0).permutation(POINTS)},
    "two lidars": {"order": np.r_[0:POINTS:2, 1:POINTS:2]},
    "at a low rate": {"period_ns": SECOND},
    "of a sliding window": {"period_ns": SECOND // 15},
    "seen to one side": {"order": np.r_[:300, 990:1000]},
    "mostly to one side": {"order": np.r_[:400, 400:1000:20]},
    "stamped in the middle": {"change": lambda k, t: t - 50_000_000, "kind": "i4"},
    "twice as long once": {"change": lambda k, t: 2 * t if k == 5 else t},
}


@pytest.mark.parametrize("name", HEALTHY)
def test_healthy_times_are_neither_changed_nor_spoken_of(tmp_path, name):
    options = {"change": lambda k, t: t, "order": slice(None)} | HEALTHY[name]
    change, order = options["change"], options["order"]
    log, scans = swept(tmp_path, **options)
    for k, scan in enumerate(scans):
        wanted_s = 1e-9 * change(k, np.rint(1e9 * TRUE_S).astype(np.int64))[order]
        assert np.array_equal(scan.times_s, wanted_s.astype(np.float32))
    assert of_notes(log) == [] and log.damage == []


# laser scans


def scanned(folder, *, increment=1.0, scan_time_s=0.1, **config):
    """Times of 20 laser scans of three quarters of a turn at 10 Hz, with a right increment times ``increment``."""
    said = []
    for k in range(COUNT):
        stamp_ns = STAMP_NS + k * PERIOD_NS
        factor = increment(k) if callable(increment) else increment
        options = {"first": -2.3, "step": 1.5 * np.pi / 540, "beam_s": factor * 0.075 / 540}
        data = bytearray(laser_scan(stamp_ns, np.full(541, 2.0), **options))
        place = data.find(np.float32(0.1).tobytes(), 40)  # scan_time, behind time_increment
        data[place : place + 4] = np.float32(scan_time_s).tobytes()
        said.append(scan_said(stamp_ns, bytes(data)))
    log = open_log(write(folder / "a.mcap", said), **config)
    scans = list(log.scans())
    return log, scans, [float(np.ptp(scan.times_s)) if len(scan.times_s) else 0.0 for scan in scans]


@pytest.mark.parametrize("scan_time_s", [0.1, 0.0, 37.0])
@pytest.mark.parametrize("factor", [20.0, 0.05, 3.0, 0.25, 1e30, np.inf, np.nan])
def test_an_increment_that_the_period_refutes_is_ignored_which_is_told(tmp_path, factor, scan_time_s):
    log, _, spans_s = scanned(tmp_path, increment=factor, scan_time_s=scan_time_s)
    assert spans_s == [0.0] * COUNT
    assert log.notes[0] == "no point times: every scan counts as measured at once"
    assert UNUSED in of_notes(log)[0] and "period 0.1 s" in of_notes(log)[0]


@pytest.mark.parametrize("scan_time_s", [0.1, 0.0, 37.0, np.nan])
def test_an_increment_that_agrees_with_the_period_is_used_whatever_scan_time_says(tmp_path, scan_time_s):
    log, _, spans_s = scanned(tmp_path, scan_time_s=scan_time_s)
    np.testing.assert_allclose(spans_s, 0.075, rtol=1e-5)
    told = of_notes(log)
    assert log.notes == told and len(told) == (scan_time_s not in (0.1, 0.0))
    assert all("not with scan_time, which is ignored" in line for line in told)


def test_increments_in_nanoseconds_are_known_by_the_period_and_one_bad_scan_by_the_others(tmp_path):
    log, _, spans_s = scanned(tmp_path, increment=1e9, scan_time_s=1e8)
    np.testing.assert_allclose(spans_s, 0.075, rtol=1e-5)
    assert log.notes == ["point times: time_increment taken as ns (log.point_times)"]
    log, _, spans_s = scanned(tmp_path, increment=lambda k: 20.0 if k == 0 else 1.0)
    np.testing.assert_allclose(spans_s, [0.0] + 19 * [0.075], rtol=1e-5)
    assert f"times of 1 of {COUNT} scans" in of_notes(log)[0] and UNUSED in of_notes(log)[0]


@pytest.mark.parametrize(("choice", "span_s"), [("none", 0.0), ("s", 0.075), ("counterclockwise", 0.075)])
def test_the_choice_of_point_times_rules_laser_scans_too(tmp_path, choice, span_s):
    log, _, spans_s = scanned(tmp_path, point_times=choice, revolution_start_rad=-2.3)
    np.testing.assert_allclose(spans_s, span_s, rtol=1e-3)
    assert ("no point times" in "".join(log.notes)) == (choice == "none")


def test_laser_scans_without_times_are_told_of_like_clouds(tmp_path):
    log, _, spans_s = scanned(tmp_path, increment=0.0)
    assert spans_s == [0.0] * COUNT and log.notes == ["no point times: every scan counts as measured at once"]


# the reports


def ate_m(path, folder):
    done = scanchain.run(path, folder, recording=False, force=True)
    return float(re.search(r"ATE odometry +rmse ([\d.]+)", done.summary)[1]), done.summary


def test_one_bad_point_of_a_log_costs_no_accuracy(tmp_path):
    good, _ = ate_m(shared_data("reports/f1_good.mcap"), tmp_path / "good")
    worse, summary = ate_m(shared_data("reports/f1_one_point.mcap"), tmp_path / "bad")
    assert worse < 1.1 * good and "times of 1 point in 1 of 26 scans of /points" in summary


def test_laser_scans_with_increments_in_nanoseconds_are_read_and_as_good_as_with_seconds(tmp_path):
    error_m, summary = ate_m(shared_data("reports/f2_ydlidar.mcap"), tmp_path / "run")
    assert error_m < 0.005 and "time_increment taken as ns" in summary
