"""Calibration of IMU and wheels by the motions of the scans: mounting, scales and delays by least squares."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import uniform_filter1d

from scanchain import lie
from scanchain.data import Mask, Matrix, Pose, Vector
from scanchain.odometry.delay import FEWEST, MOST_DELAY_S, WheelPath, likeliest
from scanchain.registration.hand_eye import hand_eye, path_m

STEPS, STEP = 20, 0.01  # most Gauss-Newton steps; step of a converged parameter, in standard deviations
_BLOCK = 4  # consecutive motions whose errors may depend on each other
_KERNEL = 2.0  # normalized residual at which a motion has half its weight
_MOVING = 0.2  # share of the length of a fast motion below which wheels are taken to stand
_GYRO_PRIOR = np.array([0.2] * 3 + [0.1] * 3 + [0.2])  # σ of rotation, bias and delay
_WHEELS_PRIOR = np.array([1.0, 1.0, 0.2, 0.2, 0.2, 0.2, 0.2, 0.05, 0.3])  # of the parameters of ``Wheels``
_SMOOTHED = 5  # motions over which rates are averaged whose changes show a delay
_LARGEST = 0.5  # error of the scale of distances above which wheels and scans are not of one motion
_CLOCK_S = 0.002  # σ of the instants of poses: scans are deskewed at constant velocity
# σ that the residuals do not show: angles and scale of the scans' own poses, the clock
_OF_WHEELS = np.array([0.0, 0.0, 1e-3, 1e-3, 0.0, 0.002, 0.0, 0.0, _CLOCK_S])


class Motions(NamedTuple):
    """Motions of the lidar from scan to scan: times (M, 2) in seconds, poses (M, d+1, d+1) in the scan before."""

    ends_s: Vector
    T: Matrix

    def where(self, mask: Mask) -> Motions:
        """Some of them."""
        return Motions(self.ends_s[mask], self.T[mask])


class Fit(NamedTuple):
    """Parameters (m,) with their covariance (m, m)."""

    x: Vector
    covariance: Matrix

    @property
    def sigmas(self) -> Vector:
        """Standard deviations (m,)."""
        return np.sqrt(self.covariance.diagonal())


def fitted(
    residuals: Callable[[Vector], Matrix], first: Vector, prior: Vector, slopes: Matrix | None = None
) -> Fit:
    """Robust least squares (Cauchy) of residuals (M, q), whose derivatives are numerical.

    Each component is normalized by its median. The covariance is that of a sandwich estimator over blocks of
    consecutive motions, since two share the error of the pose between them, and no less than the usual one.

    prior : (m,) standard deviations around ``first``, which determine what the motions do not
    slopes : (M, q) derivatives with respect to the last parameter without the noise of the residuals, which would
        seem to determine it: instrumental variables (https://en.wikipedia.org/wiki/Instrumental_variables_estimation)
    """
    x, m, covariance = first, len(first), np.diag(prior**2)
    P = np.diag(prior**-2.0)
    for _ in range(STEPS):
        r, step = residuals(x), 1e-6
        J = np.stack([(residuals(x + each) - r) / step for each in step * np.eye(m)], axis=-1)
        sigma = np.maximum(1.4826 * np.median(np.abs(r), axis=0), 1e-5)  # m or rad: no scan is better
        Z = J if slopes is None else np.concatenate([J[..., :-1], slopes[..., None]], axis=-1)
        r, J, Z = r / sigma, J / sigma[:, None], Z / sigma[:, None]
        weight = 1.0 / (1.0 + np.mean(r**2, axis=1) / _KERNEL**2)
        scores = np.einsum("mqi,mq,m->mi", Z, r, weight)
        inverse = np.linalg.inv(np.einsum("mqi,mqj,m->ij", Z, J, weight) + P)
        blocks = np.add.reduceat(scores, np.arange(0, len(scores), _BLOCK))
        count = len(blocks)
        covariance = inverse @ (count / max(count - m, 1) * blocks.T @ blocks + P) @ inverse.T
        usual = inverse @ (np.einsum("mqi,mqj,m->ij", Z, Z, weight) + P) @ inverse.T
        larger = np.sqrt(np.maximum(usual.diagonal() / covariance.diagonal(), 1.0))
        covariance *= np.outer(larger, larger)
        step = -inverse @ (scores.sum(axis=0) + P @ (x - first))
        x = x + step
        if np.all(np.abs(step) < STEP * np.sqrt(covariance.diagonal())):
            break
    return Fit(x, covariance)


def fit_gyro(motions: Motions, times_s: Vector, rates: Matrix, axes: Matrix, delay_s: float) -> Fit | None:
    """Rotation (3,) of the axes, bias (3,) in rad/s and delay in s of a gyro; None with too few motions.

    The residual of each motion is Log(R) − exp(φ) A ∫ω dt + b Δt.

    axes : A (3, 3), with the unit of the rates (M, 3); delay_s : at first, to 0.2 s
    """
    integral = cumulative_trapezoid(rates, times_s, axis=0, initial=0.0) @ axes.T
    begin_s, end_s = times_s[[0, -1]] + np.array([1.0, -1.0]) * (_GYRO_PRIOR[-1] + abs(delay_s))
    motions = motions.where((motions.ends_s[:, 0] > begin_s) & (motions.ends_s[:, 1] < end_s))
    if len(motions.T) < FEWEST:
        return None
    turns, lasted_s = lie.log(lie.lift(motions.T))[:, 3:], np.diff(motions.ends_s, axis=1)

    def residuals(x: Vector) -> Matrix:
        at = motions.ends_s + x[6]
        ends = np.stack([np.interp(at, times_s, each) for each in integral.T], axis=-1)
        R = lie.exp(np.concatenate([np.zeros(3), x[:3]]))[:3, :3]
        return turns - (ends[:, 1] - ends[:, 0]) @ R.T + lasted_s * x[3:6]

    starts = [np.array([0.0] * 6 + [delay_s + each]) for each in np.linspace(-0.2, 0.2, 41).tolist()]
    first = min(starts, key=lambda start: float(np.abs(residuals(start)).sum()))
    fit = fitted(residuals, first, _GYRO_PRIOR)
    return Fit(fit.x, fit.covariance + np.diag([0.0] * 6 + [_CLOCK_S**2]))


class Wheels(NamedTuple):
    """The mounting T_base_lidar, corrected, with a fit of its corrections.

    fit : of x and y in m, of roll, pitch and yaw in the base's frame, of the scales of distances and of turns
        minus 1, of the turn per meter in rad and of the delay in s
    """

    T_base_lidar: Pose
    fit: Fit


def fit_wheels(motions: Motions, times_s: Vector, poses: Matrix, T_base_lidar: Pose | None) -> Wheels | None:
    """Mounting, scales and delay of wheels from their planar poses (M, 3, 3).

    None where they hardly move or contradict the scans. The base is taken to move in its own plane: so a lidar in
    space shows roll and pitch, too.

    T_base_lidar : as stated; None where the log does not state it: then it is found in closed form
    """
    base = WheelPath(times_s, poses)
    motions = motions.where(base.covers(motions.ends_s))
    if len(motions.T) < FEWEST:
        return None
    lengths, late_s = path_m(motions.T), likeliest(base.odds(*motions))
    first_s = late_s or 0.0  # where it is None, any delay fits
    is_moving = lengths > max(_MOVING * float(np.quantile(lengths, 0.9)), 1e-3)
    if np.count_nonzero(is_moving) < FEWEST:
        return None
    lasted_s = np.diff(motions.ends_s, axis=1)
    rates = uniform_filter1d(lie.log(lie.lift(motions.T)) / lasted_s, _SMOOTHED, axis=0)
    changes = (lasted_s * np.gradient(rates, motions.ends_s.mean(axis=1), axis=0))[is_moving]
    motions = motions.where(is_moving)
    if T_base_lidar is None:
        moved = base.over(motions.ends_s, first_s)
        found = hand_eye(lie.lift(moved) if motions.T.shape[-1] == 4 else moved, motions.T)
        T_base_lidar = lie.identity(motions.T.shape[-1] - 1) if found is None else found.T_base_lidar
    T_first, is_planar = T_base_lidar, len(T_base_lidar) == 3

    def mounting(x: Vector) -> Pose:
        T = lie.lift(T_first)
        turned = lie.exp(np.concatenate([np.zeros(3), x[2:5]])) @ T
        turned[:3, 3] = T[:3, 3] + [x[0], x[1], 0.0]
        return turned

    def residuals(x: Vector) -> Matrix:
        T = mounting(x)
        by_scans = lie.log(T @ lie.lift(motions.T) @ lie.inverse(T))
        by_scans[:, :3] *= 1.0 + x[5]
        by_scans[:, 5] = (1.0 + x[6]) * by_scans[:, 5] + x[7] * by_scans[:, 0]
        error = lie.log(lie.between(lie.exp(by_scans), lie.lift(base.over(motions.ends_s, x[8]))))
        return error[:, [0, 1, 5]] if is_planar else error

    prior = _WHEELS_PRIOR.copy()
    prior[2:4] = 1e-6 if is_planar else prior[2:4]
    first = np.array([0.0] * 8 + [first_s])
    noise, signal = residuals(first)[:, -1], lie.log(motions.T)[:, -1]
    prior[8] = prior[8] if late_s is not None else 1e-6
    slopes = changes @ lie.adjoint(lie.lift(T_first)).T
    fit = fitted(residuals, first, prior, slopes[:, [0, 1, 5]] if is_planar else slopes)
    if abs(fit.x[5]) > _LARGEST:
        return None
    systematic = _OF_WHEELS.copy()
    systematic[6] += float(np.median(noise**2) / max(np.mean(signal**2), 1e-12))  # attenuation by noise
    systematic[8] += MOST_DELAY_S if late_s is None else 0.0
    fit = Fit(fit.x, fit.covariance + np.diag(systematic**2))
    T = mounting(fit.x)
    return Wheels(lie.flatten(T) if is_planar else T, fit)
