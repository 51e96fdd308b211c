"""The verdict of a run: whether its trajectory can be relied on, with reasons."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import product

import numpy as np

from scanchain import lie
from scanchain.data import LEAST_FIT, Matrix, Pose
from scanchain.errors import at_most, counted
from scanchain.verdict.checks import WINDOW_M, Kind, Stretch
from scanchain.verdict.stretches import KNOWN, Evidence, find_stretches

MOST_CONTRADICTED = 0.1  # largest share of contradicted scans; good real runs have up to 0.025
_MOST_PREDICTED = 0.5  # largest share of scans with a predicted pose that nothing confirms
_LARGE_M = 1.0  # jump by an impossible acceleration above which the trajectory is wrong
_EXPLAINED = 0.5  # least share of a contradiction by loop closures that the wheels must confirm
_FEW_POINTS = 100  # number of points below which a scan is sparse; scans of planar lidars have more
_UNMEASURED = (Kind.DEGENERATE, Kind.LOST, Kind.CONTRADICTED, Kind.OVERLAP)
_MOST_OPEN = 0.2  # largest share of degenerate scans of a trajectory that is trustworthy
_MEDIAN_LIMIT = 2.0  # largest median innovation of the wheels; about 1 where their calibration and σ are right
_REST_M, _REST_RAD, _REST_M_S = 1.0, 0.5, 0.1  # largest extent, rotation and mean speed at rest
_MOST_OPEN_AT_REST = 0.05  # largest share of unconstrained or contradicted scans from which a rest is concluded
_FEWEST_TRIED, _LEAST_ACCEPTED = 10, 0.2  # least number of scans that tried closures; closures accepted per scan
_OPPOSED = -0.5  # ratio of the rotations of trajectory and wheels below which one of the two is mirrored
_SHOWN = 3  # number of segments that a reason lists
_MORE = re.compile(r"and [\d,]+ more")
_WORKABLE, _WORKABLE_M = 0.03, 0.1  # largest upper bound of the error: share of the trajectory's extent, or meters


class Verdict(StrEnum):
    """Reliability of a trajectory as a whole."""

    TRUSTWORTHY = "trustworthy"
    CHECK = "check these stretches"
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
    stretches: tuple[Stretch, ...] = ()
    error: str = ""
    bound_m: float = np.inf

    @property
    def vouched(self) -> str:
        """The error estimate where it is valid: outside of the segments to check; empty if not trustworthy."""
        words = {Verdict.TRUSTWORTHY: "", Verdict.CHECK: "otherwise "}
        return f"{words[self.verdict]}{self.error}" if self.error and self.verdict in words else ""

    @property
    def headline(self) -> str:
        """Verdict and error."""
        return f"{self.verdict}{f' ({self.vouched})' if self.vouched else ''}"

    @property
    def reasons(self) -> list[str]:
        """The single reasons, followed by all suspicious segments not among them."""
        said = [each for each in self.reason.split("; ") if not _MORE.fullmatch(each)]
        return [*said, *(each.text for each in self.stretches if each.text not in said)]

    @property
    def sentence(self) -> str:
        """Verdict, error and reasons; of many segments, only the largest."""
        return f"{self.headline}: {self.reason}"


def judge(evidence: Evidence, T_base_lidar: Pose | None = None, distortion: str = "") -> Judged:
    """The verdict on a trajectory, with reasons.

    A trajectory is not trustworthy if most poses are predicted, many scans are contradicted, the acceleration is
    impossible, wheels contradict it where it is badly measured, or loop closures and wheels contradict it over the
    same segment by about the same distance. It is to be checked if any segment is suspicious, or the whole is:
    motion is indistinguishable from rest, wheels disagree throughout or turn opposite, the error is unbounded or
    large, many scans are degenerate, few closures are accepted, or scans are distorted. Segments where only the
    wheels slipped are reported, but do not affect the verdict.

    T_base_lidar : mounting stated by the log; None if none is
    distortion : motion distortion of the scans in words; empty for none
    """
    found = find_stretches(evidence)
    stretches = tuple(each for each in found if each.kind is not Kind.WHEELS_SLIP)
    slips = [f"{each.kind} at {each.times} ({each.size_m:,.1f} m)" for each in found if each not in stretches]
    rest = _Rest.of(evidence)
    notes = [*([rest.text] if rest.is_shown else []), *slips]
    if (mounting := evidence.wheels.mounting) is not None:
        T = mounting.T_base_lidar if T_base_lidar is None else T_base_lidar @ mounting.T_base_lidar
        where = ", seen from there" if T_base_lidar is None else ""
        said = mounting._replace(T_base_lidar=T).text
        notes.append(f"the motions of lidar and wheels contradict the mounting that was taken{where}: {said}")
    error = evidence.error or (
        f"error below {max(rest.extent_m, evidence.open_m):.2g} m" if rest.is_shown else "error unknown"
    )
    if reasons := list(_grave(evidence, stretches)):
        verdict = Verdict.NOT_TRUSTWORTHY
    elif reasons := [*_doubts(evidence, stretches, rest), *filter(None, [distortion])]:
        verdict = Verdict.CHECK
    else:
        verdict, reasons = Verdict.TRUSTWORTHY, list(_nothing(evidence))
    return Judged(verdict, "; ".join([*reasons, *notes]), stretches, error, evidence.bound_m)


def _grave(evidence: Evidence, stretches: Sequence[Stretch]) -> Iterator[str]:
    if len(evidence) == 1:
        yield "one scan has no motion that could be checked"
    yield from _many_contradicted(evidence)
    yield from _mostly_predicted(evidence)
    jumps = [each for each in stretches if each.kind is Kind.ACCELERATION and (each.size_m or 0.0) > _LARGE_M]
    if jumps:
        yield _listed(jumps)
    for slip in (each for each in stretches if each.kind is Kind.SCANS_SLIP):
        yield f"{slip.kind} at {slip.times} ({slip.size_m:,.1f} m): wheels and loop closures agree with each other"
    slips = [each for each in stretches if each.kind is Kind.WHEELS]
    for slip in slips:
        cause = next((each for each in stretches if each.kind in _UNMEASURED and _overlap(each, slip)), None)
        if cause is not None:
            yield f"{slip.text}, at scans that are not well measured: {cause.kind}"
    loops = [each for each in stretches if each.kind is Kind.LOOPS]
    for loop, slip in product(loops, slips):
        is_explained = (slip.size_m or 0.0) > _EXPLAINED * (loop.size_m or 0.0)
        if is_explained and _overlap(slip, loop):
            yield (
                f"{slip.text}, and {counted(loop.scans, 'loop closure')} between scans {loop.first:,} and "
                f"{loop.last:,} by {loop.size_m:.1f} m"
            )
            return


def _overlap(a: Stretch, b: Stretch) -> bool:
    return a.first <= b.last and b.first <= a.last


def _many_contradicted(evidence: Evidence) -> Iterator[str]:
    total = int(evidence.is_contradicted.sum())
    count = int((evidence.is_contradicted & ~evidence.is_held_by_wheels).sum())
    if count > MOST_CONTRADICTED * len(evidence):
        held = f", {total - count:,} of them where the wheels agree" if count < total else ""
        yield (
            f"{total:,} of {len(evidence):,} scans are contradicted by the map where they were placed (fit below "
            f"{LEAST_FIT:g}{held}): the motion between scans may be larger than the search, or the log is "
            "at fault (scanchain doctor)"
        )


def _mostly_predicted(evidence: Evidence) -> Iterator[str]:
    is_open = evidence.is_degenerate & ~evidence.is_held_by_wheels
    if (is_open | evidence.is_lost).sum() <= _MOST_PREDICTED * len(evidence):
        return
    line = (
        f"{int(evidence.is_degenerate.sum()):,} of {len(evidence):,} scans are degenerate and "
        f"{int(evidence.is_lost.sum()):,} lost: most poses are predicted, not measured, in at least one direction"
    )
    points = float(np.median(evidence.points))
    if points < _FEW_POINTS:
        few = f"scans have {points:.0f} valid points (median)"
        yield f"{line}; {few}, as a radar's have: choose a lidar with --topic"
    else:
        yield f"{line}: the surroundings do not constrain it there, or the log is faulty (scanchain doctor)"


def _doubts(evidence: Evidence, stretches: Sequence[Stretch], rest: _Rest) -> Iterator[str]:
    if evidence.wheels.turn_ratio < _OPPOSED:
        yield (
            "the lidar turns left where the wheels turn right: the scans are mirrored (a lidar upside down that "
            "/tf_static does not state so: --log.upside_down true), or the wheels are"
        )
    if rest.is_there and not rest.is_shown:
        yield rest.text
    yield from _unlike_wheels(evidence)
    yield from _unbounded(evidence, rest)
    count = int(evidence.is_degenerate.sum())
    if count > _MOST_OPEN * len(evidence):
        yield (
            f"{count:,} of {len(evidence):,} scans are degenerate: in at least one direction poses are those of "
            "the prediction, by wheels where these are used"
        )
    tried, accepted = evidence.closures.tried, int(evidence.closures.is_accepted.sum())
    if tried >= _FEWEST_TRIED and accepted < _LEAST_ACCEPTED * tried:
        yield (
            f"loop closures were tried from {tried:,} scans, {accepted:,} accepted: where the trajectory returns, "
            "the place does not look as mapped"
        )
    if stretches:
        yield _listed(stretches)


def _unbounded(evidence: Evidence, rest: _Rest) -> Iterator[str]:
    """Reason if the error is unknown, or may be too large for the extent of the trajectory."""
    limit_m = max(_WORKABLE * rest.extent_m, _WORKABLE_M)
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

    Scans that constrain every direction show it, and so do wheels. Along an unconstrained direction, the scans of
    a moving lidar are the same as those of one at rest.
    """

    is_there: bool
    is_shown: bool
    extent_m: float
    text: str

    @classmethod
    def of(cls, evidence: Evidence) -> _Rest:
        motion = np.abs(lie.log(lie.between(evidence.poses[:1], evidence.poses)))
        d = evidence.poses.shape[-1] - 1
        seconds, has_wheels = float(evidence.seconds[-1]), evidence.wheels.known_share >= KNOWN
        extent_m, limit_m = _extent_m(evidence.poses), min(_REST_M, _REST_M_S * seconds)
        is_there = bool(extent_m < limit_m and motion[:, d:].max() < _REST_RAD)
        is_there &= not has_wheels or _extent_m(evidence.wheels.poses) < limit_m
        is_open = evidence.is_degenerate | evidence.is_lost | evidence.is_contradicted
        is_observed = bool(np.isfinite(evidence.fit).any() and is_open.mean() <= _MOST_OPEN_AT_REST)
        is_shown = is_there and (is_observed or has_wheels)
        text = f"does not move (stays within {extent_m:.3f} m for {seconds:.1f} s)"
        if not is_shown:
            text = (
                f"stays within {extent_m:.2f} m for {seconds:.1f} s: at rest, or in motion along a direction in "
                "which everything looks the same; nothing in the log tells which"
            )
        return cls(is_there, is_shown, extent_m, text)


