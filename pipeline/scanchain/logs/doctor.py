"""Diagnosis of a log: its faults, their effect on the result, and the flags that fix them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import groupby
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from scanchain.config import Config, LogConfig, PreprocessConfig
from scanchain.data import BRIDGED_S, GAP_INTERVALS, MOST_COPIES, Fixes, Scan, unit_of
from scanchain.errors import counted
from scanchain.files import Source
from scanchain.logs.bad_scans import most_bad_scans
from scanchain.logs.log import Log, open_log
from scanchain.logs.messages.point_times import UNITS_S
from scanchain.logs.messages.readers import is_scan
from scanchain.logs.mounting import Sensor
from scanchain.logs.stream import whole_span
from scanchain.range_noise import RangeNoise

_LONG_GAP_S = (0.5, 10.0)  # longest gap over which the motion is predicted reliably, and with wheels
_PARTS = (0.3, 1.2)  # scan duration over period outside which a time unit is implausible
_FASTEST_M_S = 100.0  # speed from wheel odometry above which its unit is implausible
_MANY_UNUSED = 0.3  # share of unused returns above which a wider range is recommended
_LEAST_DRIFT, _CLEAR_DRIFT, _LEAST_SPAN_S = 2e-5, 3.0, 10.0  # rate above those of quartzes, drift over jitter, log
_FEW_POINTS = 50  # number of returns below which matches are weak


class Severity(StrEnum):
    """Severity of a finding for a run."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check.

    check : subject of the check, in one or two words
    found : measurement, with units
    effect : effect on the result; empty if there is none
    fix : flags of ``scanchain run`` that fix it, exactly as typed; empty if none does
    """

    check: str
    severity: Severity
    found: str
    effect: str = ""
    fix: str = ""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Findings about a log, the most severe first; ``notes`` : assumptions made when opening it."""

    files: tuple[str, ...]
    topic: str
    dimension: int
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]


def examine(
    sources: Sequence[Source],
    config_of: Callable[[int], Config],
    log_config: LogConfig,
    progress: Callable[[int, int], None],
    distortion: Callable[[Log], tuple[str, str]] = lambda log: ("", ""),
    wheel_delay: Callable[[Log], float] = lambda log: 0.0,
) -> Diagnosis:
    """Diagnosis from every scan of a log. Raises InputError if a run could not open it either.

    config_of : configuration that a run would use for a log of a given dimension
    distortion : distortion of a log's scans by the lidar's motion, as text, and the flags that remove it
    wheel_delay : how late the stamps of its wheels are, in s
    """
    log = open_log(sources, replace(log_config, max_bad_scans_percent=100.0))
    notes = tuple(log.notes)
    seen = Survey(log)
    for scan in log.scans():
        seen.add(scan)
        progress(len(seen.log_times_ns), log.scan_count)
    config = config_of(log.dimension)
    seen.wheel_delay_s = wheel_delay(log)
    found = list(_check(seen, config, most_bad_scans(seen.messages, log_config)))
    if (measured := distortion(log))[0]:
        effect = "map and trajectory are distorted together, which residuals hardly show" if measured[1] else ""
        severity = Severity.WARNING if effect else Severity.OK
        found.append(Finding("distortion", severity, measured[0], effect, measured[1]))
    ordered = tuple(finding for grade in reversed(Severity) for finding in found if finding.severity is grade)
    return Diagnosis(tuple(map(str, log.paths)), log.topics, log.dimension, ordered, notes)


class Facts(NamedTuple):
    """Statistics of the returns of one scan."""

    valid: int  # number of valid returns
    invalid: int
    farthest_m: float
    at_farthest: int  # number of returns at that range
    ranges_m: NDArray[np.float32]  # (101,) percentiles
    time_span_s: float  # of the per-point times, NaN if there are none
    is_copy: bool  # bitwise copy of the previous scan


