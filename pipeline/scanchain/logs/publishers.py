"""Publishers of a lidar's topic, distinguished by frame and clock, and jumps of the header stamps."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby, islice, pairwise
from typing import NamedTuple

import numpy as np

from scanchain.data import OtherPoints, Pose, RawPoints
from scanchain.errors import duration
from scanchain.logs.mcap.records import Decoded
from scanchain.logs.messages.lidar import Returns, moved
from scanchain.logs.mounting import TILTED_RAD, place_text

_STEP_NS, _STEP_PERIODS = (
    1_000_000_000,
    5.0,
)  # larger steps of a clock are none of jitter, which Intel has up to 0.9 s
_STEADY = 3  # number of scans before and after a jump whose stamps must agree with each other
_TOGETHER_NS = 250_000_000  # of scans of several lidars that are matched as one: the motion in it is even
_REMEMBERED = 31  # number of scans before a jump
_CLOCKS_NS = 60_000_000_000  # least difference of two clocks in one frame: no message is as late as that
_RETURNS = 3  # least number of returns to a clock left: after fewer it was set

Timed = tuple[int, Returns]  # log time and contents of a message


class Publisher(NamedTuple):
    """A publisher: its frame, which of the clocks there, its pose in the frame of the others if that is another.

    ``note`` says how its scans are used, empty for the first one; ``is_used`` is False of one to be left out.
    """

    frame: str
    clock: int
    T_first_frame: Pose | None = None
    note: str = ""
    is_used: bool = True


class Publishers:
    """Publishers of one topic; the first is that with most returns, or one before it whose frame is joined to it.

    frame : of the first, which the points of the others are moved to
    """

    def __init__(
        self, sampled: Sequence[Timed], between: Callable[[str, str], Pose | None], *, is_planar: bool
    ) -> None:
        """Begin with messages from all over a log; ``between`` gives T_target_source of two frames."""
        self.between, self.is_planar = between, is_planar
        frames = dict.fromkeys(returns.frame for _, returns in sampled)
        self.clocks_ns = {frame: _clocks([each for each in sampled if each[1].frame == frame]) for frame in frames}
        self.frame, self.clock, self.known = "", 0, dict[tuple[str, int], Publisher]()
        self.offset_ns: int | None = None  # of the latest stamp of the first one against the log
        if not sampled:
            return
        keys = [self._key(*each) for each in sampled]
        counts = Counter({key: 0 for key in keys})
        counts.update(key for key, (_, returns) in zip(keys, sampled, strict=True) if len(returns.points))
        self.frame, self.clock = first = max(counts, key=counts.__getitem__)
        away_ns = {key: _apart(sampled, keys, key, first) for key in counts}
        used = [key for key in counts if counts[key] and self._publisher(key, away_ns[key]).is_used]
        self.frame, self.clock = used[0] if used else first
        self.known = {key: self._publisher(key, away_ns[key]) for key in counts}

    @property
    def notes(self) -> list[str]:
        """Lines on all but the first one."""
        return [publisher.note for publisher in self.known.values() if publisher.note]

    def of(self, log_time_ns: int, returns: Returns) -> Publisher:
        """The publisher of a message."""
        key, offset_ns = self._key(log_time_ns, returns), returns.stamp_ns - log_time_ns
        if key not in self.known:
            self.frame = self.frame if self.known else returns.frame
            away_ns = 0 if self.offset_ns is None or not returns.stamp_ns else offset_ns - self.offset_ns
            self.known[key] = self._publisher(key, away_ns)
        if key == (self.frame, self.clock):
            self.offset_ns = offset_ns
        return self.known[key]

    def _key(self, log_time_ns: int, returns: Returns) -> tuple[str, int]:
        clocks_ns = self.clocks_ns.get(returns.frame, ())
        if len(clocks_ns) < 2 or not returns.stamp_ns:
            return returns.frame, 0 if returns.frame != self.frame else self.clock
        offset_ns = returns.stamp_ns - log_time_ns
        return returns.frame, min(range(len(clocks_ns)), key=lambda k: abs(clocks_ns[k] - offset_ns))

    def _publisher(self, key: tuple[str, int], away_ns: int) -> Publisher:
        """A publisher whose clock is so far from that of the first."""
        (frame, clock), first = key, self.frame
        if key == (first, self.clock):
            return Publisher(frame, clock)
        name, remedy = f"frame {frame or 'without a name'}", "record each publisher on a topic of its own"
        T = np.eye(4) if frame == first else self.between(first, frame)
        tilted_rad = 0.0 if T is None or not self.is_planar else np.arccos(np.clip(abs(T[2, 2]), 0.0, 1.0))
        why = ""
        if abs(away_ns) > _STEP_NS:
            side = "ahead of" if away_ns > 0 else "behind"
            other = "the first" if frame == first else f"frame {first}"
            why = f"its clock is {duration(1e-9 * abs(away_ns))} {side} that of {other}; {remedy}"
        elif T is None:
            why = f"no static transform leads to frame {first}, that of the others; record it, or {remedy}"
        elif tilted_rad > TILTED_RAD:
            why = f"its plane is tilted by {np.degrees(tilted_rad):.0f} deg against frame {first}; {remedy}"
        if why or T is None:
            return Publisher(frame, clock, None, f"a second publisher of scans, {name}, is left out: {why}", False)
        note = f"scans of {name} are moved to frame {first}: by the transforms it is at {place_text(T)}"
        return Publisher(frame, clock, T, note)


class LatestPoints:
    """The latest points of each publisher, in the frame of the first, by frame."""

    def __init__(self) -> None:
        self.latest: dict[str, tuple[int, OtherPoints]] = {}

    def of(
        self, publishers: Publishers, message: Decoded, *, is_mirrored: bool
    ) -> tuple[RawPoints, OtherPoints | None]:
        """Points of a scan, which are remembered, and those of other publishers just before it."""
        returns = message.value
        assert isinstance(returns, Returns)
        points = moved(returns.points, publishers.of(message.log_time_ns, returns).T_first_frame)
        points = points * np.array([1.0, -1.0], np.float32) if is_mirrored else points
        if len(publishers.known) < 2:
            return points, None
        near = [
            (1e-9 * (other_ns - returns.stamp_ns), other)
            for frame, (other_ns, other) in self.latest.items()
            if frame != returns.frame and 0 <= returns.stamp_ns - other_ns <= _TOGETHER_NS
        ]
        self.latest[returns.frame] = returns.stamp_ns, OtherPoints(points, returns.times_s)
        if not near:
            return points, None
        times_s = [
            np.full(len(other.points), away_s) if not len(other.times_s) else other.times_s + away_s
            for away_s, other in near
        ]
        seen = np.concatenate([other.points for _, other in near])
        return points, OtherPoints(seen, np.concatenate(times_s).astype(np.float32))


def _clocks(sampled: Sequence[Timed]) -> list[int]:
    """Offsets of the clocks against the log that messages of one frame, in order, have in turn; one as a rule."""
    offsets_ns = [returns.stamp_ns - log_time_ns for log_time_ns, returns in sampled if returns.stamp_ns]
    ordered = sorted(offsets_ns)
    edges = [b for a, b in pairwise(ordered) if b - a > _CLOCKS_NS]
    of_clock = [sum(edge <= offset_ns for edge in edges) for offset_ns in offsets_ns]
    if len(list(groupby(of_clock))) - len(edges) - 1 < _RETURNS:
        return ordered[:1]
    groups = (
        [o for o, each in zip(offsets_ns, of_clock, strict=True) if each == k] for k in range(len(edges) + 1)
    )
    return [sorted(group)[len(group) // 2] for group in groups]


def _apart(sampled: Sequence[Timed], keys: Sequence[tuple[str, int]], key: object, first: object) -> int:
    """Median difference of the clocks of two publishers, by messages that follow each other."""
    offsets_ns = [returns.stamp_ns - log_time_ns if returns.stamp_ns else None for log_time_ns, returns in sampled]
    of_both = [(k, o) for k, o in zip(keys, offsets_ns, strict=True) if k in (key, first) and o is not None]
    steps_ns = [(b - a) * (1 if k == first else -1) for (k, a), (j, b) in pairwise(of_both) if k != j]
    return sorted(steps_ns)[len(steps_ns) // 2] if steps_ns else 0


def with_jumps(messages: Iterable[tuple[Decoded, Pose | None]]) -> Iterator[tuple[Decoded, Pose | None, float]]:
    """Messages with the seconds by which their stamps jump since the one before; 0 as a rule.

    A step back, or one ahead that the log does not take, is a jump if the stamps before and after it are as far
    from the log as ever, but for the step: single wrong stamps, jitter and late messages are none.
    """
    before: deque[tuple[int, int]] = deque(maxlen=_REMEMBERED)
    waiting: deque[tuple[Decoded, Pose | None]] = deque()
    rest = iter(messages)
    while first := waiting.popleft() if waiting else next(rest, None):
        now, jump_s = _times(first[0]), 0.0
        if now and before:
            if len(before) >= _STEADY and not 0 <= now[0] - before[-1][0] <= _STEP_NS:
                waiting += islice(rest, _STEADY - len(waiting))
                coming = filter(None, (_times(message) for message, _ in waiting))
                jump_s = _jump_s(before, now, [offset_ns for _, offset_ns in coming])
            if jump_s:
                before.clear()
        if now:
            before.append(now)
        yield *first, jump_s


def _times(message: Decoded) -> tuple[int, int] | None:
    """Stamp of a scan, and its offset against the log; None without a stamp or a point."""
    returns = message.value
    if not isinstance(returns, Returns) or not len(returns.points) or not returns.stamp_ns:
        return None
    return returns.stamp_ns, returns.stamp_ns - message.log_time_ns


def _jump_s(before: Sequence[tuple[int, int]], now: tuple[int, int], coming_ns: Sequence[int]) -> float:
    """Seconds of a jump, 0 where it is none; ``coming_ns`` are the offsets of the scans behind it."""
    stamps_ns, offsets_ns = np.array(before, np.int64).T
    step_ns, limit_ns = now[0] - before[-1][0], max(_STEP_NS, _STEP_PERIODS * float(np.median(np.diff(stamps_ns))))
    after_ns = [now[1], *coming_ns]
    is_back = step_ns < -limit_ns and max(after_ns) < np.median(offsets_ns) - limit_ns
    is_ahead = step_ns > limit_ns and min(after_ns) > offsets_ns.max() + limit_ns
    return 1e-9 * step_ns if is_back or is_ahead else 0.0
