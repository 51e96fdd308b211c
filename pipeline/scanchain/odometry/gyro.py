"""The gyro of an IMU: rotations between and during scans, calibrated and tested against scan matching."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.data import BRIDGED_S, Mask, Matrix, Pose, Scan, Vector
from scanchain.errors import counted
from scanchain.odometry.delay import correlations
from scanchain.preprocess import ScanMotion, Sweep, Turning

_SCANS = 200  # motions between scans in memory, from which the model is estimated
_FIRST_FIT, _FITS = 10, 1.5  # number of motions at the first estimate, and factor to that at the next one
_FEWEST, _RECENT = 5, 20  # motions whose errors decide whether the gyro is used
_BETTER = 0.7  # ratio of squared errors that justifies one departure from what the log states
_UNEXPLAINED = 0.2  # largest share of the squared rotation that a model may leave
_ONE_AXIS = 0.05  # ratio of singular values below which the rotations have one axis only
_MOST_DELAY_S, _DELAY_STEP_S = 0.5, 0.01  # of the IMU's stamps against those of the scans
_TOLD_DELAY_S = 0.02  # smallest delay that is reported
_DEGREE = math.pi / 180.0
_SCALE = 1.25  # largest ratio of an estimated scale to that of its unit
_SIGMA_RAD, _SIGMA = 0.002, 0.02  # σ of a measured rotation: from scan to scan, and a share of the rotation
_BIAS_RAD_S, _WALK = 0.02, 1e-4  # σ of the bias at first, and of its change in rad/s per √s: larger than of MEMS
_MOST_BIAS_RAD_S, _OUTLIER = 0.1, 3.0  # largest bias that is estimated; σ of a rotation that does not change it
_REPEATED, _LEAST_CLIPPED_RAD_S = 4, 0.3  # samples at the largest rate of a saturated gyro, and least such rate


class Motion(NamedTuple):
    """From the middle of a scan to that of the next: seconds, and the rotation (r,) by the scans."""

    begin_s: float
    end_s: float
    rotation: Vector


class Model(NamedTuple):
    """Rates of the lidar: ``axes`` (r, 3), with the unit, times those of the IMU, minus ``bias`` (r,) in rad/s.

    They hold ``delay_s`` before the stamps of the IMU; ``faults`` are those of the log's statements.
    """

    axes: Matrix
    bias: Vector
    delay_s: float = 0.0
    faults: tuple[str, ...] = ()


class Gyro:
    """Rotations by a gyro; axes, unit, delay and bias are estimated from the rotations between scans.

    It is used while it predicts them better than their mean angular velocity does. Rates are scalars (r = 1) for
    a planar lidar, vectors (r = 3) in space.
    """

    def __init__(self, dimension: int) -> None:
        self.size = 1 if dimension == 2 else 3
        self.stated: Matrix | None = None  # axes (r, 3) by the log's transforms
        self.p_lidar_imu = np.zeros(3)
        self.model: Model | None = None
        self.origin_ns = 0
        self.last_s = self.now_s = math.nan  # middles of the last two scans
        self.turning: Turning | None = None
        self.rotation = np.zeros(self.size)  # from one to the other
        self.forces = np.empty((0, 3))  # specific forces at the knots of ``turning``, along the IMU's axes
        self.blocks: deque[tuple[Vector, Matrix]] = deque(maxlen=_SCANS)  # times (M,); rates and forces (M, 6)
        self.motions: deque[Motion] = deque(maxlen=_SCANS)
        self.errors: deque[tuple[float, float]] = deque(maxlen=_RECENT)  # squared: of the gyro, of equal motion
        self.innovation = math.nan  # of the last scan, normalized
        self.count, self.compared, self.next_fit = 0, 0, float(_FIRST_FIT)
        self.scans, self.used = 0, 0
        self.sums = np.zeros(2)  # of all errors of this model
        self.bias_variance = _BIAS_RAD_S**2
        self.unusable: Counter[str] = Counter()  # scans by defect

    @property
    def is_used(self) -> bool:
        """True while it predicts the rotations of the last scans better."""
        if len(self.errors) < _FEWEST:
            return False
        ours, others = map(sum, zip(*self.errors, strict=True))
        return ours < others

    @property
    def is_mounted(self) -> bool:
        """True if its axes are those that the log's transforms state."""
        if self.stated is None or self.model is None:
            return False
        scale = float(np.sum(self.model.axes * self.stated)) / self.size
        return bool(np.allclose(self.model.axes, scale * self.stated))

    @property
    def sigma_rad(self) -> float:
        """Standard deviation of ``rotation``, in each component."""
        return _SIGMA_RAD + _SIGMA * float(np.linalg.norm(self.rotation))

    def add(self, scan: Scan) -> None:
        """Add the samples that came with a scan; after a jump of the clock those before are discarded."""
        if scan.clock_jump_s:
            self.blocks.clear()
            self.motions.clear()
            self.last_s = math.nan
        if (found := scan.inertial) is None or not len(found.stamps_ns):
            return
        self.origin_ns = self.origin_ns or int(found.stamps_ns[0])
        times_s = 1e-9 * (found.stamps_ns - self.origin_ns).astype(np.float64)
        new = times_s > self.blocks[-1][0][-1] if self.blocks else np.ones(len(times_s), bool)
        if new.any():
            self.blocks.append((times_s[new], np.hstack([found.rates, found.accelerations])[new]))
        if self.model is None and found.T_lidar_imu is not None:
            self.stated, self.p_lidar_imu = found.T_lidar_imu[3 - self.size : 3, :3], found.T_lidar_imu[:3, 3]
            self.model = Model(self.stated, np.zeros(self.size))

    def predict(self, scan: Scan, sweep: Sweep) -> Turning | None:
        """Rotation from the middle of the last scan to the end of this one; None if it is not used."""
        self.now_s = (scan.stamp_ns - self.origin_ns) * 1e-9 + sweep.middle_s
        self.turning = self._measured(sweep) if self.blocks and self.model is not None else None
        if self.turning is not None:
            still = np.zeros(3 if self.size == 1 else 6)
            self.rotation = -lie.log(ScanMotion(still, self.turning).over(self.last_s - self.now_s))[-self.size :]
        return self.turning if self.is_used else None

    def correct(self, T_previous_current: Pose | None) -> None:
        """Compare with the motion between the middles of the last scan and this one, None where it is unknown."""
        begin_s, self.last_s, self.innovation = self.last_s, self.now_s, math.nan
        self.scans += 1
        self.used += self.is_used and self.turning is not None
        if T_previous_current is None or not self.now_s > begin_s:
            return
        motion = Motion(begin_s, self.now_s, lie.log(T_previous_current)[-self.size :])
        if self.turning is not None and self.motions and self.motions[-1].end_s == begin_s:
            self._compare(self.motions[-1], motion)
        self.motions.append(motion)
        self.count += 1
        ours = sum(error for error, _ in self.errors)
        if self.count >= self.next_fit and not ours < len(self.errors) * _SIGMA_RAD**2:
            self.next_fit = _FITS * self.count
            self._fit()

    def forces_since_last(self) -> tuple[Vector, Matrix, Matrix]:
        """Times (K,) from the middle of the last scan to that of this one, at 0, rotations and specific forces.

        Rotations R_last_t (K, 3, 3); forces (K, 3) in m/s² along the axes of the lidar: those of the gyro, without
        its unit and sign.
        """
        assert self.turning is not None and self.model is not None
        times_s, poses = self.turning.poses(np.zeros(3))
        knots_s, begin_s = self.turning.knots_s, self.last_s - self.now_s
        wanted_s = np.concatenate([[begin_s], knots_s[(knots_s > begin_s) & (knots_s < 0.0)], [0.0]])
        R = _interpolated(wanted_s, times_s, poses[:, :3, :3].reshape(-1, 9)).reshape(-1, 3, 3)
        axes = self.model.axes / np.cbrt(np.linalg.det(self.model.axes))
        return wanted_s, R[0].T @ R, _interpolated(wanted_s, knots_s, self.forces) @ axes.T

    def note(self) -> str:
        """Share of the scans that it predicts, and how well, as text; empty without samples."""
        if not self.scans:
            return ""
        ours, others = np.degrees(np.sqrt(self.sums / max(self.compared, 1))).tolist()
        how_well = f", to {ours:.2g}° (the last motion continued: {others:.2g}°)" if self.compared else ""
        return (
            f"IMU: its gyro predicts the rotation of {100.0 * self.used / self.scans:.0f} % of the scans{how_well}"
        )

    def warnings(self) -> tuple[str, ...]:
        """Defects of the IMU, one per line."""
        lines = [*self.model.faults] if self.model else []
        lines += [f"{defect} at {counted(count, 'scan')}" for defect, count in self.unusable.items()]
        if self.motions and not self.used:
            lines.append("it is not used, since it predicts no rotation better than the scans do")
        return tuple(f"IMU: {line}" for line in lines)

    def _measured(self, sweep: Sweep) -> Turning | None:
        """Rotation from the middle of the last scan to the end of this one."""
        assert self.model is not None
        if math.isnan(self.last_s):
            return None
        half_s, delay_s = float(np.abs(sweep.times_s).max(initial=0.0)), self.model.delay_s
        begin_s, end_s = min(self.last_s, self.now_s - half_s) + delay_s, self.now_s + half_s + delay_s
        times_s, samples = self._samples(begin_s)
        rates = samples[:, :3]
        inside = (times_s > begin_s) & (times_s < end_s)
        knots_s = np.concatenate([[begin_s], times_s[inside], [end_s]])
        if not end_s > begin_s:
            return None
        if defect := _defect(knots_s, rates[inside]):
            self.unusable[defect] += 1
            return None
        at_knots = _interpolated(knots_s, times_s, samples)
        self.forces = at_knots[:, 3:]
        means = 0.5 * (at_knots[:-1, :3] + at_knots[1:, :3])
        return Turning(knots_s - delay_s - self.now_s, means @ self.model.axes.T - self.model.bias)

    def _samples(self, begin_s: float = -math.inf) -> tuple[Vector, Matrix]:
        """Times (M,) and rates (M, 3) in memory, from the last one before a time."""
        blocks: list[tuple[Vector, Matrix]] = []
        for block in reversed(self.blocks):
            blocks.insert(0, block)
            if block[0][0] <= begin_s:
                break
        return np.concatenate([each for each, _ in blocks]), np.concatenate([each for _, each in blocks])

    def _compare(self, before: Motion, motion: Motion) -> None:
        """Errors of the rotation as measured and as continued from the motion before; the bias follows.

        The bias is a random walk that each motion measures (a Kalman filter, one variance for all axes), unless
        the rotation of the scans is an outlier.
        """
        assert self.model is not None
        lasted_s = motion.end_s - motion.begin_s
        error = self.rotation - motion.rotation
        change = motion.rotation - before.rotation * (lasted_s / (before.end_s - before.begin_s))
        self.errors.append((float(error @ error), float(change @ change)))
        self.sums += self.errors[-1]
        self.compared += 1
        self.bias_variance += _WALK**2 * lasted_s
        variance = self.sigma_rad**2 + self.bias_variance * lasted_s**2
        self.innovation = math.sqrt(error @ error / (self.size * variance))
        if error @ error < _OUTLIER**2 * variance:
            gain = self.bias_variance / (self.bias_variance + (_SIGMA_RAD / lasted_s) ** 2)
            self.model = self.model._replace(bias=self.model.bias + gain * error / lasted_s)
            self.bias_variance *= 1.0 - gain

    def _fit(self) -> None:
        """Re-estimate the model: the delay from the angles alone, axes and bias by least squares."""
        motions, (times_s, rates) = list(self.motions), self._samples()
        rates = rates[:, :3]
        means = 0.5 * (rates[:-1] + rates[1:])
        integral = np.cumsum(np.vstack([np.zeros(3), means * np.diff(times_s)[:, None]]), axis=0)
        ends_s = np.array([(each.begin_s, each.end_s) for each in motions])
        rotations, lasted_s = np.array([each.rotation for each in motions]), ends_s[:, 1] - ends_s[:, 0]

        def measured(delays_s: Vector) -> tuple[Matrix, Mask]:
            """Integrated rates (D, M, 3) at each delay (D,), and whether there are samples for them (D, M)."""
            at_s = ends_s + delays_s[:, None, None]
            at_ends = np.stack([np.interp(at_s, times_s, each) for each in integral.T], axis=-1)
            known = (at_s[:, :, 0] >= times_s[0]) & (at_s[:, :, 1] <= times_s[-1])
            return at_ends[:, :, 1] - at_ends[:, :, 0], known

        best, least = self.model, math.inf
        for delay_s in {0.0, self._delay(rotations, measured)}:
            (X,), (known,) = measured(np.array([delay_s], float))
            if 2 * np.count_nonzero(known) < len(motions):
                continue
            X, Y, mean_s = X[known], rotations[known], float(lasted_s[known].mean())
            late = f"its stamps are {abs(delay_s):.2f} s {'late' if delay_s > 0.0 else 'early'}"
            of_delay = (late,) if abs(delay_s) >= _TOLD_DELAY_S else ()
            for axes, faults in _axes(X - X.mean(axis=0), Y - Y.mean(axis=0), self.stated):
                bias = (X.mean(axis=0) @ axes.T - Y.mean(axis=0)) / mean_s
                error = _typical(X @ axes.T - bias * mean_s - Y)
                score = error / _BETTER ** (len(faults) + (delay_s != 0.0))
                is_likely = error < _UNEXPLAINED * _typical(Y) and float(np.abs(bias).max()) < _MOST_BIAS_RAD_S
                if is_likely and score < least:
                    best, least = Model(axes, bias, delay_s, faults + of_delay), score
        if best is None or best is self.model:
            return
        if not self.is_used:
            self.errors.clear()
            self.compared, self.sums, self.bias_variance = 0, np.zeros(2), _BIAS_RAD_S**2
        self.model = best

    def _delay(self, rotations: Matrix, measured: Callable[[Vector], tuple[Matrix, Mask]]) -> float:
        """The delay at which the angles of the motions correlate best."""
        steps = round(_MOST_DELAY_S / _DELAY_STEP_S)
        delays_s = _DELAY_STEP_S * np.arange(-steps, steps + 1, dtype=np.float64)
        X, known = measured(delays_s)
        found = correlations(np.linalg.norm(X, axis=2), np.linalg.norm(rotations, axis=1), known)
        return float(delays_s[found.argmax()])