class Survey:
    """Statistics of the readable scans of a log, their times, and stamped wheel odometry poses (d, d+1)."""

    def __init__(self, log: Log) -> None:
        self.log, self.noise = log, RangeNoise()
        self.scans, self.log_times_ns, self.stamps_ns = list[Facts](), list[int](), list[int]()
        self.wheels: list[tuple[int, NDArray[np.float64]]] = []
        self.wheel_delay_s = 0.0
        self.inertial: list[tuple[NDArray[np.int64], float]] = []  # stamps, and size of the mean specific force
        self.fixes: list[Fixes] = []

    def add(self, scan: Scan) -> None:
        """Add the next scan."""
        self.log_times_ns.append(scan.log_time_ns)
        self.stamps_ns.append(scan.stamp_ns)
        self.noise = self.noise.measured(scan.points)
        if scan.T_odom_base is not None:
            self.wheels.append((scan.stamp_ns, scan.T_odom_base[:-1]))
        if (found := scan.inertial) is not None:
            self.inertial.append((found.stamps_ns, float(np.linalg.norm(found.accelerations.mean(axis=0)))))
        if scan.fixes is not None:
            self.fixes.append(scan.fixes)
        ranges_m = np.sort(np.linalg.norm(scan.points, axis=1))
        at_farthest = int(np.count_nonzero(ranges_m > ranges_m[-1] - 1e-4))  # rounding of float32
        percentiles_m = ranges_m[np.linspace(0, len(ranges_m) - 1, 101).astype(int)]
        span_s = float(np.ptp(scan.times_s)) if len(scan.times_s) else math.nan
        counts, farthest_m = (len(ranges_m), scan.dropped), round(float(ranges_m[-1]), 4)
        self.scans.append(Facts(*counts, farthest_m, at_farthest, percentiles_m, span_s, scan.is_copy))

    @property
    def messages(self) -> int:
        """Number of scans, including unreadable ones."""
        return len(self.scans) + self.log.bad_scans

    @property
    def period_s(self) -> float:
        """Median time between scans by header stamps or, if these do not advance, by log times; 0 if unknown."""
        for times_ns in (self.stamps_ns, self.log_times_ns):
            steps_s = 1e-9 * np.array([step_ns for step_ns in np.diff(times_ns) if step_ns])
            if len(steps_s) and np.median(steps_s) > 0.0:
                return float(np.median(steps_s))
        return 0.0

    def log_time_s(self, index: int) -> float:
        """Log time of a scan since the first message, as for ``--start`` and ``--end``."""
        return (self.log_times_ns[index] - whole_span(self.log.indexes).begin_ns) * 1e-9


def _check(seen: Survey, config: Config, most_bad: float) -> Iterator[Finding]:
    """All findings about a log, for a run with ``config`` that may leave out up to ``most_bad`` scans."""
    yield _gaps(seen, bool(seen.wheels) and config.odometry.prior != "constant-velocity")
    yield _stamps(seen)
    yield _wheels(seen)
    if seen.log.imu is not None:
        yield _imu(seen, seen.log.imu)
    if seen.log.gnss is not None:
        yield _gnss(seen, seen.log.gnss)
    if seen.log.others:
        found, grade = "; ".join(seen.log.together.absences()), Severity.WARNING
        usual = Finding("lidars", Severity.OK, f"{seen.log.topics} are used together")
        yield Finding("lidars", grade, found, "other scans are matched with all lidars") if found else usual
    yield _point_times(seen)
    yield _damage(seen, config.preprocess, most_bad)
    yield _returns(seen)
    yield _noise(seen.noise, config.matching.sensor_noise_m)
    yield _no_return(seen)
    yield _ranges(seen, config.preprocess)
    yield _duplicates(seen)


def _gaps(seen: Survey, is_on_wheels: bool) -> Finding:
    logged_ns, stamps_ns = np.diff([seen.log_times_ns, seen.stamps_ns])  # scans logged in bursts have no gaps
    steps_s = 1e-9 * (np.minimum(logged_ns, stamps_ns) if stamps_ns.any() else logged_ns)
    gaps = np.flatnonzero(steps_s > GAP_INTERVALS * seen.period_s) if seen.period_s else np.empty(0, np.int64)
    periods = f"{GAP_INTERVALS:g} periods" + (f" of {seen.period_s:.3g} s" if seen.period_s else "")
    if not len(gaps):
        return Finding("gaps", Severity.OK, f"none longer than {periods}")
    longest = int(gaps[np.argmax(steps_s[gaps])])
    longest_s, at_s = steps_s[longest], seen.log_time_s(longest)
    found = f"{len(gaps):,} longer than {periods}, the longest {longest_s:.3g} s, {at_s:.1f} s into the log"
    effect = f"the motion over a gap is predicted {'by the wheels' if is_on_wheels else 'at constant velocity'}"
    if longest_s < _LONG_GAP_S[is_on_wheels]:
        return Finding("gaps", Severity.NOTE, found, effect)
    effect += (
        "; after a long gap a match may converge to a wrong pose: run the part before, as below, and the rest, "
        f"--start {math.floor(10.0 * (at_s + longest_s)) / 10.0:g}, separately"
    )
    return Finding("gaps", Severity.WARNING, found, effect, f"--end {math.ceil(10.0 * at_s) / 10.0:g}")


