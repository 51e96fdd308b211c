"""Independent checks of a trajectory, and the verdict on it."""

from scanchain.verdict.checks import check_overlap, check_velocity, check_wheels
from scanchain.verdict.loops import Closures
from scanchain.verdict.stretches import VELOCITY_LIMIT, WHEEL_LIMIT, Evidence, Kind, Stretch
from scanchain.verdict.verdict import MOST_CONTRADICTED, Judged, Verdict, judge

__all__ = [
    "MOST_CONTRADICTED",
    "VELOCITY_LIMIT",
    "WHEEL_LIMIT",
    "Closures",
    "Evidence",
    "Judged",
    "Kind",
    "Stretch",
    "Verdict",
    "check_overlap",
    "check_velocity",
    "check_wheels",
    "judge",
]
