"""When a lidar stands still: the surroundings stay where they were."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_QUARTER = 75.0  # percentile of the cells' changes: a wall ahead moves, those beside do not
_STILL_M = {2: 0.03, 3: 0.08}  # more than the noise of such scanners
LEAST_S = 1.0  # a shorter rest is none


class Rest(NamedTuple):
    """A time at rest, from one scan to another, by their places and log times."""

    first: int
    last: int
    begin_ns: int
    end_ns: int

    @property
    def duration_s(self) -> float:
        """Seconds from the first scan to the last."""
        return (self.end_ns - self.begin_ns) * 1e-9


class RestWatch:
    """Compares each scan with the one since which nothing has changed; ``rests`` are those of a second or more."""

    def __init__(self, dimension: int) -> None:
        self.still_m = _STILL_M[dimension]
        self.anchor: NDArray[np.float64] | None = None
        self.count = 0
        self.current = Rest(0, 0, 0, 0)
        self.rests: list[Rest] = []

    def take(self, outline: NDArray[np.float64], log_time_ns: int) -> None:
        """Look at the next scan, the mean distances (C,) of its cells."""
        if self.anchor is None or self._change_m(outline, self.anchor) > self.still_m:
            self.close()
            self.anchor = outline
            self.current = Rest(self.count, self.count, log_time_ns, log_time_ns)
        else:
            self.current = self.current._replace(last=self.count, end_ns=log_time_ns)
        self.count += 1

    def close(self) -> None:
        """Keep what has lasted long enough."""
        if self.current.duration_s >= LEAST_S:
            self.rests.append(self.current)
        self.anchor = None

    @staticmethod
    def _change_m(outline: NDArray[np.float64], anchor: NDArray[np.float64]) -> float:
        change_m = np.abs(outline - anchor)
        change_m = change_m[np.isfinite(change_m)]
        return float(np.percentile(change_m, _QUARTER)) if len(change_m) else float("inf")
