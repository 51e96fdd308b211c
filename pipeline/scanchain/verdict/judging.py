"""The verdict of a run: whether its trajectory can be relied on, with reasons."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from scanchain import lie
from scanchain.data import Pose
from scanchain.errors import at_most, counted
from scanchain.verdict.checks import CHECKS
from scanchain.verdict.evidence import Evidence, Segment, extent_m, listed

_REST_M, _REST_RAD, _REST_M_S = 1.0, 0.5, 0.1  # largest extent, rotation and mean speed at rest
_MOST_OPEN_AT_REST = 0.05  # largest share of unconstrained or contradicted scans from which a rest is concluded
_WORKABLE = (0.03, 0.1)  # largest upper bound of the error: share of the trajectory's extent, or meters
_MORE = re.compile(r"and [\d,]+ more")


class Verdict(StrEnum):
    """Reliability of a trajectory as a whole."""

    TRUSTWORTHY = "trustworthy"
    CHECK = "check these segments"
    NOT_TRUSTWORTHY = "not trustworthy"

    def fails(self, *, strict: bool) -> bool:
        """True if a command exits with 1: not trustworthy or, if strict, anything but trustworthy."""
        return self is Verdict.NOT_TRUSTWORTHY or (strict and self is not Verdict.TRUSTWORTHY)


@dataclass(frozen=True, slots=True)
class Judged:
    """A verdict, its reasons in words, the suspicious segments, and the error estimate.

    error, bound_m : the estimate in words, and the upper bound of the error; infinite where unknown
    """

    verdict: Verdict
    reason: str
    segments: tuple[Segment, ...] = ()
    error: str = ""
    bound_m: float = np.inf

    @property
    def valid_error(self) -> str:
        """The error estimate where it is valid: outside of the segments to check; empty if not trustworthy."""
        words = {Verdict.TRUSTWORTHY: "", Verdict.CHECK: "otherwise "}
        return f"{words[self.verdict]}{self.error}" if self.error and self.verdict in words else ""

    @property
    def headline(self) -> str:
        """Verdict and error."""
        return f"{self.verdict}{f' ({self.valid_error})' if self.valid_error else ''}"

    @property
    def reasons(self) -> list[str]:
        """The single reasons, followed by all suspicious segments not among them."""
        said = [each for each in self.reason.split("; ") if not _MORE.fullmatch(each)]
        return [*said, *(each.text for each in self.segments if each.text not in said)]

    @property
    def sentence(self) -> str:
        """Verdict, error and reasons; of many segments, only the largest."""
        return f"{self.headline}: {self.reason}"


def judge(evidence: Evidence, T_base_lidar: Pose | None = None, distortion: str = "") -> Judged:
    """The verdict on a trajectory by all ``CHECKS``, with reasons.

    A trajectory is not trustworthy if it fails a check: most poses are predicted, many scans are contradicted,
    the acceleration is impossible, another sensor contradicts it where it is badly measured, or together with
    loop closures. It is to be checked if any segment is suspicious, or the whole is: motion is indistinguishable
    from rest, the error is unbounded or large, a check warns of it, or scans are distorted. Segments where only
    the other sensor is wrong are reported, but do not affect the verdict.

    T_base_lidar : mounting stated by the log; None if none is
    distortion : motion distortion of the scans in words; empty for none
    """
    evidence = evidence.checked(CHECKS)
    checks, found, harmless = evidence.checks, list[Segment](), set[str]()
    for check in checks:
        found += check.segments(evidence, found)
        harmless |= {*check.harmless}
    found.sort(key=lambda each: (each.first, each.last))
    segments = tuple(each for each in found if each.kind not in harmless)
    slips = [f"{each.kind} at {each.times} ({each.size_m:,.1f} m)" for each in found if each.kind in harmless]
    rest = _Rest.of(evidence)
    notes = [*([rest.text] if rest.is_shown else []), *slips]
    notes += [note for check in checks for note in check.notes(T_base_lidar)]
    reasons = ["one scan has no motion that could be checked"] if len(evidence) == 1 else []
    reasons += [each for check in checks for each in check.failures(evidence, segments)]
    verdict = Verdict.NOT_TRUSTWORTHY
    if not reasons:
        reasons = [*_whole(evidence, rest), *(each for check in checks for each in check.warnings(evidence))]
        reasons += [listed(segments)] * bool(segments) + [distortion] * bool(distortion)
        verdict = Verdict.CHECK
    if not reasons:
        verdict, reasons = Verdict.TRUSTWORTHY, list(_nothing(evidence))
    error = evidence.error or (
        f"error below {max(rest.extent_m, evidence.open_m):.2g} m" if rest.is_shown else "error unknown"
    )
    return Judged(verdict, "; ".join([*reasons, *notes]), segments, error, evidence.bound_m)


def _whole(evidence: Evidence, rest: _Rest) -> Iterator[str]:
    """Reasons to check that concern the whole: whether it moves, and an error that is unknown or large."""
    if rest.is_there and not rest.is_shown:
        yield rest.text
    limit_m = max(_WORKABLE[0] * rest.extent_m, _WORKABLE[1])
    if rest.is_shown or evidence.bound_m <= limit_m:
        return
    if not np.isfinite(evidence.bound_m):
        yield "nothing bounds its error: no motion between keyframes, no wheels, no other estimate"
        return
    where = f": {evidence.uncertain}" if evidence.uncertain else ""
    yield f"its error may be {at_most(evidence.bound_m)} m, more than {limit_m:.2g} m{where}"


@dataclass(frozen=True, slots=True)
class _Rest:
    """Whether a trajectory stays at its first pose, and whether this shows that the lidar was at rest.

    Scans that constrain every direction show it, and so does another sensor that rests. Along an unconstrained
    direction, the scans of a moving lidar are the same as those of one at rest.
    """

    is_there: bool
    is_shown: bool
    extent_m: float
    text: str

    @classmethod
    def of(cls, evidence: Evidence) -> _Rest:
        motion = np.abs(lie.log(lie.between(evidence.poses[:1], evidence.poses)))
        d = evidence.poses.shape[-1] - 1
        seconds = float(evidence.seconds[-1])
        whole_m, limit_m = extent_m(evidence.poses), min(_REST_M, _REST_M_S * seconds)
        by_sources_m = [check.extent_m for check in evidence.checks if np.isfinite(check.extent_m)]
        is_there = bool(max([whole_m, *by_sources_m]) < limit_m and motion[:, d:].max() < _REST_RAD)
        is_open = evidence.is_degenerate | evidence.is_lost | evidence.is_contradicted
        is_observed = bool(np.isfinite(evidence.fit).any() and is_open.mean() <= _MOST_OPEN_AT_REST)
        is_shown = is_there and (is_observed or bool(by_sources_m))
        text = f"does not move (stays within {whole_m:.3f} m for {seconds:.1f} s)"
        if not is_shown:
            text = (
                f"stays within {whole_m:.2f} m for {seconds:.1f} s: at rest, or in motion along a direction in "
                "which everything looks the same; the log does not determine which"
            )
        return cls(is_there, is_shown, whole_m, text)


def _nothing(evidence: Evidence) -> Iterator[str]:
    """Reasons of a trustworthy verdict: no findings, why badly measured scans are harmless, the checks made."""
    kinds = {
        "fit the map badly": evidence.is_contradicted,
        "leave a direction open": evidence.is_degenerate,
        "have too few correspondences": evidence.is_lost,
    }
    counts = [f"{int(found.sum()):,} {words}" for words, found in kinds.items() if found.any()]
    yield f"nothing to check in {counted(len(evidence), 'scan')}"
    if counts:
        yield f"{' and '.join(counts)}, each over too short a path to move the trajectory"
    if made := [check.name for check in evidence.checks if check.name and check.is_made]:
        yield f"checked by {', '.join(made)}"
