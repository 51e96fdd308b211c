"""Standstill: matches that agree with one pose, which is held until they contradict it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Match, Pose
from scanchain.kernels.registration.observability import definite_inverse

_SCANS = 10  # number of scans that agree with one pose, from which on the lidar stands
_SUDDEN = 5.0  # standard deviations beyond which one innovation contradicts a standstill
_LASTING = 3.0  # the same for the running mean of the innovations
_CAUTION = 2.0  # factor from the root mean square to the standard deviation that is used
_GAIN = 0.3  # least weight of the next value in the running mean of the innovations
_SCATTER_GAIN = 0.1  # the same in that of the squared steps
_AVERAGED = 0.25  # least variance of that mean over that of one innovation: errors in a row are alike
_KNOWN = 5  # number of steps from which on their scatter replaces the variance of a match
_LEAST_M, _LEAST_RAD = 0.002, 0.0005  # smallest standard deviation of a match
_LARGEST_M, _LARGEST_RAD = 0.01, 0.005  # largest one; weaker matches cannot show a standstill


class Standstill:
    """Zero-velocity hypothesis, tested by the innovation of every match against the mean of those before.

    The variance of a match follows from the steps between successive matches (von Neumann 1941), which a slow
    motion does not inflate. The hypothesis is rejected by one innovation, or by the running mean of the last ones,
    which shows a motion too slow for one scan.

    Attributes
    ----------
    T_odom_lidar : mean pose of the matches that agree
    scans : how many they are; a log begins at a standstill
    """

    def __init__(self, dimension: int) -> None:
        k = 3 if dimension == 2 else 6
        self.least = lie.by_component(k, _LEAST_M, _LEAST_RAD) ** 2
        self.largest = lie.by_component(k, _LARGEST_M, _LARGEST_RAD) ** 2
        self.begin(lie.identity(dimension))
        self.scans = _SCANS

    def begin(self, T_odom_lidar: Pose) -> None:
        """Start from a pose that may be the first of a standstill."""
        self.T_odom_lidar = self.T_odom_matched = T_odom_lidar
        self.scans, self.steps = 1, 0
        self.mean_innovation = np.zeros(len(self.least))
        self.squares = np.zeros(len(self.least))

    @property
    def is_standing(self) -> bool:
        """True if enough scans agree with one pose."""
        return self.scans >= _SCANS

    def confirms(self, match: Match) -> bool:
        """True if the lidar stands and the match, which is taken then, does not contradict it.

        A degenerate match cannot: along a corridor it follows the prediction, which is to stand.
        """
        if not (self.is_standing and match.observability >= 1.0 and self._agrees(match)):
            return False
        self._take(match)
        return True

    def follow(self, match: Match) -> None:
        """Take a match of a lidar that does not stand: one more near the same pose, or the first near another."""
        if not self.is_standing and self._agrees(match):
            self._take(match)
        else:
            self.begin(match.T_target_source)

    def _agrees(self, match: Match) -> bool:
        variances = self._variances(match)
        innovation = self._innovation(match)
        mean = self.mean_innovation + self._gain * (innovation - self.mean_innovation)
        share = max(_AVERAGED, 1.0 / (self.steps + 1))
        is_sudden = np.any(innovation**2 > _SUDDEN**2 * variances)
        is_lasting = np.any(mean**2 > _LASTING**2 * share * variances)
        return not (is_sudden or is_lasting)

    def _take(self, match: Match) -> None:
        innovation = self._innovation(match)
        step = lie.log(lie.between(self.T_odom_matched, match.T_target_source))
        self.mean_innovation += self._gain * (innovation - self.mean_innovation)
        scatter_gain = max(_SCATTER_GAIN, 1.0 / (self.steps + 1))
        self.squares += scatter_gain * (0.5 * step**2 - self.squares)
        self.steps += 1
        self.scans += 1
        self.T_odom_matched = match.T_target_source
        self.T_odom_lidar = lie.normalize(self.T_odom_lidar @ lie.exp(innovation / self.scans))

    @property
    def _gain(self) -> float:
        return max(_GAIN, 1.0 / (self.steps + 1))

    def _innovation(self, match: Match) -> NDArray[np.float64]:
        return lie.log(lie.between(self.T_odom_lidar, match.T_target_source))

    def _variances(self, match: Match) -> NDArray[np.float64]:
        """(k,) of an innovation: that of the match or, once known, of the scatter of the last ones, if smaller."""
        variances = np.diag(definite_inverse(match.information))
        if self.steps >= _KNOWN:
            variances = np.minimum(variances, _CAUTION**2 * self.squares)
        return np.clip(variances, self.least, self.largest)
