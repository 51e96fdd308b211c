"""What is drawn of a method or of a run: its way, and what is known of each scan on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanchain.runs.verdicts import BACK_END, VERIFICATION

Floats = NDArray[np.float64]

# Told apart on white and on black, also by most who see colors differently.
_COLORS = (
    "#2f7de1", "#e0532f", "#1aa179", "#c77800", "#a55bd6", "#d6457f", "#0f9bb5", "#7f8c1d", "#8a6d5b", "#8c9096",
    "#b0413e", "#5f8f57",
)  # fmt: skip

TRUTH = "#e0269e"  # dashed; on white and on black like the others, and never one of theirs
CLOSURES = {  # by whom a closure was rejected, "" where it was accepted: what it is called and its line's color
    VERIFICATION: ("rejected by verification", "#8a6d5b"),
    BACK_END: ("rejected by the back end", "#0f9bb5"),
    "": ("accepted", "#3f9b2f"),
}


@dataclass(frozen=True, slots=True)
class Course:
    """A way and its scans, N of them; numbers that are not known are NaN, all or some.

    Attributes
    ----------
    name : for legends outside the drawings
    color, is_dashed : how its line is drawn
    positions : (N, 3) meters, in one frame with the other courses
    distance_m : (N,) traveled
    error_m : (N,) distance from where it was
    relation_error_m : (K,) the same of K relations, none where there are no relations
    seconds : (N,) what each scan took
    nees : (N,) squared error over covariance, 1 on average if exact
    observability : (N,) how many times the least that must be known is known of the worst direction
    """

    name: str
    color: str
    is_dashed: bool
    positions: Floats
    distance_m: Floats
    error_m: Floats
    relation_error_m: Floats
    seconds: Floats
    nees: Floats
    observability: Floats

    @property
    def style(self) -> dict[str, Any]:
        """For matplotlib."""
        return {"color": self.color, "linestyle": (0, (3, 1.5)) if self.is_dashed else "-"}


@dataclass(frozen=True, slots=True)
class PathLine:
    """A line through positions (N, 3), broken where they are NaN."""

    positions: Floats
    color: str
    width: float
    is_dashed: bool = False


def color_of(place: int) -> str:
    """Of the method at this place of the table."""
    return _COLORS[place % len(_COLORS)]
