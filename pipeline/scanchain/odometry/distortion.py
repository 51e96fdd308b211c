"""Distortion of scans by the lidar's own motion: its size, and whether point times explain it."""

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
from scanchain.data import Pose, Scan, State
from scanchain.errors import InputError
from scanchain.logs import Log
from scanchain.logs.messages.point_times import from_azimuth
from scanchain.odometry.odometry import Odometry
from scanchain.settings import load_settings

WINDOWS_AT = (0.5, 0.25, 0.75, 0.0, 1.0, 0.375, 0.625)  # positions of windows in the log, in the order tried
_ENOUGH, _MOST, _SCANS = 3, 5, 16  # windows with motion: enough if significant, at most; scans each
_OPEN = {State.LOST, State.DEGENERATE}  # of scans whose residuals do not depend on all of their motion
_BEGIN, _BLOCK = 4, 3  # first scans of a window, skipped while its map is small; scans per residual block
_POINTS = 8_000  # points per scan, sampled at random
_LEAST_M = 0.03  # distortion of a scan below which range noise hides it
_CLEAR = 3.5  # standard errors above which a mean is significant: for 12 values by chance in 1 of 400
_LEAST_GAIN = 0.01  # least relative decrease of the residuals for times to be adopted
_MOST_LOSS = 5.0  # largest ratio of loss (opposite times) to gain: 3 if full times fit best, 5 if 3/4 of them do
_SPINS_AT_S = (0.02, 0.25)  # scan periods that are plausible for one revolution
_SURE = 0.9  # least mean resultant length of the azimuths at which scans begin
_AROUND = 0.8  # least share of directions with points for a lidar with a 360° view