def _stamps(seen: Survey) -> Finding:
    """Finding on header stamps that go backward, jump, or advance at a different rate than log times."""
    if seen.log.jumps:
        effect = "speeds are by header stamps; gaps, --start and --end by log times: correct the wrong ones"
        if "jump" in seen.log.jumps[0]:
            effect = "the motion over a jump is unknown: a loop may join the segments; else run them separately"
        return Finding("stamps", Severity.WARNING, "; ".join(seen.log.jumps), effect)
    if 0 < (unset := seen.stamps_ns.count(0)) < len(seen.stamps_ns):
        effect = "no wheels and no true pose are paired with them"
        return Finding("stamps", Severity.NOTE, f"{counted(unset, 'scan')} with the stamp 0", effect)
    back_s = -1e-9 * np.diff(seen.stamps_ns)
    if count := int(np.count_nonzero(back_s > 0.0)):
        found = f"{counted(count, 'step')} back, by up to {back_s.max():.2g} s"
        return Finding("stamps", Severity.NOTE, found, "they jitter: scans are processed in the order of the log")
    if drift := _drift(seen):
        effect = (
            "stamps of another clock, as of wheels, match the scans in a part of the log only: synchronize both"
        )
        return Finding("stamps", Severity.NOTE, drift, effect)
    return Finding("stamps", Severity.OK, "none steps back")


def _drift(seen: Survey) -> str:
    """Drift of header stamps against log times, as text; empty where jitter hides it."""
    logged_s, stamps_s = 1e-9 * np.cumsum(np.diff([seen.log_times_ns, seen.stamps_ns]), axis=1)
    if (span_s := float(logged_s.max(initial=0.0))) < _LEAST_SPAN_S:
        return ""
    line = np.polyfit(logged_s, stamps_s - logged_s, 1)
    jitter_s, rate = np.std(stamps_s - logged_s - np.polyval(line, logged_s)), abs(line[0])
    if rate < max(_LEAST_DRIFT, _CLEAR_DRIFT * jitter_s / span_s):
        return ""
    faster = f"{1e6 * rate:,.0f} ppm {'faster' if line[0] > 0.0 else 'slower'}"
    return f"they advance {faster} than log times, by {rate * span_s:.2g} s over the log"


def _wheels(seen: Survey) -> Finding:
    log, scans = seen.log, counted(len(seen.scans), "scan")
    if not log.odometry_topic:
        effect = "the motion is predicted from the scans alone"
        return Finding("wheels", Severity.OK, "no wheel odometry", effect)
    missed = len(seen.scans) - len(seen.wheels)
    found = f"{log.wheels}: {missed} of {scans} without a reading within 0.5 s"
    without = "--odometry.prior constant-velocity"
    if (speed_m_s := _wheel_speed_m_s(seen)) > _FASTEST_M_S:
        found += f"; by them the robot moves at {speed_m_s:.3g} m/s"
        effect = "no vehicle is as fast: millimeters, or jumps? Poses are predicted far from the robot"
        return Finding("wheels", Severity.PROBLEM, found, effect, without)
    if len(seen.wheels) > 1 and not np.ptp([T for _, T in seen.wheels], axis=0).any():
        found += "; by them the robot never moves"
        return Finding("wheels", Severity.WARNING, found, "if it did, predictions are wrong", without)
    if delay_s := seen.wheel_delay_s or log.wheels_late_s:
        found += f"; its stamps are {abs(delay_s):.2f} s {'late' if delay_s > 0.0 else 'early'}"
        effect = "not used: another clock" if log.wheels_late_s else "they predict the motion of another time"
        fix = f"--log.odometry_delay_s {log.config.odometry_delay_s + delay_s:.2f}"
        return Finding("wheels", Severity.WARNING, found, effect, fix)
    if missed:
        return Finding("wheels", Severity.WARNING, found, "the motion of those is predicted from the scans alone")
    if log.stated_mounting is None:
        effect = "where the robot hardly turns, the mounting is not observable and assumed zero: record /tf_static"
        return Finding("wheels", Severity.NOTE, f"{found}; {log.mounting.note}", effect)
    return Finding("wheels", Severity.OK, found)


