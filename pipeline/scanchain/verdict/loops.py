"""The check by loop closures: groups that contradict the trajectory, and segments that none connects."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.consistency import FEWEST, carried, connected
from scanchain.verdict.evidence import Check, Closures, Evidence, Floats, Kind, Segment, merged

_LEAST_M = 0.5  # least translation error of a closure that is a contradiction
_NEAR_M = 10.0  # largest path between two closures of a group, summed over both ends
_AGREE = (0.2, 0.02)  # largest difference of two that agree: meters, and share of that path
_FEWEST_TRIED, _LEAST_ACCEPTED = 10, 0.2  # least number of scans that tried closures; closures accepted per scan


class Loops(Check):
    """Loop closures that the trajectory contradicts though they agree with each other, or that are few."""

    name, kind = "loop closures", Kind.LOOPS

    def __init__(self, evidence: Evidence) -> None:
        super().__init__(evidence)
        self.closures = evidence.closures

    @property
    def is_made(self) -> bool:
        """True if verification accepted a closure."""
        return len(self.closures.target) > 0

    def segments(self, evidence: Evidence, found: Sequence[Segment]) -> Iterator[Segment]:
        """Segments between the ends of groups of closures that contradict the poses."""
        yield from contradicting_groups(self.closures, evidence.poses, evidence.seconds)

    def warnings(self, evidence: Evidence) -> Iterator[str]:
        """Few accepted closures."""
        tried, accepted = self.closures.tried, int(self.closures.is_accepted.sum())
        if tried >= _FEWEST_TRIED and accepted < _LEAST_ACCEPTED * tried:
            yield (
                f"loop closures were tried from {tried:,} scans, {accepted:,} accepted: where the trajectory "
                "returns, the place does not look as mapped"
            )


class Connections(Check):
    """Segments that accepted closures do not connect to the first one."""

    kind = Kind.DISCONNECTED

    def segments(self, evidence: Evidence, found: Sequence[Segment]) -> Iterator[Segment]:
        """Segments whose pose relative to the first one is unknown."""
        segment = np.cumsum(evidence.starts_segment)
        closures = evidence.closures
        ends = np.stack([segment[closures.target], segment[closures.source]], axis=1)[closures.is_accepted]
        label = np.arange(segment[-1] + 1)
        for low, high in np.sort(ends, axis=1).tolist():
            label[label == label[high]] = label[low]
        for number in np.flatnonzero(label != label[0]).tolist():
            (part,) = merged(segment == number)
            yield evidence.segment(self.kind, part, segment == number)


def contradicting_groups(closures: Closures, poses: Matrix, seconds: Floats) -> list[Segment]:
    """Segments between the ends of groups of at least three closures that agree, but contradict the final poses.

    Either the motion over the segment is wrong by about the same distance, or the two places are perceptually
    aliased.

    poses : (N, d+1, d+1) final
    seconds : (N,) of the scans
    """
    expected = lie.between(poses[closures.target], poses[closures.source])
    off = lie.between(expected, closures.T_target_source)[:, :-1, -1]
    size_m = np.linalg.norm(off, axis=1)
    chosen = np.flatnonzero(size_m > _LEAST_M)
    chosen = chosen[:: max(1, -(-len(chosen) // 3000))]  # more would take long
    if len(chosen) < FEWEST:
        return []
    edges, T = np.stack([closures.target, closures.source], axis=1)[chosen], closures.T_target_source[chosen]
    steps_m = np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(steps_m)])[edges]

    def agree(a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.bool_]:
        off_m = np.linalg.norm((carried(poses, edges[a], T[a], edges[b]) - T[b])[:, :-1, -1], axis=1)
        return off_m < _AGREE[0] + _AGREE[1] * np.abs(along_m[a] - along_m[b]).sum(axis=1)

    pairs = KDTree(along_m).query_pairs(_NEAR_M, p=1, output_type="ndarray")
    groups = []
    for members in connected(np.concatenate([pairs, pairs[:, ::-1]]), len(chosen), agree):
        low, high = edges[members].min(axis=1), edges[members].max(axis=1)
        first, last = int(low.max()), int(high.min())
        if first >= last:
            first, last = int(low.min()), int(high.max())
        start_s, end_s = seconds[[first, last]].tolist()
        wrong_m = float(np.median(size_m[chosen][members]))
        groups.append(Segment(Kind.LOOPS, first, last, len(members), start_s, end_s, wrong_m))
    return groups