def _extent_m(poses: Matrix) -> float:
    """Largest distance of poses (N, d+1, d+1) from the first that is known."""
    positions = poses[np.isfinite(poses[:, 0, 0]), :-1, -1]
    return float(np.linalg.norm(positions - positions[0], axis=1).max())


def _unlike_wheels(evidence: Evidence) -> Iterator[str]:
    """Reason if the wheels disagree throughout, by more than the largest σ that is learned for them."""
    wheels = evidence.wheels
    known = np.isfinite(wheels.innovation)
    if not known.any() or np.median(wheels.innovation[known]) <= _MEDIAN_LIMIT:
        return
    apart_m, apart_deg = np.median(wheels.apart_m[known]), np.degrees(np.median(wheels.apart_rad[known]))
    yield (
        f"the wheels disagree with the trajectory all along, by {apart_m:.1f} m and {apart_deg:.0f} deg over "
        f"{WINDOW_M:g} m (medians): their scale is wrong, they slip, or the lidar follows what moves along"
    )


def _listed(stretches: Sequence[Stretch]) -> str:
    """The largest segments in words, and how many more there are."""
    largest = sorted(stretches, key=lambda each: (each.size_m or 0.0, each.scans), reverse=True)[:_SHOWN]
    more = len(stretches) - len(largest)
    return "; ".join(each.text for each in largest) + (f"; and {more:,} more" if more else "")


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
    checks = {
        "fit": evidence.fit,
        "overlap": evidence.overlap,
        "constant velocity": evidence.velocity,
        "wheels": evidence.wheels.innovation,
        "loop closures": evidence.closures.target,
    }
    if made := [name for name, values in checks.items() if np.isfinite(values).any()]:
        yield f"checked by {', '.join(made)}"
