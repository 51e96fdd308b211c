"""Prediction error statistics: expected error of the next prediction, from the errors of those before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie

_MEMORY = 0.9  # weight of the mean of the squared errors so far against the next one
_SUDDEN = 0.25  # share of the last squared error below which the mean does not fall
_KNOWN = 5  # number of errors needed before the mean is used
_CAUTION = 2.0  # factor from the root mean square to the standard deviation that is given
_LEAST_M, _LEAST_RAD = 0.002, 0.0005  # smallest standard deviation that is given


class ErrorStatistics:
    """A running mean of squared errors, one for every component of a twist."""

    def __init__(self, first_sigma: NDArray[np.float64]) -> None:
        """first_sigma : (k,) standard deviations until errors are known, and the largest that are given."""
        self.first_sigma = first_sigma
        self.least = lie.by_component(len(first_sigma), _LEAST_M, _LEAST_RAD) ** 2
        self.squares = np.zeros(len(first_sigma))
        self.count = 0
        self.variances = first_sigma**2  # (k,) of the next prediction, rather too large than too small

    def update(self, error: NDArray[np.float64], variance: NDArray[np.float64]) -> None:
        """Take the error (k,) of a prediction against a match of this variance (k,), which is subtracted."""
        self.count += 1
        gain = max(1.0 - _MEMORY, 1.0 / self.count)
        square = np.maximum(error * error - variance, 0.0)
        self.squares = np.maximum(self.squares + gain * (square - self.squares), _SUDDEN * square)
        if self.count >= _KNOWN:
            usual = np.maximum(_CAUTION**2 * self.squares, self.least)
            self.variances = np.minimum(usual, self.first_sigma**2)