def _wheel_speed_m_s(seen: Survey) -> float:
    """Median speed of the robot while it moves, from wheel odometry; 0 if it never moves."""
    if not seen.wheels:
        return 0.0
    stamps_ns, order = np.unique([stamp_ns for stamp_ns, _ in seen.wheels], return_index=True)
    positions = np.array([seen.wheels[k][1][:, -1] for k in order])
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    moving = steps_m > 1e-3  # m
    return float(np.median(steps_m[moving] / (1e-9 * np.diff(stamps_ns)[moving]))) if moving.any() else 0.0


def _imu(seen: Survey, imu: Sensor) -> Finding:
    """Finding on the IMU: its samples, and whether they hold gravity, which a 3D run uses."""
    stamps_ns = np.concatenate([each for each, _ in seen.inertial] or [[]])
    if len(stamps_ns) < 2:
        return Finding(
            "IMU", Severity.WARNING, f"{imu.topic}: no samples of the time of the scans", "it is not used"
        )
    steps_s, force = 1e-9 * np.diff(stamps_ns), float(np.median([force for _, force in seen.inertial]))
    unit_m_s2 = unit_of(force)
    found = f"{imu.topic}: {_rate(stamps_ns, 'sample')}, {imu.place}, specific force {force:.3g}"
    found += " g: converted" if unit_m_s2 > 1.0 else " m/s²"
    grade, effect = Severity.OK, "used where it predicts motions better than the scans, which a run tests"
    if not unit_m_s2 and seen.log.dimension == 3:
        grade, effect = Severity.WARNING, "without gravity only its gyro can be used: choose its raw topic"
    if gaps := int(np.count_nonzero(steps_s > BRIDGED_S)):
        found += f"; {counted(gaps, 'gap')} of more than {BRIDGED_S:g} s, the longest {steps_s.max():.2g} s"
        grade, effect = Severity.WARNING, "the motion over a gap is predicted without it"
    return Finding("IMU", grade, found, effect)


def _gnss(seen: Survey, gnss: Sensor) -> Finding:
    """Finding on the GNSS receiver: its fixes, and the errors that it states."""
    stamps_ns = np.concatenate([each.stamps_ns for each in seen.fixes] or [[]])
    if len(stamps_ns) < 2:
        return Finding(
            "GNSS", Severity.WARNING, f"{gnss.topic}: no fixes of the time of the scans", "it is not used"
        )
    variances = np.concatenate([each.covariances for each in seen.fixes])[:, [0, 1], [0, 1]]
    stated = f"standard deviation {np.sqrt(np.median(variances)):.2g} m east and north (median)"
    longest_s = 1e-9 * float(np.diff(stamps_ns).max())
    found = (
        f"{gnss.topic}: {_rate(stamps_ns, 'fix', 'fixes')}, up to {longest_s:.2g} s apart, {gnss.place}, {stated}"
    )
    return Finding("GNSS", Severity.OK, found, "used where it agrees with the trajectory, which a run tests")


def _rate(stamps_ns: NDArray[np.float64], *words: str) -> str:
    """Number and rate of samples, as text."""
    return f"{counted(len(stamps_ns), *words)} at {1e9 / max(float(np.median(np.diff(stamps_ns))), 1.0):.3g} Hz"


