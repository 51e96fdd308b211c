"""How alike the errors of a landmark's successive sightings are, and what that leaves each of them worth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix

_LAGS_S = np.array([0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0])  # edges; farther apart errors count as independent
_FEWEST = 30  # pairs that tell a correlation


class Likeness:
    """Pairs of sightings of one landmark within some seconds of each other, found once."""

    def __init__(self, seen_s: NDArray[np.float64], landmarks: NDArray[np.int64]) -> None:
        """Times and landmarks of the sightings, (N,) each."""
        since = seen_s - seen_s.min(initial=np.inf)
        key = since + landmarks * (since.max(initial=0.0) + 2.0 * _LAGS_S[-1])  # a landmark's time is its own
        order = np.argsort(key, kind="stable")
        places = np.arange(len(key))
        after = np.searchsorted(key[order], key[order] + _LAGS_S[-1]) - places - 1
        first = np.repeat(places, after)
        second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(after) - after, after)
        self._first, self._second = order[first], order[second]
        self._lag = np.searchsorted(_LAGS_S, seen_s[self._second] - seen_s[self._first], side="right") - 1
        self._count = len(seen_s)

    def correlation(self, residuals: Matrix) -> NDArray[np.float64]:
        """Correlation of residuals (N, 2) by lag, pooled over bearings and ranges; it never grows with the lag."""
        bins = len(_LAGS_S) - 1
        products = residuals[self._first] * residuals[self._second] / np.mean(residuals**2, axis=0)
        sums = np.bincount(self._lag, products.mean(axis=1), bins)
        found = sums / np.maximum(np.bincount(self._lag, minlength=bins), _FEWEST)
        return np.minimum.accumulate(np.clip(found, 0.0, 1.0)).astype(np.float64)

    def share(self, correlation: NDArray[np.float64]) -> NDArray[np.float64]:
        """How much of an independent sighting each is, (N,): one over the sum of its correlations (Kish 1965)."""
        alike = correlation[self._lag]
        sums = np.bincount(self._first, alike, self._count) + np.bincount(self._second, alike, self._count)
        return (1.0 / (1.0 + sums)).astype(np.float64)