def _interpolated(at_s: Vector, times_s: Vector, values: Matrix) -> Matrix:
    """Values (M, n) at times (M,), interpolated at others (K,): (K, n); beyond the ends those of the ends."""
    after = np.minimum(np.maximum(np.searchsorted(times_s, at_s), 1), max(len(times_s) - 1, 1))  # clip is slow
    if len(times_s) == 1:
        return np.repeat(values, len(at_s), axis=0)
    before_s = times_s[after - 1]
    share = np.minimum(np.maximum((at_s - before_s) / (times_s[after] - before_s), 0.0), 1.0)[:, None]
    return values[after - 1] * (1.0 - share) + values[after] * share


def _typical(rotations: Matrix) -> float:
    """A squared norm that a quarter of vectors (M, r) exceeds: some may be wrong, most may be small."""
    return float(np.quantile(np.sum(rotations**2, axis=1), 0.75))


def _axes(X: Matrix, Y: Matrix, stated: Matrix | None) -> Iterator[tuple[Matrix, tuple[str, ...]]]:
    """Axes (r, 3) with their unit that map rotations X (M, 3) to Y (M, r), of mean 0, and the faults of the log.

    Those stated, those of the opposite sign, and the best rotation (Kabsch 1976) and rotoinversion. Rotations
    about one axis alone determine no more than that: then the rotation is the smallest one.
    """
    H = Y.T @ X
    sign, turned = (
        "the sign of its rates is wrong, or the scans are mirrored: the rates are corrected",
        "its axes are not those of the transforms: estimated",
    )
    candidates = [] if stated is None else [(stated, ()), (-stated, (sign,))]
    if len(H) == 1:
        candidates.append((H / max(float(np.linalg.norm(H)), 1e-12), () if stated is None else (turned,)))
    else:
        U, S, Vt = np.linalg.svd(H)
        of_rotation = () if stated is None else (turned,)
        if S[1] > _ONE_AXIS * S[0]:
            R, R_of_opposite = (Rotation.align_vectors(Y, each)[0].as_matrix() for each in (X, -X))
            candidates += [(R, of_rotation), (-R_of_opposite, (*of_rotation, sign))]
        else:
            candidates.append((Rotation.align_vectors(U[:, :1].T, Vt[:1])[0].as_matrix(), of_rotation))
    for axes, faults in candidates:
        power = float(np.sum((X @ axes.T) ** 2))
        scale = float(np.sum(H * axes)) / power if power > 0.0 else 0.0
        if 1.0 / _SCALE < scale / _DEGREE < _SCALE:
            yield axes * _DEGREE, (*faults, "its rates are in degrees per second: converted")
        else:
            yield axes, faults


def _defect(knots_s: Vector, rates: Matrix) -> str:
    """Why rates (M, 3) between the first and the last knot do not give the rotation; empty if they do."""
    if float(np.diff(knots_s).max()) > BRIDGED_S:
        return f"no sample for more than {BRIDGED_S:g} s"
    if len(rates) >= _REPEATED and rates.any() and not np.ptp(rates, axis=0).any():
        return "rates that do not change"
    largest = np.abs(rates).max(initial=0.0)
    if largest > _LEAST_CLIPPED_RAD_S and np.count_nonzero(np.abs(rates) == largest) >= _REPEATED:
        return f"rates saturated at {math.degrees(largest):.0f}°/s"
    return ""