def _point_times(seen: Survey) -> Finding:
    times, spans_s = seen.log.times, [scan.time_span_s for scan in seen.scans]
    untimed = int(np.count_nonzero(np.isnan(spans_s)))
    distorted = "scans are distorted by the lidar's motion, unless they are deskewed already or timed by azimuth"
    faults = times.faults(seen.log.topic)
    if untimed == len(spans_s) and not times.spans_s:
        grade = Severity.WARNING if faults else Severity.NOTE
        constant = times.assumed.removeprefix("no point times: ").rpartition("; ")[0]
        return Finding("point times", grade, "; ".join([constant or "none", *faults]), distorted)
    span_s = float(np.nanmedian(spans_s if untimed < len(spans_s) else times.spans_s))
    assumed = times.assumed.removeprefix("point times").lstrip(": ") or "time_increment of the beams"
    found = f"{assumed}; a scan lasts {1e3 * span_s:.4g} ms"
    part = span_s / seen.period_s if seen.period_s else 1.0
    if is_scan(seen.log.lidar) or _PARTS[0] < part < _PARTS[1]:
        grade = Severity.WARNING if untimed else Severity.NOTE if faults else Severity.OK
        effect = f"{counted(untimed, 'scan')} without: {distorted}" if untimed else "the rest is used"
        return Finding("point times", grade, "; ".join([found, *faults]), effect if faults else "")
    found = "; ".join([f"{found}, {part:.2g} of the period", *faults])
    effect = "if the unit is wrong, deskewing distorts every scan"
    return Finding("point times", Severity.WARNING, found, effect, _other_unit(times.assumed, part))


def _other_unit(assumed: str, part: float) -> str:
    """Flag for the time unit in which a scan lasts about a period, else to ignore times that are too long.

    part : scan duration over period in the assumed unit
    """
    current = next((unit for unit in UNITS_S if f"taken as {unit} " in assumed), "")
    if not current:
        return ""
    for unit, unit_s in UNITS_S.items():
        if unit != current and _PARTS[0] < part * unit_s / UNITS_S[current] < _PARTS[1]:
            return f"--log.point_times {unit}"
    return "--log.point_times none" if part > _PARTS[1] else ""


def _damage(seen: Survey, preprocess: PreprocessConfig, most_bad: float) -> Finding:
    low_m, high_m = preprocess.min_range_m, preprocess.max_range_m
    outside = sum(bool(scan.ranges_m[0] > high_m or scan.ranges_m[-1] < low_m) for scan in seen.scans)
    bad, lines = seen.log.bad_scans + outside, [line for line in seen.log.damage if line not in seen.log.jumps]
    if outside:
        limits = f"preprocess.min_range_m ({low_m:g}) and preprocess.max_range_m ({high_m:g})"
        lines.append(f"{counted(outside, 'scan')} without a point between {limits}")
    if not lines:
        return Finding("damage", Severity.OK, f"{counted(len(seen.scans), 'scan')}, all readable and with points")
    if bad > most_bad:
        effect = "a run stops: there are more bad scans than log.max_bad_scans_percent allows"
        percent = math.ceil(100 * bad / seen.messages)
        fix = f"--log.max_bad_scans_percent {percent}" if bad < seen.messages else ""
        return Finding("damage", Severity.PROBLEM, "; ".join(lines), effect, fix)
    effect = "damaged parts are left out, the rest is used"
    return Finding("damage", Severity.WARNING, "; ".join(lines), effect)


def _returns(seen: Survey) -> Finding:
    valid, invalid = np.array([(scan.valid, scan.invalid) for scan in seen.scans]).T
    lost = float(invalid.sum() / max((valid + invalid).sum(), 1))
    usual = f"{int(np.median(valid)):,} valid per scan (median)"
    found = f"{100 * lost:.2g} % of the beams without a valid return, {usual}"
    poor = valid < _FEW_POINTS
    if few := int(np.count_nonzero(poor)):
        effect = f"{counted(few, 'scan')} with fewer than {_FEW_POINTS} returns: matches are weak or lost there"
        return Finding("returns", Severity.WARNING, found, effect, _without_ends(seen, poor))
    return Finding("returns", Severity.OK, found)


