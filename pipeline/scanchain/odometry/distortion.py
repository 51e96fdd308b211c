"""Distortion of scans by the lidar's own motion: how large it is, and which times of their points explain them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config, LogConfig
from scanchain.data import Pose, Scan
from scanchain.errors import InputError
from scanchain.logs import Log
from scanchain.logs.messages.point_times import from_azimuth
from scanchain.odometry.odometry import Odometry
from scanchain.settings import load_settings

_AT = (0.5, 0.25, 0.75, 0.0, 1.0, 0.375, 0.625)  # where windows lie in the log, in the order of their trial
_ENOUGH, _MOST, _SCANS = 3, 5, 16  # windows in which the lidar moves: enough where they are clear; scans of each
_BEGIN, _BLOCK = 4, 3  # first scans of a window, whose map is small, and scans whose residuals count as one value
_POINTS, _MATCHED = 8_000, 500  # points of a scan, at random, and those that are matched
_LEAST_M = 0.03  # distortion of a scan below which it is lost in the noise of the ranges
_CLEAR = 3.5  # standard errors of a mean difference that is clear: of 12 values by chance in 1 of 400
_LEAST_GAIN = 0.01  # share of the residuals by which times that are adopted lower them
_MOST_LOSS = 5.0  # loss by opposite times over the gain: 3 where these remove all distortion, 5 at three quarters
_SPINS_AT_S = (0.02, 0.25)  # periods that are those of a revolution
_SURE = 0.9  # least agreement of the azimuths at which scans begin
_AROUND = 0.8  # least share of the directions that a lidar sees which looks around


@dataclass(frozen=True, slots=True)
class Distortion:
    """Distortion of the scans of a log, and whether times of their points explain it.

    size_m : in the most distorted window, where it is not removed; ``motion`` causes it, in words
    config : with the times that are tried: the log's own if ``is_given``, else by azimuth in the better sense
    gain, loss : relative changes of residuals from no times: decrease by these, increase by the opposite ones
    sigmas : gain over its standard error
    is_spinning : whether the scans look around and begin at one azimuth, as those of a spinning lidar
    """

    size_m: float
    motion: str
    config: LogConfig
    is_given: bool
    gain: float
    loss: float
    sigmas: float
    is_spinning: bool

    @property
    def share(self) -> float:
        """Of the distortion by these times, what residuals show: where the parabola through the three is least.

        1 where it has no least value, or is of times by azimuth for a lidar that does not spin.
        """
        if self.loss <= self.gain or not (self.is_given or self.is_spinning):
            return 1.0
        return min(0.5 * abs(self.loss + self.gain) / (self.loss - self.gain), 1.0)

    @property
    def is_shown(self) -> bool:
        """True if these times explain the scans clearly better than none, and as no others would."""
        is_clear = self.gain > _LEAST_GAIN and self.sigmas > _CLEAR
        return is_clear and 0.0 < self.loss < _MOST_LOSS * self.gain

    @property
    def is_refuted(self) -> bool:
        """True if no times explain the scans clearly better."""
        return self.sigmas < -_CLEAR

    def is_removed(self, log: Log) -> bool:
        """True if a run removes it by these times."""
        wanted = log.config.point_times
        is_chosen = wanted == "azimuth" or (wanted == "auto" and log.dimension == 3 and self.is_shown)
        return self.is_given or (is_chosen and self.size_m > _LEAST_M)

    def advice(self, log: Log) -> tuple[str, str]:
        """Distortion and its correction by a run, in words, and the flag that improves it, empty for none."""
        size = f"distorted by up to {self.size_m:.2g} m per scan ({self.motion})"
        lack = "point times are not used" if log.config.point_times == "none" else "no point times"
        if self.size_m <= _LEAST_M:
            return f"scans are {size}, less than ranges scatter", ""
        if self.is_removed(log) and self.is_given and self.is_refuted:
            return "scans fit better without their point times", "--log.point_times none"
        if self.is_removed(log):
            return f"scans are {size}, which point times remove", ""
        if self.is_refuted:
            may_be = f"scans may be {size}, but not by a lidar that spins so"
            return f"{lack}: {'scans show no distortion' if self.is_spinning else may_be}", ""
        choice = "auto" if self.is_shown and log.dimension == 3 else "azimuth"
        return f"{lack}: scans {'are' if self.is_shown else 'may be'} {size}", f"--log.point_times {choice}"

    @property
    def changes(self) -> str:
        """Relative changes of the residuals, in words."""
        changes = (-self.gain, self.loss)
        gain, loss = (f"{abs(100 * each):.2g} % {'smaller' if each < 0 else 'larger'}" for each in changes)
        start_rad, turn_s = self.config.revolution_start_rad, self.config.revolution_s
        turn = f"times by azimuth, {self.config.point_times} from {start_rad:.3g} rad, {turn_s:.3g} s a turn"
        times = "their own times" if self.is_given else turn
        return f"with {times}, residuals are {gain} than without, and {loss} with the opposite times"


def measure_distortion(log: Log, *, of_given: bool = True) -> Distortion | None:
    """Distortion of a log's scans, by windows of it; None where too few scans follow one another.

    Odometry is run over the same scans with times, with none and with the opposite ones. Residuals are least with
    the right ones: with others the map shows a surface at another place from each position and heading.

    of_given : whether times that the log has are measured too; else None for such a log
    """
    config, rng, mounting = load_settings(log.dimension).config, np.random.default_rng(0), log.stated_mounting
    preprocess = msgspec.structs.replace(config.preprocess, match_points=_MATCHED, calibrate_elevation=False)
    config = msgspec.structs.replace(config, preprocess=preprocess)
    found, residuals, timing, is_spinning = None, list[NDArray[np.float64]](), log.config, False
    for window in log.windows(_AT, _SCANS):
        is_given = len(window[0].times_s) > 0
        if is_given and not of_given:
            return None
        if found is None and not is_given:
            timing, is_spinning = _by_azimuth(window, log.config)
        scans = [_prepared(scan, timing, rng) for scan in window]
        with suppress(InputError):  # no point in the range that is used
            without, size = _residuals(scans, 0.0, config, mounting)
            if size[0] > _LEAST_M:
                with_times = (_residuals(scans, sense, config, mounting)[0] for sense in (1.0, -1.0))
                three = np.array([without, *with_times])
                residuals += [np.log(three)] if three.all() else []
            size = size if found is None else max(size, (found.size_m, found.motion))
            found = _compared(residuals, size, timing, is_given, is_spinning)
            if len(residuals) == _MOST or (len(residuals) >= _ENOUGH and abs(found.sigmas) > _CLEAR):
                break
    return found


def _compared(
    residuals: Sequence[NDArray[np.float64]],
    size: tuple[float, str],
    timing: LogConfig,
    is_given: bool,
    is_spinning: bool,
) -> Distortion:
    """The distortion by logarithms of residuals (3, N) of windows: with no times, with times and opposite ones."""
    without, ahead, back = np.concatenate(residuals, axis=1) if residuals else np.zeros((3, 2))
    if is_given or ahead.mean() <= back.mean():
        sense, better, worse = "clockwise", ahead, back
    else:
        sense, better, worse = "counterclockwise", back, ahead
    config = timing if is_given else msgspec.structs.replace(timing, point_times=sense)
    gain, loss, sigmas = (without - better).mean(), (worse - without).mean(), _sigmas(without - better)
    return Distortion(*size, config, is_given, float(gain), float(loss), sigmas, is_spinning)


def choose_point_times(log: Log, *, deskew: bool = True) -> None:
    """Time points by azimuth, where the log's clouds have no times and show clearly that they are distorted so.

    ``log.point_times`` ``azimuth`` does so in any case, in the better sense, ``none`` never. Notes of the log say
    what was found, ``log.distortion`` and ``log.distorted_share`` what remains. Planar scans without times may be
    distorted in any case, and scans with times where a run does not ``deskew`` them.
    """
    wanted = log.config.point_times
    is_open = wanted == "azimuth" or (wanted in ("auto", "none") and log.dimension == 3)
    if is_open and log.sectors is None and not log.is_mirrored:
        _adopt_point_times(log, wanted)
    if log.dimension == 2:
        log.distorted_share = _sweep_share(log, deskew=deskew)
    elif not deskew and (found := measure_distortion(log)) is not None and found.is_given:
        log.distorted_share = found.share * _sweep_share(log, deskew=deskew)


def _adopt_point_times(log: Log, wanted: str) -> None:
    found = measure_distortion(log, of_given=wanted != "auto")
    if found is None:
        return
    said, remedy = found.advice(log)
    is_removed, is_none = found.is_removed(log), found.is_refuted and found.is_spinning
    if found.size_m > _LEAST_M and not is_removed:
        log.distorted_share = found.share * _sweep_share(log)
        log.distortion = "" if is_none else f"{said}; try {remedy}" if remedy else said
    log.time_points(found.config if is_removed else log.config, f"{said}: {found.changes}")


def _sweep_share(log: Log, *, deskew: bool = True) -> float:
    """Duration of scans over the time from one to the next; 0 where their times deskew them."""
    for window in log.windows(_AT[:1], _SCANS):
        if not (deskew and len(window[0].times_s)):
            period_s = 1e-9 * float(np.median(np.diff([scan.stamp_ns for scan in window])))
            return min(_by_azimuth(window, log.config)[0].revolution_s / max(period_s, 1e-9), 1.0)
    return 0.0


def _by_azimuth(window: Sequence[Scan], config: LogConfig) -> tuple[LogConfig, bool]:
    """Clockwise times, a turn from scan to scan from where the data begin, and whether scans look like such turns.

    The beginning is as configured where scans do not agree in it, the turn where it would be none of a lidar.
    """
    period_s = 1e-9 * float(np.median(np.diff([scan.stamp_ns for scan in window]))) / config.every
    begins = np.exp(1j * np.array([np.arctan2(*scan.points[0, 1::-1]) for scan in window])).mean()
    seen = np.unique(np.floor(np.arctan2(*window[0].points[:, 1::-1].T) * (18.0 / np.pi)))  # of 36 directions
    timing = msgspec.structs.replace(
        config,
        point_times="clockwise",
        revolution_s=period_s if _SPINS_AT_S[0] < period_s < _SPINS_AT_S[1] else config.revolution_s,
        revolution_start_rad=float(np.angle(begins)) if abs(begins) > _SURE else config.revolution_start_rad,
    )
    return timing, bool(abs(begins) > _SURE and len(seen) > 36 * _AROUND)


def _prepared(scan: Scan, timing: LogConfig, rng: np.random.Generator) -> Scan:
    """Some points of a scan, timed by themselves or by azimuth, from the middle of the scan on."""
    chosen = np.flatnonzero(rng.random(len(scan.points)) * len(scan.points) < _POINTS)
    points = scan.points[chosen]
    times_s = scan.times_s[chosen] if len(scan.times_s) else from_azimuth(points, timing)
    times_s = times_s - np.float32(0.5) * (times_s.min() + times_s.max())
    return replace(scan, points=points, times_s=times_s, others=None)


def _residuals(
    scans: Sequence[Scan], sense: float, config: Config, T_base_lidar: Pose | None
) -> tuple[NDArray[np.float64], tuple[float, str]]:
    """Mean squared residuals of blocks of scans, their times multiplied; the distortion and the motion by it."""
    odometry = Odometry(config, T_base_lidar, dimension=scans[0].points.shape[1])
    tracked = [odometry.place(replace(scan, times_s=np.float32(sense) * scan.times_s)) for scan in scans]
    rms_m = np.array([each.match.residual_m for each in tracked[_BEGIN:]])
    blocks = [np.sqrt(np.mean(block**2)) for block in np.array_split(rms_m, len(rms_m) // _BLOCK)]
    seconds = max(1e-9 * (scans[-1].stamp_ns - scans[_BEGIN].stamp_ns), 1e-9)
    steps = [lie.apart(a.T_odom_lidar, b.T_odom_lidar) for a, b in pairwise(tracked[_BEGIN:])]
    m_s, rad_s = np.sum(steps, axis=0) / seconds
    range_m = float(np.median(np.linalg.norm(scans[-1].points, axis=1)))
    sweep_s = float(np.ptp(scans[0].times_s))
    speed, turn = f"at {m_s:.2g} m/s", f"at {np.degrees(rad_s):.2g} deg/s and a range of {range_m:.2g} m"
    return np.array(blocks), max((sweep_s * m_s, speed), (sweep_s * rad_s * range_m, turn))


def _sigmas(gains: NDArray[np.float64]) -> float:
    """Mean gain over its standard error; each counts up to the median size, since gains grow with the motion."""
    limit = float(np.median(np.abs(gains)))
    clipped = np.clip(gains, -limit, limit)
    return float(clipped.mean() / max(np.std(clipped, ddof=1) / np.sqrt(len(gains)), 1e-9))
