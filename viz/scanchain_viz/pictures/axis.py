"""An axis of a figure: its range, and as many ticks at round numbers as fit."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

import numpy as np
from numpy.typing import NDArray

FONT = 8.0  # height of text in points
GAP = 4.0  # least distance between two texts in points
MARGIN = 0.05  # margin on either side, as a fraction of the range of the values
_MOST = 10  # largest number of ticks
_ROUND = "125"  # steps between ticks, times a power of ten
_DECADES = ("125", 1), ("13", 1), ("1", 1), ("1", 2), ("1", 3), ("1", 10), ("1", 50)  # ticks, in every n-th decade
_TINY = 1e-9  # share of a step by which the end of a range may miss a tick


def width_of(text: str) -> float:
    """Width of a number in points."""
    return 0.64 * FONT * len(text)  # width of a digit over the height of text


class Axis:
    """The range of what is drawn along one direction.

    is_logarithmic : whether the scale is logarithmic; only values above zero are drawn on it
    """

    def __init__(self, label: str = "", *, is_logarithmic: bool = False) -> None:
        self.label, self.is_logarithmic = label, is_logarithmic
        self._least, self._greatest = np.inf, -np.inf
        self._limits: tuple[float, float] | None = None

    def limit(self, low: float, high: float) -> None:
        """Set the range; the axis is reversed if ``low`` is greater than ``high``."""
        self._limits = float(low), float(high)

    def include(self, values: NDArray[np.float64]) -> None:
        """Widen the range to hold values, NaN excepted; without effect on a range that is set."""
        known = values[np.isfinite(values) & ((values > 0.0) | (not self.is_logarithmic))]
        self._least = float(known.min(initial=self._least))
        self._greatest = float(known.max(initial=self._greatest))

    @property
    def ends(self) -> tuple[float, float]:
        """First and last value."""
        if self._limits is not None:
            return self._limits
        low, high = (self._least, self._greatest) if self._least <= self._greatest else (1.0, 1.0)
        if self.is_logarithmic:
            low, high = (low, high) if high > low else (0.1 * low, 10.0 * high)
            more = (high / low) ** MARGIN
            return low / more, high * more
        spare = MARGIN * (high - low) or MARGIN * (abs(low) or 1.0)
        return low - spare, high + spare

    def fractions(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions of values along the axis, 0 at its first end, 1 at its last."""
        low, high = self.ends
        if self.is_logarithmic:
            values = np.log(np.where(values > 0.0, values, np.nan))
            low, high = float(np.log(low)), float(np.log(high))
        return (values - low) / (high - low)

    def ticks(self, length: float, *, is_upright: bool) -> list[tuple[float, str]]:
        """Fraction and label of each tick on an axis of this length in points: the finest that fit."""
        for values, texts in self._candidates():
            places = self.fractions(np.array(values, np.float64))
            sizes = np.array([FONT if is_upright else width_of(text) for text in texts])
            room = length * np.abs(np.diff(places)) - 0.5 * (sizes[1:] + sizes[:-1])
            if len(values) <= _MOST and room.min(initial=GAP) >= GAP:
                labels = [text.replace("-", "−") for text in texts]
                return list(zip(places.tolist(), labels, strict=True))
        raise AssertionError("the largest step has one tick at most")

    def _candidates(self) -> Iterator[tuple[list[float], list[str]]]:
        """Ticks and their labels, finest first: of decades, of round steps where decades are too far apart."""
        low, high = min(self.ends), max(self.ends)
        if self.is_logarithmic:
            exponents = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
            for factors, every in _DECADES:
                decades = [float(f"{factor}e{exponent}") for exponent in exponents[::every] for factor in factors]
                values = [value for value in decades if low <= value <= high]
                if len(values) > 2 or high > 100.0 * low:
                    yield values, [f"{value:g}" for value in values]
        least = (high - low) / _MOST
        for exponent in count(int(np.floor(np.log10(least)))):
            for step in (float(f"{factor}e{exponent}") for factor in _ROUND):
                if step >= least:
                    values = step * np.arange(np.ceil(low / step - _TINY), high / step + _TINY) + 0.0
                    yield values.tolist(), [f"{value:.{max(-exponent, 0)}f}" for value in values]