def _without_ends(seen: Survey, poor: NDArray[np.bool_]) -> str:
    """Flags that cut off the poor scans at the start and end of a log; empty if there are others in between."""
    good = np.flatnonzero(~poor)
    if not len(good) or poor[good[0] : good[-1] + 1].any():
        return ""
    start_s, end_s = (seen.log_time_s(place) for place in (good[0], good[-1]))
    flags = [f"--start {math.floor(1e3 * start_s) / 1e3:g}"] if poor[0] else []
    return " ".join([*flags, *([f"--end {math.ceil(1e3 * end_s) / 1e3:g}"] if poor[-1] else [])])


def _noise(noise: RangeNoise, assumed_m: float) -> Finding:
    """Finding on the range noise, compared with the least noise that a run assumes."""
    found = f"standard deviation {noise.text}"
    if noise.sigma_m <= assumed_m:
        return Finding("noise", Severity.OK, found)
    effect = f"above matching.sensor_noise_m ({assumed_m:g}): a run uses the measured noise, and larger voxels"
    return Finding("noise", Severity.NOTE, found, effect)


def _no_return(seen: Survey) -> Finding:
    """Finding on many beams at the same farthest range, as of scanners that report one for no return."""
    values = Counter(scan.farthest_m for scan in seen.scans)
    farthest_m = max(values)
    stuck = sum(scan.at_farthest for scan in seen.scans if scan.farthest_m == farthest_m)
    share = stuck / max(sum(scan.valid + scan.invalid for scan in seen.scans), 1)
    if share < 0.01:
        return Finding("no return", Severity.OK, "no range is so frequent that it would indicate no return")
    found = f"{100 * share:.2g} % of the beams have exactly {farthest_m:.6g} m, the farthest range"
    effect = "if it indicates no return, it is matched like a wall that moves along"
    below_m = math.floor(1e3 * farthest_m - 0.5) / 1e3  # strictly below the range, despite rounding
    return Finding("no return", Severity.WARNING, found, effect, f"--log.max_range_m {below_m:g}")


def _ranges(seen: Survey, preprocess: PreprocessConfig) -> Finding:
    ranges_m = np.array([scan.ranges_m for scan in seen.scans], np.float64)
    near_m, far_m = np.median(ranges_m[:, [1, 99]], axis=0).tolist()
    found = f"98 % of the returns lie between {near_m:.3g} and {far_m:.4g} m (medians)"
    low_m, high_m = preprocess.min_range_m, preprocess.max_range_m
    if far_m > high_m:
        unused = float(np.mean(ranges_m > high_m))
        effect = f"{100 * unused:.3g} % lie beyond {high_m:g} m and are not used"
        if low_m <= 1e-3 * float(np.median(ranges_m)) <= high_m < near_m:
            return Finding("ranges", Severity.PROBLEM, found, f"{effect}: millimeters? convert them to meters")
        fix = f"--preprocess.max_range_m {np.ceil(far_m):g}" if unused > _MANY_UNUSED else ""
        return Finding("ranges", Severity.NOTE, found, effect, fix)
    if near_m < low_m:
        unused = float(np.mean(ranges_m < low_m))
        effect = f"{100 * unused:.3g} % lie nearer than {low_m:g} m and are not used (right for the robot itself)"
        fix = f"--preprocess.min_range_m {0.9 * near_m:.2g}" if unused > _MANY_UNUSED else ""
        return Finding("ranges", Severity.NOTE, found, effect, fix)
    return Finding("ranges", Severity.OK, found)


def _duplicates(seen: Survey) -> Finding:
    copies = [scan.is_copy for scan in seen.scans]
    same = sum(copies)
    if not same:
        return Finding("duplicates", Severity.OK, "no scan is a copy of the previous one")
    in_a_row = 1 + max(len(list(run)) for is_copy, run in groupby(copies) if is_copy)
    found = f"{same} of {len(copies):,} scans are bitwise copies of the previous one"
    if in_a_row > MOST_COPIES:
        found += f", {in_a_row:,} of them in a row"
        effect = "the driver was stuck, or a simulation without noise stood still: the trajectory does, too"
        return Finding("duplicates", Severity.WARNING, found, effect)
    effect = "a copy looks like a stop: the prediction at constant velocity is wrong there and after it"
    every = round(len(copies) / (len(copies) - same))
    fix = f"--every {every}" if every > 1 else ""
    return Finding("duplicates", Severity.WARNING, found, effect, fix)
