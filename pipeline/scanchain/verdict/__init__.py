"""Independent checks of a trajectory, and the verdict on it."""

from scanchain.verdict.checks import CHECKS
from scanchain.verdict.evidence import Check, Closures, Evidence, Kind, Segment, merged
from scanchain.verdict.judging import Judged, Verdict, judge
from scanchain.verdict.scans import MOST_CONTRADICTED, MOST_OPEN, smallest_jump_m
from scanchain.verdict.wheels import apart_m

__all__ = [
    "CHECKS", "MOST_CONTRADICTED", "MOST_OPEN", "Check", "Closures", "Evidence", "Judged", "Kind", "Segment",
    "Verdict", "apart_m", "judge", "merged", "smallest_jump_m",
]  # fmt: skip
