"""The doctor's checks of the scans: damage, frames, returns, ranges, copies."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from scanchain.config import PreprocessConfig
from scanchain.data import MOST_COPIES
from scanchain.logs.bad_scans import are_millimeters, most_bad_scans
from scanchain.logs.doctor.finding import Finding, Severity
from scanchain.logs.doctor.statistics import Survey
from scanchain.words import counted

_MANY_LOST = 0.5
_MANY_UNUSED = 0.3  # share of unused returns, from which on a wider range is recommended
_SOME_BELOW = 0.05  # share of beams below range_min that is reported
_STUCK_SHARE = 0.01  # share of beams at one farthest range that is reported
_FEW_POINTS = 50


def check_scans(seen: Survey, preprocess: PreprocessConfig) -> Iterator[Finding]:
    """Every finding about the scans. ``preprocess`` is what a run of this log would use."""
    yield _damage(seen, preprocess)
    yield from _frames(seen)
    yield _returns(seen)
    yield _no_return(seen)
    yield _ranges(seen, preprocess)
    yield _duplicates(seen)


def _damage(seen: Survey, preprocess: PreprocessConfig) -> Finding:
    empty = sum(scan.kept == 0 for scan in seen.scans)
    low_m, high_m = preprocess.min_range_m, preprocess.max_range_m
    outside = sum(bool(scan.ranges_m[0] > high_m or scan.ranges_m[-1] < low_m) for scan in seen.scans)
    bad = len(seen.malformed) + empty + outside
    lines = list(seen.damage)
    if seen.malformed:
        lines.append(f"{counted(len(seen.malformed), 'malformed scan')} (the first: {seen.malformed[0]})")
    if empty:
        lines.append(f"{counted(empty, 'scan')} without a valid point")
    if outside:
        limits = f"preprocess.min_range_m ({low_m:g}) and preprocess.max_range_m ({high_m:g})"
        lines.append(f"{counted(outside, 'scan')} without a point between {limits}")
    if not lines:
        return Finding("damage", Severity.OK, f"{counted(len(seen.scans), 'scan')}, all readable and with points")
    messages = len(seen.scans) + len(seen.malformed)
    if bad > most_bad_scans(messages, seen.log.config):
        effect = "a run stops: these are more bad scans than log.max_bad_scans_percent allows"
        remedy = f"--log.max_bad_scans_percent {math.ceil(100 * bad / messages)}" if bad < messages else ""
        return Finding("damage", Severity.PROBLEM, "; ".join(lines), effect, remedy)
    effect = "what was damaged is left out, the rest is used"
    return Finding("damage", Severity.WARNING, "; ".join(lines), effect)


def _frames(seen: Survey) -> Iterator[Finding]:
    frames = sorted({scan.frame for scan in seen.scans})
    if len(frames) > 1:
        effect = "only the first frame's mounting is used; scans of the others are taken to sit there, too"
        yield Finding("frames", Severity.PROBLEM, f"scans in several frames: {', '.join(frames)}", effect)


def _returns(seen: Survey) -> Finding:
    undefined, zero = seen.share(lambda scan: scan.undefined), seen.share(lambda scan: scan.zero)
    below = seen.share(lambda scan: scan.below)
    kept = np.array([scan.kept for scan in seen.scans])
    found = f"{100 * undefined:.2g} % NaN or infinite, {100 * zero:.2g} % zero, "
    if below:
        found += (
            f"{100 * below:.2g} % below range_min ({np.median([scan.limits_m[0] for scan in seen.scans]):.3g} m), "
        )
    found += f"{int(np.median(kept)):,} valid a scan (median)"
    poor = kept < _FEW_POINTS
    few = int(np.count_nonzero(poor))
    if few:
        effect = f"{counted(few, 'scan')} with fewer than {_FEW_POINTS} returns: matches are weak there, or lost"
        return Finding("returns", Severity.WARNING, found, effect, _without_ends(seen, poor))
    if undefined + zero + below > _MANY_LOST:
        return Finding("returns", Severity.NOTE, found, "they are left out; what is left may determine too little")
    if below > _SOME_BELOW:
        return Finding(
            "returns", Severity.NOTE, found, "what lies below range_min is not used: the sensor's own limit"
        )
    return Finding("returns", Severity.OK, found)


def _without_ends(seen: Survey, poor: NDArray[np.bool_]) -> str:
    """The flags that leave out scans at the start and at the end, where these are the poor ones and no others."""
    good = np.flatnonzero(~poor)
    if not len(good) or poor[good[0] : good[-1] + 1].any():
        return ""
    start_s, end_s = (seen.into_log_s(int(seen.log_ns[place])) for place in (good[0], good[-1]))
    flags = [f"--start {math.floor(1e3 * start_s) / 1e3:g}"] if poor[0] else []
    return " ".join([*flags, *([f"--end {math.ceil(1e3 * end_s) / 1e3:g}"] if poor[-1] else [])])


def _no_return(seen: Survey) -> Finding:
    """Finding on beams that all have one farthest range, as of scanners that write a number for no return."""
    values = Counter(scan.farthest_m for scan in seen.scans if np.isfinite(scan.farthest_m))
    farthest_m = max(values, default=0.0)
    below_m = np.floor(1e3 * farthest_m) / 1e3  # the flag must lie below the stated range, to the last bit
    stuck = sum(scan.at_farthest for scan in seen.scans if scan.farthest_m == farthest_m)
    share = stuck / max(sum(scan.beams for scan in seen.scans), 1)
    stated_m = min((scan.limits_m[1] for scan in seen.scans), default=float("inf"))
    limit_m = min(stated_m, seen.log.config.max_range_m)
    if share < _STUCK_SHARE:
        return Finding("no return", Severity.OK, "no range is so frequent that it must mean no return")
    found = f"{100 * share:.2g} % of the beams have exactly {farthest_m:.6g} m, the farthest there is"
    if farthest_m >= limit_m:
        return Finding("no return", Severity.OK, f"{found}; range limits take it out")
    effect = "if it stands for no return, it is taken for a wall that moves along"
    return Finding("no return", Severity.WARNING, found, effect, f"--log.max_range_m {below_m:g}")


def _ranges(seen: Survey, preprocess: PreprocessConfig) -> Finding:
    ranges_m = np.array([scan.ranges_m for scan in seen.scans if scan.kept], np.float64)
    near_m, far_m = np.median(ranges_m[:, [1, 99]], axis=0).tolist() if len(ranges_m) else (np.nan, np.nan)
    found = f"98 % of the returns lie between {near_m:.3g} and {far_m:.4g} m (medians)"
    low_m, high_m = preprocess.min_range_m, preprocess.max_range_m
    if far_m > high_m:
        unused = float(np.mean(ranges_m > high_m))
        effect = f"{100 * unused:.3g} % lie beyond {high_m:g} m and are not used"
        if are_millimeters(float(np.median(ranges_m)), preprocess):
            return Finding("ranges", Severity.PROBLEM, found, f"{effect}: millimeters? convert them to meters")
        remedy = f"--preprocess.max_range_m {np.ceil(far_m):g}" if unused > _MANY_UNUSED else ""
        return Finding("ranges", Severity.NOTE, found, effect, remedy)
    if near_m < low_m:
        unused = float(np.mean(ranges_m < low_m))
        effect = f"{100 * unused:.3g} % lie nearer than {low_m:g} m and are not used (right for the robot itself)"
        remedy = f"--preprocess.min_range_m {0.9 * near_m:.2g}" if unused > _MANY_UNUSED else ""
        return Finding("ranges", Severity.NOTE, found, effect, remedy)
    return Finding("ranges", Severity.OK, found)


def _duplicates(seen: Survey) -> Finding:
    digests = [scan.digest for scan in seen.scans]
    runs = [len(list(copies)) for _, copies in groupby(digests)]
    same = len(digests) - len(runs)
    if not same:
        return Finding("duplicates", Severity.OK, "no scan is the one before once more")
    found = f"{same} of {len(digests):,} scans are the one before once more, to the last bit"
    if max(runs) > MOST_COPIES:
        found += f", {max(runs):,} of them in a row"
        effect = "the driver was stuck, or a simulation without noise at rest: the trajectory stands still there"
        return Finding("duplicates", Severity.WARNING, found, effect)
    effect = "a copy looks like a stop: the prediction at constant velocity stands still, then has to catch up"
    every = round(len(digests) / (len(digests) - same))
    remedy = f"--every {every}" if every > 1 else ""
    return Finding("duplicates", Severity.WARNING, found, effect, remedy)