@dataclass(frozen=True, slots=True)
class Distortion:
    """Distortion of the scans of a log, and whether point times explain it.

    size_m : per scan in the most distorted window, uncorrected; ``motion`` describes its cause in words
    config : with the tested times: the log's own if ``is_given``, else by azimuth in the better rotation sense
    gain, loss : relative decrease of the residuals by these times and increase by the opposite ones, against none
    sigmas : gain over its standard error
    is_spinning : whether the scans cover 360° and begin at one azimuth, as those of a spinning lidar
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
        """Share of these times that fits best: the minimum of the parabola through the three residuals.

        1 where there is no minimum, or where times are by azimuth and the lidar does not spin.
        """
        if self.loss <= self.gain or not (self.is_given or self.is_spinning):
            return 1.0
        return min(0.5 * abs(self.loss + self.gain) / (self.loss - self.gain), 1.0)

    @property
    def is_shown(self) -> bool:
        """True if these times fit significantly better than none, with a loss by opposite times to match."""
        is_clear = self.gain > _LEAST_GAIN and self.sigmas > _CLEAR
        return is_clear and 0.0 < self.loss < _MOST_LOSS * self.gain

    @property
    def is_refuted(self) -> bool:
        """True if the scans fit significantly better without these times."""
        return self.sigmas < -_CLEAR

    @property
    def is_opposite(self) -> bool:
        """True if times are clearly worse than none and the opposite better, as of beams in mirrored order."""
        return self.is_refuted and max(self.gain, self.loss) < -_LEAST_GAIN

    def is_removed(self, log: Log) -> bool:
        """True if a run corrects the distortion by these times."""
        wanted = log.config.point_times
        is_chosen = wanted == "azimuth" or (wanted == "auto" and log.dimension == 3 and self.is_shown)
        return self.is_given or (is_chosen and self.size_m > _LEAST_M)

    def advice(self, log: Log) -> tuple[str, str]:
        """The distortion and whether a run corrects it, in words, and the flag that would improve it or ""."""
        size = f"distorted by up to {self.size_m:.2g} m per scan ({self.motion})"
        lack = "point times are not used" if log.config.point_times == "none" else "no point times"
        if self.size_m <= _LEAST_M:
            return f"scans are {size}, less than the range noise", ""
        if self.is_removed(log) and self.is_given and self.is_refuted:
            is_azimuth = self.is_opposite and not log.is_mirrored  # whose azimuths count the other way round
            better, flag = ("with the opposite of", "azimuth") if is_azimuth else ("without", "none")
            return f"scans fit better {better} their point times", f"--log.point_times {flag}"
        if self.is_removed(log):
            explained = "which point times remove", "for which point times are used; residuals do not refute them"
            return f"scans are {size}, {explained[self.gain <= 0.0]}", ""
        if self.is_refuted:
            may_be = f"scans may be {size}, but times by azimuth do not explain it"
            return f"{lack}: {'scans show no distortion' if self.is_spinning else may_be}", ""
        choice = "auto" if self.is_shown and log.dimension == 3 else "azimuth"
        return f"{lack}: scans {'are' if self.is_shown else 'may be'} {size}", f"--log.point_times {choice}"

    @property
    def changes(self) -> str:
        """Relative changes of the residuals, in words."""
        if self.gain == self.loss == 0.0:
            return "residuals were not compared, for want of motion or of scans that determine it"
        changes = (-self.gain, self.loss)
        gain, loss = (f"{abs(100 * each):.2g} % {'smaller' if each < 0 else 'larger'}" for each in changes)
        start_rad, turn_s = self.config.revolution_start_rad, self.config.revolution_s
        turn = f"times by azimuth, {self.config.point_times} from {start_rad:.3g} rad, {turn_s:.3g} s per turn"
        times = "their own times" if self.is_given else turn
        return f"with {times}, residuals are {gain} than without, and {loss} with the opposite times"


def measure_distortion(log: Log, *, of_given: bool = True, is_brief: bool = False) -> Distortion | None:
    """Distortion of a log's scans, measured in windows; None where too few scans follow one another.

    Odometry is run over the same scans with times, without and with the opposite ones. Residuals are smallest with
    the correct ones: with others, the map shows a surface at different positions from each pose.

    of_given : whether to test times that the log has, too; else None for such a log
    is_brief : whether to stop at the first windows in which scans fit better with these times, and to leave out
        scans that do not cover 360°, whose beams drivers do not reorder
    """
    config, rng, mounting = load_settings(log.dimension).config, np.random.default_rng(0), log.stated_mounting
    preprocess = msgspec.structs.replace(config.preprocess, match_points=500, calibrate_elevation=False)
    config = msgspec.structs.replace(config, preprocess=preprocess)
    found, residuals, timing, is_spinning = None, list[NDArray[np.float64]](), log.config, False
    for window in log.windows(WINDOWS_AT, _SCANS):
        is_given = len(window[0].times_s) > 0
        if (is_given and not of_given) or (is_brief and not _is_around(window[0])):
            return None
        if found is None and not is_given:
            timing, is_spinning = _by_azimuth(window, log.config)
        scans = [_prepared(scan, timing, rng) for scan in window]
        with suppress(InputError):  # no point within the configured range
            without, size = _residuals(scans, 0.0, config, mounting)
            if size[0] > _LEAST_M:
                with_times = (_residuals(scans, sense, config, mounting)[0] for sense in (1.0, -1.0))
                residuals += _blocks(np.array([without, *with_times]))
            size = size if found is None else max(size, (found.size_m, found.motion))
            found = _compared(residuals, size, timing, is_given, is_spinning)
            is_enough = len(residuals) >= _ENOUGH and abs(found.sigmas) > _CLEAR
            if len(residuals) == _MOST or is_enough or (is_brief and found.gain > 0.0):
                break
    return found


def _compared(
    residuals: Sequence[NDArray[np.float64]],
    size: tuple[float, str],
    timing: LogConfig,
    is_given: bool,
    is_spinning: bool,
) -> Distortion:
    """Distortion from log residuals (3, N) of each window: without times, with them, with the opposite ones."""
    without, ahead, back = np.concatenate(residuals, axis=1) if residuals else np.zeros((3, 2))
    if is_given or ahead.mean() <= back.mean():
        sense, better, worse = "clockwise", ahead, back
    else:
        sense, better, worse = "counterclockwise", back, ahead
    config = timing if is_given else msgspec.structs.replace(timing, point_times=sense)
    gain, loss, sigmas = (without - better).mean(), (worse - without).mean(), _sigmas(without - better)
    return Distortion(*size, config, is_given, float(gain), float(loss), sigmas, is_spinning)


def choose_point_times(log: Log, *, deskew: bool = True) -> None:
    """Set point times by azimuth where clouds have none and such times fit significantly better.

    ``log.point_times`` ``azimuth`` sets them in any case, in the better rotation sense, ``none`` never. Notes of
    the log state the result, ``log.distortion`` and ``log.distorted_share`` the uncorrected rest. Planar scans
    without times may be distorted in any case, those with times where the opposite ones fit better, and all of
    them where a run does not ``deskew``.
    """
    wanted = log.config.point_times
    is_open = wanted == "azimuth" or (wanted in ("auto", "none") and log.dimension == 3)
    if is_open and log.sectors is None and not log.is_mirrored:
        _adopt_point_times(log, wanted)
    if log.dimension == 2:
        log.distorted_share = _sweep_share(log, deskew=deskew)
        is_timed = wanted == "auto" and not log.distorted_share
        found = measure_distortion(log, is_brief=True) if is_timed else None
        if found is not None and found.is_given and found.is_opposite and found.size_m > _LEAST_M:
            said, remedy = found.advice(log)
            log.distortion = f"{said}: {found.changes}; try {remedy}"
            log.distorted_share = 2.0 * _sweep_share(log, deskew=False)  # as opposite times double it
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
    """Scan duration over scan period; 0 where point times deskew the scans."""
    for window in log.windows(WINDOWS_AT[:1], _SCANS):
        if not (deskew and len(window[0].times_s)):
            period_s = 1e-9 * float(np.median(np.diff([scan.stamp_ns for scan in window])))
            return min(_by_azimuth(window, log.config)[0].revolution_s / max(period_s, 1e-9), 1.0)
    return 0.0


def _by_azimuth(window: Sequence[Scan], config: LogConfig) -> tuple[LogConfig, bool]:
    """Clockwise timing, one turn per scan from its first point's azimuth, and whether scans look like such turns.

    The first azimuth is as configured where scans disagree on it, the period where it is implausible for a lidar.
    """
    period_s = 1e-9 * float(np.median(np.diff([scan.stamp_ns for scan in window]))) / config.every
    begins = np.exp(1j * np.array([np.arctan2(*scan.points[0, 1::-1]) for scan in window])).mean()
    timing = msgspec.structs.replace(
        config,
        point_times="clockwise",
        revolution_s=period_s if _SPINS_AT_S[0] < period_s < _SPINS_AT_S[1] else config.revolution_s,
        revolution_start_rad=float(np.angle(begins)) if abs(begins) > _SURE else config.revolution_start_rad,
    )
    return timing, bool(abs(begins) > _SURE and _is_around(window[0]))


def _is_around(scan: Scan) -> bool:
    """True if a scan covers most of 36 directions."""
    seen = np.unique(np.floor(np.arctan2(*scan.points[:, 1::-1].T) * (18.0 / np.pi)))
    return len(seen) > 36 * _AROUND


def _prepared(scan: Scan, timing: LogConfig, rng: np.random.Generator) -> Scan:
    """Random points of a scan, with their own times or by azimuth, relative to the middle of the scan."""
    chosen = np.flatnonzero(rng.random(len(scan.points)) * len(scan.points) < _POINTS)
    points = scan.points[chosen]
    times_s = scan.times_s[chosen] if len(scan.times_s) else from_azimuth(points, timing)
    times_s = times_s - np.float32(0.5) * (times_s.min() + times_s.max())
    return replace(scan, points=points, times_s=times_s, others=None)


def _residuals(
    scans: Sequence[Scan], sense: float, config: Config, T_base_lidar: Pose | None
) -> tuple[NDArray[np.float64], tuple[float, str]]:
    """Residuals of scans, times multiplied by ``sense``, NaN if degenerate; largest distortion and its cause."""
    odometry = Odometry(config, T_base_lidar, dimension=scans[0].points.shape[1])
    tracked = [odometry.process(replace(scan, times_s=np.float32(sense) * scan.times_s)) for scan in scans]
    rms_m = [np.nan if each.state in _OPEN else each.match.residual_m for each in tracked[_BEGIN:]]
    seconds = max(1e-9 * (scans[-1].stamp_ns - scans[_BEGIN].stamp_ns), 1e-9)
    steps = [lie.apart(a.T_odom_lidar, b.T_odom_lidar) for a, b in pairwise(tracked[_BEGIN:])]
    m_s, rad_s = np.sum(steps, axis=0) / seconds
    range_m = float(np.median(np.linalg.norm(scans[-1].points, axis=1)))
    sweep_s = float(np.ptp(scans[0].times_s))
    speed, turn = f"at {m_s:.2g} m/s", f"at {np.degrees(rad_s):.2g} deg/s and a range of {range_m:.2g} m"
    return np.array(rms_m), max((sweep_s * m_s, speed), (sweep_s * rad_s * range_m, turn))


def _blocks(residuals_m: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Log RMS residuals (3, B) of blocks of the scans (3, N) that are located with all three kinds of times."""
    known = residuals_m[:, (residuals_m > 0.0).all(axis=0)]
    if (count := known.shape[1] // _BLOCK) < 2:
        return []
    return [np.log([np.sqrt(np.mean(block**2, axis=1)) for block in np.array_split(known, count, axis=1)]).T]


def _sigmas(gains: NDArray[np.float64]) -> float:
    """Mean gain over its standard error; gains, which grow with the motion, are clipped to their median size."""
    limit = float(np.median(np.abs(gains)))
    clipped = np.clip(gains, -limit, limit)
    return float(clipped.mean() / max(np.std(clipped, ddof=1) / np.sqrt(len(gains)), 1e-9))
