"""Delay of a sensor's stamps: where the motions that it measures correlate best with those of the scans."""

from __future__ import annotations

import numpy as np
from scipy.integrate import cumulative_trapezoid

from scanchain import lie
from scanchain.data import Mask, Matrix, Pose, Vector

_DELAYS_S = np.linspace(-1.0, 1.0, 101)  # of the wheels' stamps against those of the scans
MOST_DELAY_S = float(_DELAYS_S[-1])
APART_S, _ODDS = 0.1, 10.0  # distinct delays, and least log-likelihood ratio against any other
BLOCK, FEWEST = 300, 30  # scans that are compared together; least number of motions
LONGEST_S = 0.5  # time between two scans whose motion is compared


def correlations(measured: Matrix, by_scans: Vector, known: Mask) -> Vector:
    """Correlation (D,) at each of D delays of what a sensor measures (D, M) with the scans (M,).

    known : (D, M) False where there are no samples; −1 where that are more than half, or nothing changes
    """
    weights = known / np.maximum(known.sum(axis=1), 1)[:, None]
    a = measured - np.sum(weights * measured, axis=1, keepdims=True)
    b = by_scans - weights @ by_scans[:, None]
    squares = np.sum(weights * a * a, axis=1) * np.sum(weights * b * b, axis=1)
    correlation = np.sum(weights * a * b, axis=1) / np.sqrt(np.maximum(squares, 1e-24))
    return np.where(2 * known.sum(axis=1) >= len(by_scans), correlation, -1.0)


class WheelPath:
    """Motions of the base by planar poses (N, 3, 3) of wheels, their path averaged over two samples.

    Otherwise delays halfway between samples, where the noise is less, fit better.
    """

    def __init__(self, times_s: Vector, poses: Matrix) -> None:
        path = np.column_stack([poses[:, 0, 2], poses[:, 1, 2], np.unwrap(lie.yaw(poses))])
        self.times_s, self.integral = times_s, cumulative_trapezoid(path, times_s, axis=0, initial=0.0)
        self.width_s = 2.0 * float(np.median(np.diff(times_s)))

    def covers(self, ends_s: Matrix) -> Mask:
        """(M,) whether there are samples for motions (M, 2) at every delay."""
        begin_s, end_s = self.times_s[0] + MOST_DELAY_S, self.times_s[-1] - MOST_DELAY_S
        return (ends_s[:, 0] > begin_s) & (ends_s[:, 1] < end_s)

    def over(self, ends_s: Matrix, delay_s: float) -> Matrix:
        """(M, 3, 3) over motions (M, 2), ``delay_s`` later by their stamps."""
        at = ends_s + delay_s + 0.5 * self.width_s * np.array([-1.0, 1.0])[:, None, None]
        x, y, yaw = (
            np.diff(np.interp(at, self.times_s, each), axis=0)[0] / self.width_s for each in self.integral.T
        )
        T = lie.exp(np.stack([np.zeros_like(yaw)] * 2 + [yaw], axis=-1))
        T[..., 0, 2], T[..., 1, 2] = x, y
        return lie.between(T[:, 0], T[:, 1])

    def odds(self, ends_s: Matrix, motions: Matrix) -> Vector:
        """Log-likelihood of each delay, if lengths and turns are linear in those of the scans (M, d+1, d+1)."""
        at_s, index = np.unique(
            ends_s, return_inverse=True
        )  # most are the end of one motion and the start of another
        first, last = index.reshape(ends_s.shape).T
        after_s = _DELAYS_S[:, None, None] + 0.5 * self.width_s * np.array([-1.0, 1.0])  # (D, 1, 2)
        path = (
            np.diff(np.interp(at_s[:, None] + after_s, self.times_s, each))[..., 0] for each in self.integral.T
        )
        x, y, turns = ((each[:, last] - each[:, first]) / self.width_s for each in path)  # (D, M)
        known, total = np.ones(turns.shape, bool), np.zeros(len(_DELAYS_S))
        of_scans = np.linalg.norm(motions[:, :-1, -1], axis=1), np.abs(lie.log(motions)[:, -1])
        for measured, by_scans in zip((np.hypot(x, y), np.abs(turns)), of_scans, strict=True):
            found = correlations(measured, by_scans, known)
            total -= 0.5 * len(motions) * np.log(np.maximum(1.0 - np.maximum(found, 0.0) ** 2, 1e-9))
        return total


def likeliest(odds: Vector) -> float | None:
    """The delay of the greatest log-likelihood; None where a distinct one is hardly less likely."""
    best = int(odds.argmax())
    others = odds[np.abs(_DELAYS_S - _DELAYS_S[best]) > APART_S]
    return float(_DELAYS_S[best]) if odds[best] - others.max() > _ODDS else None


class WheelDelay:
    """How late the stamps of wheels are, from lengths and turns of the motions between scans, block by block.

    is_clear : whether a delay is likelier than any distinct one by far; then nothing is added
    """

    def __init__(self) -> None:
        self.odds, self.is_clear = np.zeros(len(_DELAYS_S)), False
        self.block: list[tuple[float, Pose, Pose, bool]] = []

    def update(self, stamp_ns: int, T_odom_lidar: Pose, T_odom_base: Pose, *, is_known: bool) -> None:
        """Add the poses of a scan by scans and wheels; ``is_known`` if the former is determined."""
        if self.is_clear:
            return
        if len(self.block) == BLOCK or (self.block and abs(1e-9 * stamp_ns - self.block[-1][0]) > MOST_DELAY_S):
            self._set(self.total)
        self.block.append((1e-9 * stamp_ns, T_odom_lidar, T_odom_base, is_known))

    def add(self, other: WheelDelay) -> None:
        """Add what another part of the log shows."""
        self._set(self.odds + other.total)

    @property
    def seconds(self) -> float:
        """The delay, 0 where it is small or the motion does not show it."""
        found = likeliest(self.total)
        return 0.0 if found is None or abs(found) < APART_S else found

    @property
    def total(self) -> Vector:
        """Log-likelihood (D,) of each delay."""
        return self.odds + self._of_block()

    def _set(self, odds: Vector) -> None:
        self.odds, self.block, self.is_clear = odds, [], likeliest(0.5 * odds) is not None

    def _of_block(self) -> Vector:
        times_s, first = np.unique([time_s - self.block[0][0] for time_s, *_ in self.block], return_index=True)
        if len(times_s) < FEWEST:
            return np.zeros(len(_DELAYS_S))
        _, lidar, base, known = (np.array(each)[first] for each in zip(*self.block, strict=True))
        path = WheelPath(times_s, base if base.shape[-1] == 3 else lie.flatten(base))
        ends_s = np.column_stack([times_s[:-1], times_s[1:]])
        chosen = known[:-1] & known[1:] & (np.diff(times_s) < LONGEST_S) & path.covers(ends_s)
        if np.count_nonzero(chosen) < FEWEST:
            return np.zeros(len(_DELAYS_S))
        return path.odds(ends_s[chosen], lie.between(lidar[:-1], lidar[1:])[chosen])
