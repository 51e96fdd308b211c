"""Independent checks of a trajectory, and the verdict on it."""

from scanchain.verdict.checks import (
    VELOCITY_LIMIT,
    WHEEL_LIMIT,
    Kind,
    Stretch,
    apart_m,
    check_overlap,
    check_velocity,
    check_wheels,
    smallest_jump_m,
    wheel_bound_m,
)
from scanchain.verdict.judging import MOST_CONTRADICTED, Judged, Verdict, judge
from scanchain.verdict.stretches import KNOWN, Closures, Evidence

__all__ = [
    "KNOWN", "MOST_CONTRADICTED", "VELOCITY_LIMIT", "WHEEL_LIMIT", "Closures", "Evidence", "Judged", "Kind",
    "Stretch", "Verdict", "apart_m", "check_overlap", "check_velocity", "check_wheels", "judge",
    "smallest_jump_m", "wheel_bound_m",
]  # fmt: skip
