"""How well predictions have done so far, which tells how far off the next one may be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie

_MEMORY = 0.9  # of the squared errors, per scan
_SUDDEN = 0.25  # share of the last squared error that counts at once
_KNOWN = 5  # errors, before which they tell too little
_CAUTION = 2.0  # standard deviations
_LEAST_M, _LEAST_RAD = 0.002, 0.0005  # no prediction is trusted more than this


class Experience:
    """A running mean of squared errors, one for every component of a twist."""

    def __init__(self, first_sigma: NDArray[np.float64]) -> None:
        """first_sigma : (k,) standard deviations to go by until errors are known, and the most there may be."""
        self.first_sigma = first_sigma
        self.least = lie.by_component(len(first_sigma), _LEAST_M, _LEAST_RAD) ** 2
        self.squares = np.zeros(len(first_sigma))
        self.count = 0

    def learn(self, error: NDArray[np.float64], variance: NDArray[np.float64]) -> None:
        """Take the error (k,) of a prediction, as far as it is more than that of the match it is seen from.

        variance : (k,) of the match
        """
        self.count += 1
        gain = max(1.0 - _MEMORY, 1.0 / self.count)
        square = np.maximum(error * error - variance, 0.0)
        self.squares = np.maximum(self.squares + gain * (square - self.squares), _SUDDEN * square)

    @property
    def variances(self) -> NDArray[np.float64]:
        """(k,) of the next prediction, on the side of caution."""
        if self.count < _KNOWN:
            return self.first_sigma**2
        return np.minimum(np.maximum(_CAUTION**2 * self.squares, self.least), self.first_sigma**2)
