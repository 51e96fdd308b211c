"""An axis of a figure: its range, and as many ticks at round numbers as fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FONT = 8.0  # height of text in points
_DIGIT = 0.64  # width of a digit as a fraction of the text height
_GAP = 4.0  # smallest gap between two numbers in points
_MARGIN = 0.05  # margin on either side, as a fraction of the range of the values
_MOST = 9  # largest number of intervals between ticks
_ROUND = (1.0, 2.0, 2.5, 5.0, 10.0)  # steps between ticks, times a power of ten
_WITHIN_DECADES = ((1.0, 2.0, 5.0), (1.0, 3.0), (1.0,))  # ticks per decade: the first set that fits
_TINY = 1e-9


def width_of(text: str) -> float:
    """Width of a number in points."""
    return _DIGIT * FONT * len(text)


class Axis:
    """The range of what is drawn along one direction.

    is_logarithmic : whether the scale is logarithmic; only values above zero are drawn on it
    """

    def __init__(self, *, is_logarithmic: bool = False) -> None:
        self.is_logarithmic = is_logarithmic
        self.label = ""
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
            more = (high / low) ** _MARGIN
            return low / more, high * more
        spare = _MARGIN * (high - low) or _MARGIN * (abs(low) or 1.0)
        return low - spare, high + spare

    def fractions(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions of values along the axis, 0 at its first end, 1 at its last."""
        low, high = self.ends
        if self.is_logarithmic:
            values = np.log(np.where(values > 0.0, values, np.nan))
            low, high = float(np.log(low)), float(np.log(high))
        return (values - low) / (high - low)

    def ticks(self, length: float, *, is_upright: bool) -> list[tuple[float, str]]:
        """Fraction and label of each tick on an axis of this length in points."""
        low, high = min(self.ends), max(self.ends)
        values = self._decades(low, high, length, is_upright)
        texts = [f"{value:g}" for value in values]
        if not values:
            crowded = (high - low) / (high * np.log(high / low)) if self.is_logarithmic else 1.0  # at its end
            values, texts = _round_steps(low, high, crowded * length, is_upright)
        places = self.fractions(np.array(values, np.float64)).tolist()
        return [(place, text.replace("-", "−")) for place, text in zip(places, texts, strict=True)]

    def _decades(self, low: float, high: float, length: float, is_upright: bool) -> list[float]:
        """Powers of ten, and the ticks between them that fit; none on a linear axis."""
        if not self.is_logarithmic:
            return []
        exponents = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
        every, within = exponents[:: -(-len(exponents) // _MOST)], []
        for factors in _WITHIN_DECADES:
            values = [float(f"{factor * 10.0**exponent:.0e}") for exponent in every for factor in factors]
            within = [value for value in values if low <= value <= high]
            room = length * np.log((*factors, 10.0)[1]) / np.log(high / low) - _GAP
            widest = FONT if is_upright else max((width_of(f"{value:g}") for value in within), default=0.0)
            if len(within) <= _MOST and widest <= room:
                break
        return within if len(within) > 2 else []


def _round_steps(low: float, high: float, length: float, is_upright: bool) -> tuple[list[float], list[str]]:
    """Multiples of the smallest round step whose labels do not overlap, and these labels."""
    most = int(np.clip(length / FONT / (2.0 if is_upright else 3.0), 1, _MOST))
    values: list[float] = []
    texts: list[str] = []
    for intervals in range(most, 0, -1):
        least = (high - low) / intervals
        exponent = int(np.floor(np.log10(least)))
        factor = next(each for each in _ROUND if each * 10.0**exponent >= least * (1.0 - _TINY))
        step = factor * 10.0**exponent
        decimals = max(0, (factor == 2.5) - exponent - (factor == 10.0))
        first, last = int(np.ceil(low / step - _TINY)), int(np.floor(high / step + _TINY))
        values = [number * step for number in range(first, last + 1)]
        texts = [f"{value + 0.0:.{decimals}f}" for value in values]
        room = length * step / (high - low) - _GAP
        if is_upright or len(values) < 2 or max(map(width_of, texts)) <= room:
            break
    return values, texts
