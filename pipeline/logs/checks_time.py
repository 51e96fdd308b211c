"""The doctor's checks of time: rate, gaps, jitter, stamps, clocks, per-point times, wheels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.logs.finding import Finding, Severity
from pipeline.logs.survey import Survey
from pipeline.words import counted

_GAP_PERIODS = 2.5
_JITTER = 0.1  # of the period
_LONG_GAP_S, _LONG_GAP_ON_WHEELS_S = 0.5, 10.0
_SLOW_HZ = 4.0
_OTHER_CLOCK_S = 1.0
_LATE_S = 0.2
_PART_OF_SCAN, _MORE_THAN_SCAN = 0.3, 1.2  # of the period, where a unit of time is hard to believe
_SPINS_AT_S = (0.04, 0.25)
_NEAR_NS = 500_000_000  # as far as a run looks for the wheels' reading


def check_time(seen: Survey) -> Iterator[Finding]:
    """Every finding about time."""
    yield _rate(seen)
    yield _gaps(seen)
    yield _jitter(seen)
    yield _order(seen)
    yield _clock(seen)
    yield _wheels(seen)
    if seen.log.dimension == 3:
        yield _point_times(seen)


def _rate(seen: Survey) -> Finding:
    rate_hz = 1.0 / seen.period_s if seen.period_s else 0.0
    found = f"{counted(len(seen.scans), 'scan')}, {rate_hz:.4g} Hz (median period {seen.period_s * 1e3:.4g} ms)"
    if len(seen.scans) > 1 and rate_hz < _SLOW_HZ and not seen.wheels:
        effect = "the motion between two scans is long and predicted without wheels; fast turns may get lost"
        return Finding("rate", Severity.NOTE, found, effect, "--matching.wide_max_distance_m, larger")
    return Finding("rate", Severity.OK, found)


def _gaps(seen: Survey) -> Finding:
    steps_s = np.diff(seen.log_ns) * 1e-9
    gaps = np.flatnonzero(steps_s > _GAP_PERIODS * seen.period_s) if seen.period_s else np.empty(0, np.int64)
    if not len(gaps):
        return Finding("gaps", Severity.OK, f"none longer than {_GAP_PERIODS:g} periods")
    longest = gaps[np.argmax(steps_s[gaps])]
    at_s = seen.into_log_s(int(seen.log_ns[longest]))
    found = (
        f"{len(gaps):,} longer than {_GAP_PERIODS:g} periods, the longest {steps_s[longest]:.3g} s, "
        f"{at_s:.1f} s into the log"
    )
    predicted = f"the motion over a gap is predicted {'by the wheels' if seen.wheels else 'at constant velocity'}"
    if steps_s[longest] < (_LONG_GAP_ON_WHEELS_S if seen.wheels else _LONG_GAP_S):
        return Finding("gaps", Severity.NOTE, found, f"{predicted}; short ones do no harm")
    effect = f"{predicted}; after a long one the match may settle at a wrong place"
    return Finding(
        "gaps", Severity.WARNING, found, effect, f"--start or --end at {at_s:.1f} s, for the parts apart"
    )


def _jitter(seen: Survey) -> Finding:
    steps_s = np.diff(seen.stamps_ns) * 1e-9
    usual = steps_s[(steps_s > 0.0) & (steps_s < _GAP_PERIODS * seen.period_s)]
    if not len(usual):
        return Finding("jitter", Severity.OK, "too few scans to tell")
    jitter = float(np.std(usual)) / seen.period_s
    found = (
        f"stamps are {1e3 * jitter * seen.period_s:.3g} ms ({100.0 * jitter:.2g} % of the period) off an even beat"
    )
    if jitter < _JITTER:
        return Finding("jitter", Severity.OK, found)
    effect = "speeds come out uneven, so that the prediction at constant velocity is off by as much"
    remedy = "" if seen.wheels else "--odometry.velocity_sigma_m, larger"
    return Finding("jitter", Severity.NOTE, found, effect, remedy)


def _order(seen: Survey) -> Finding:
    steps_ns = np.diff(seen.stamps_ns)
    backwards, repeated = int(np.count_nonzero(steps_ns < 0)), int(np.count_nonzero(steps_ns == 0))
    if not backwards and not repeated:
        return Finding("stamp order", Severity.OK, "header stamps rise from scan to scan")
    found = f"{counted(backwards, 'step')} back in the header stamps, {repeated:,} repeated"
    effect = "scans are taken in the order of log time; poses in the results hold at stamps that are not in order"
    severity = Severity.PROBLEM if repeated == len(steps_ns) else Severity.WARNING
    remedy = "record with stamps: the driver left them out" if severity == Severity.PROBLEM else ""
    return Finding("stamp order", severity, found, effect, remedy)


def _clock(seen: Survey) -> Finding:
    """Header stamp against log time."""
    late_s = (seen.log_ns - seen.stamps_ns) * 1e-9
    least, median, most = (float(value) for value in np.percentile(late_s, [0.0, 50.0, 100.0]))
    found = f"logged {median:.4g} s after the header stamp (from {least:.4g} to {most:.4g} s)"
    if abs(median) > _OTHER_CLOCK_S:
        effect = (
            "header stamps are of another clock than log times: --start and --end count by log time, results by "
        )
        effect += "header stamps, and wheels or ground truth of the recorder's clock do not meet the scans"
        return Finding(
            "clock", Severity.WARNING, found, effect, "--odometry.prior constant-velocity if wheels miss"
        )
    if most - least > _LATE_S:
        effect = "some scans were recorded late; results hold at header stamps and do not suffer"
        return Finding("clock", Severity.NOTE, found, effect)
    return Finding("clock", Severity.OK, found)


def _wheels(seen: Survey) -> Finding:
    if not seen.log.odometry_topic:
        effect = "the motion is predicted from the scans alone"
        return Finding("wheels", Severity.OK, "no wheel odometry", effect)
    stamps_ns = np.sort(np.array([pose.stamp_ns for pose in seen.wheels], np.int64))
    topic = seen.log.odometry_topic
    if not len(stamps_ns):
        return Finding("wheels", Severity.WARNING, f"{topic} has no readable pose", "it is as if there were none")
    after = np.searchsorted(stamps_ns, seen.stamps_ns)
    before_ns = np.abs(seen.stamps_ns - stamps_ns[np.maximum(after - 1, 0)])
    after_ns = np.abs(stamps_ns[np.minimum(after, len(stamps_ns) - 1)] - seen.stamps_ns)
    scans = counted(len(seen.scans), "scan")
    missed = int(np.count_nonzero(np.minimum(before_ns, after_ns) > _NEAR_NS))
    found = f"{topic}: {counted(len(stamps_ns), 'reading')}, {missed} of {scans} without one within 0.5 s"
    if not missed:
        return Finding("wheels", Severity.OK, found)
    effect = "the motion of those scans is predicted from the scans alone"
    remedy = "--odometry.prior constant-velocity, if the two clocks differ"
    return Finding("wheels", Severity.WARNING, found, effect, remedy)


def _point_times(seen: Survey) -> Finding:
    spans_s = np.array([scan.time_span_s for scan in seen.scans])
    spans_s = spans_s[np.isfinite(spans_s)]
    if not len(spans_s):
        low_s, high_s = _SPINS_AT_S
        revolution_s = f"{seen.period_s:.3g}" if low_s < seen.period_s < high_s else "0.1"
        effect = "scans are not freed of the lidar's own motion; fast driving bends them"
        remedy = (
            f"--log.point_times clockwise --log.revolution_s {revolution_s}, if it spins and nothing did it yet"
        )
        return Finding("point times", Severity.NOTE, "none", effect, remedy)
    span_s = float(np.median(spans_s))
    found = f"{seen.point_times.removeprefix('point times: ')}; a scan lasts {1e3 * span_s:.4g} ms"
    part = span_s / seen.period_s if seen.period_s else 1.0
    if _PART_OF_SCAN < part < _MORE_THAN_SCAN:
        return Finding("point times", Severity.OK, found)
    found += f", {part:.2g} of the period"
    effect = "if that is the wrong unit, deskewing bends every scan instead of straightening it"
    remedy = "--log.point_times s, ms, us or ns, or none"
    return Finding("point times", Severity.WARNING, found, effect, remedy)
