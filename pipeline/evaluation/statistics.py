"""What a set of errors amounts to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Statistics:
    """Figures of a set of absolute errors, in the errors' own unit.

    ``std`` is that of the errors at hand (divided by their count, not by count − 1); all are 0 for no errors.
    """

    count: int
    mean: float
    std: float
    rmse: float
    median: float
    minimum: float
    maximum: float

    @classmethod
    def of(cls, errors: NDArray[np.float64]) -> Statistics:
        """The figures of (N,) errors."""
        if not len(errors):
            return cls(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        return cls(
            count=len(errors),
            mean=float(errors.mean()),
            std=float(errors.std()),
            rmse=float(np.sqrt(np.mean(errors * errors))),
            median=float(np.median(errors)),
            minimum=float(errors.min()),
            maximum=float(errors.max()),
        )

    def scaled(self, factor: float) -> Statistics:
        """The same errors in another unit, for print."""
        return Statistics(
            self.count,
            *(
                value * factor
                for value in (self.mean, self.std, self.rmse, self.median, self.minimum, self.maximum)
            ),
        )
