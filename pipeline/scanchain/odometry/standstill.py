"""Standstill: a pose that is kept as long as matches agree with each other, even if biased against it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Match, Pose
from scanchain.kernels.matrices import definite_inverse
from scanchain.odometry.motion_filter import CAUTION, KNOWN, LEAST_SIGMAS

_SCANS = 10  # number of scans in agreement with one pose that establish a standstill
_AGAIN = 30  # the same for another pose near the one that is kept
_SETTLING = 0.2  # least weight of a match in the mean of the first ones, whose map is made of few scans
_SETTLING_SIGMAS = (0.004, 0.001)  # m and rad, smallest standard deviation of these matches
_SUDDEN = 5.0  # standard deviations beyond which one innovation contradicts a standstill
_LASTING = 3.0  # the same for the running mean of the innovations
_GAIN = 0.3  # least weight of the next value in the running mean of the innovations
_SCATTER_GAIN = 0.1  # the same in that of the squared steps
_AVERAGED = 0.25  # least variance of that mean over that of one innovation: errors are correlated
_LARGEST_SIGMAS = (0.01, 0.005)  # m and rad, largest of a match; weaker ones cannot show a standstill
_FIRST = (0.015, 0.002)  # m and rad, largest distance of a match to a map of a single scan, biased by its noise
_NEAR = (0.02, 0.004)  # m and rad, distance from the mean beyond which (and _SUDDEN) the lidar has moved off
_SAME = (0.002, 0.001)  # m and rad, distance between two means up to which they are one standstill


class Standstill:
    """Zero-velocity hypothesis, tested by the innovation of every match against the mean of those before.

    A map of few scans has an error that all matches share: they agree with each other, at an offset of some
    millimeters. The pose that is kept is that of the first scan, or the mean of the first ten after a motion. It
    follows the mean of the matches where that moves away, not where it comes nearer as the map improves. People
    and cars that move past bias matches for a while: the pose is kept unless the lidar moves off, or 30 scans in a
    row agree with another pose.

    T_odom_lidar : the pose that is kept
    bias : (k,) twist from it to the mean of the matches
    """

    def __init__(self, dimension: int) -> None:
        self.begin(lie.identity(dimension))
        self.is_beginning = True

    def begin(self, T_odom_lidar: Pose) -> None:
        """Start from a pose that may be the first of a standstill."""
        self.T_odom_lidar = T_odom_lidar
        self.bias = np.zeros(lie.twist_size(T_odom_lidar))
        self.held: AgreeingMatches | None = None
        # of the last matches, none of which confirmed the kept pose
        self.elsewhere: AgreeingMatches | None = AgreeingMatches(T_odom_lidar)
        self.is_beginning = self.is_settling = False

    @property
    def is_standing(self) -> bool:
        """True if enough scans agreed with one pose and the lidar has not moved off."""
        return self.held is not None

    def confirms(self, match: Match) -> bool:
        """True if the lidar is at standstill and the match does not contradict it; the match is then added.

        False for a degenerate match: along a corridor it follows the prediction, which is a standstill.
        """
        if match.observability < 1.0:
            return False
        if self.is_beginning:
            self.is_beginning = False
            self.bias = lie.log(lie.between(self.T_odom_lidar, match.T_target_source))
            limits = np.maximum(_limits(self.bias, _FIRST), _LASTING * np.sqrt(_variances(match)))
            self.is_settling = bool((np.abs(self.bias) < limits).all())
            self.held = AgreeingMatches(match.T_target_source) if self.is_settling else None
            return self.is_settling
        if self.held is None or not self.held.takes(match, is_settling=self.is_settling):
            return False
        self.elsewhere = None
        self.is_settling = self.is_settling and self.held.scans < _SCANS
        if self.is_settling:
            self.bias = lie.log(lie.between(self.T_odom_lidar, self.held.T_mean))
        else:
            self._hold(self.held, np.zeros(len(self.bias)))
        return True

    def update(self, match: Match) -> None:
        """Add a match that does not confirm the standstill: to matches that agree elsewhere, or as their first."""
        sigma = np.sqrt(_variances(match))
        if self.held is not None:
            away = np.abs(lie.log(lie.between(self.held.T_mean, match.T_target_source)))
            if (away > np.maximum(_limits(away, _NEAR), _SUDDEN * sigma)).any():
                self.held = None
        if self.elsewhere is None or not self.elsewhere.takes(match):
            self.elsewhere = AgreeingMatches(match.T_target_source)
        if self.elsewhere.scans < (_SCANS if self.held is None else _AGAIN):
            return
        if self.held is None:
            self.begin(self.elsewhere.T_mean)
            self.held = self.elsewhere
        else:
            self._hold(self.elsewhere, sigma)
        self.elsewhere = None

    def end(self) -> None:
        """End the standstill: another sensor measures the motion."""
        self.held, self.is_beginning = None, False

    def _hold(self, mean: AgreeingMatches, sigma: NDArray[np.float64]) -> None:
        """Move the kept pose where the mean of the matches moved away from it, by more than sigma (k,)."""
        assert self.held is not None
        away = lie.log(lie.between(self.T_odom_lidar, mean.T_mean))
        if self.is_settling:
            self.bias, self.held, self.is_settling = away, mean, False
            return
        bias = np.clip(away, np.minimum(self.bias, 0.0), np.maximum(self.bias, 0.0))
        moved = away - bias
        self.bias = bias
        if (np.abs(moved) < np.maximum(_limits(moved, _SAME), sigma)).all():
            if mean is not self.held:
                self.held.mean_innovation = np.zeros(len(moved))
            return
        self.T_odom_lidar = lie.normalize(self.T_odom_lidar @ lie.exp(moved))
        self.held = mean


class AgreeingMatches:
    """Matches that agree with their mean.

    The variance of a match follows from the steps between successive matches (von Neumann 1941), which a slow
    motion does not inflate. A match is contradicted by its innovation, or by the running mean of the last ones,
    which shows a motion too slow for one scan.
    """

    def __init__(self, T_odom_lidar: Pose) -> None:
        self.T_mean = self.T_last = T_odom_lidar
        self.scans, self.steps = 1, 0
        self.mean_innovation = self.squares = np.zeros(lie.twist_size(T_odom_lidar))

    def takes(self, match: Match, *, is_settling: bool = False) -> bool:
        """True if a match agrees, and is then added; the mean of the innovations includes it in any case."""
        innovation = lie.log(lie.between(self.T_mean, match.T_target_source))
        variances = _variances(match)
        if self.steps >= KNOWN:  # the scatter of the steps replaces the variance of the match
            variances = np.clip(CAUTION**2 * self.squares, _limits(innovation, LEAST_SIGMAS) ** 2, variances)
        if is_settling:
            variances = np.maximum(variances, _limits(innovation, _SETTLING_SIGMAS) ** 2)
        latest = 1.0 / (self.steps + 1)
        self.mean_innovation = self.mean_innovation + max(_GAIN, latest) * (innovation - self.mean_innovation)
        is_sudden = innovation**2 > _SUDDEN**2 * variances
        is_lasting = self.mean_innovation**2 > _LASTING**2 * max(_AVERAGED, latest) * variances
        if is_sudden.any() or is_lasting.any():
            return False
        step = lie.log(lie.between(self.T_last, match.T_target_source))
        self.squares = self.squares + max(_SCATTER_GAIN, latest) * (0.5 * step**2 - self.squares)
        self.steps += 1
        self.scans += 1
        self.T_last = match.T_target_source
        weight = max(_SETTLING if is_settling else 0.0, 1.0 / self.scans)
        self.T_mean = lie.normalize(self.T_mean @ lie.exp(weight * innovation))
        return True


def _variances(match: Match) -> NDArray[np.float64]:
    """Variances (k,) of a match from its own information, within the limits."""
    variances = np.diag(definite_inverse(match.information))
    least, largest = _limits(variances, LEAST_SIGMAS), _limits(variances, _LARGEST_SIGMAS)
    return np.clip(variances, least**2, largest**2)


def _limits(twist: NDArray[np.float64], limits: tuple[float, float]) -> NDArray[np.float64]:
    """(k,) limits of the components of a twist (k,), from those in meters and radians."""
    return lie.by_component(len(twist), *limits)
