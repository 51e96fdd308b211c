"""Publishers of a lidar's topic, distinguished by frame, and jumps of the header stamps."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np

from scanchain.data import OtherPoints, Pose
from scanchain.errors import duration
from scanchain.logs.index import Decoded
from scanchain.logs.messages.lidar import Returns, moved
from scanchain.logs.mounting import TILTED_RAD, place_text, tilt_rad

_STEP_NS, _STEP_PERIODS = 1_000_000_000, 5  # largest step of a clock by jitter (0.9 s in Intel), and in periods
_STEADY = 3  # number of scans before and after a jump that must agree with each other
_TOGETHER_NS = 250_000_000  # longest time between scans of several lidars that are matched together


class Publisher(NamedTuple):
    """A publisher: its frame, its pose in the first one's frame, and a note on its use, empty for the first."""

    frame: str
    T_first_frame: Pose | None = None
    note: str = ""
    is_used: bool = True


class Publishers:
    """Publishers of one topic by frame; points are moved to ``frame``, that with most nonempty scans."""

    def __init__(
        self,
        sample: Callable[..., Iterable[Decoded]],
        between: Callable[[str, str], Pose | None],
        *,
        is_planar: bool,
    ) -> None:
        """Find the publishers of sampled messages, ``most`` per block; ``between`` returns T_target_source."""
        sampled = list(sample(blocks=1, most=128 if is_planar else 16))
        if not any(len(each.value.points) for each in sampled):
            sampled = list(sample())  # from all over the log
        self.between, self.is_planar = between, is_planar
        self.offsets_ns = [
            (value.frame, value.stamp_ns - log_ns) for _, log_ns, value in sampled if value.stamp_ns
        ]
        self.frame, self.known = "", dict[str, Publisher]()
        returned = Counter[str]()
        for each in sampled:
            returned[each.value.frame] += len(each.value.points) > 0
        for frame, _ in returned.most_common():
            self.of(frame)

    @property
    def notes(self) -> list[str]:
        """Notes on all publishers except the first."""
        return [publisher.note for publisher in self.known.values() if publisher.note]

    def of(self, frame: str) -> Publisher:
        """The publisher with this frame."""
        if not self.known:
            self.frame, self.known[frame] = frame, Publisher(frame)
        elif frame not in self.known:
            self.known[frame] = self._further(frame, f"frame {frame or 'without a name'}")
        return self.known[frame]

    def joined(self, frame: str, away_ns: float, T_stated: Pose | None = None) -> tuple[Pose, str]:
        """T_first_frame of a frame, and why its points cannot be moved by it; empty if they can."""
        T = T_stated
        if T is None:
            T = self.between(self.frame, frame) if frame != self.frame else np.eye(4)
        if abs(away_ns) > _STEP_NS:
            side = "ahead of" if away_ns > 0 else "behind"
            return np.eye(4), f"its clock is {duration(1e-9 * abs(away_ns))} {side} that of frame {self.frame}"
        if T is None:
            return np.eye(4), f"no static transform leads to frame {self.frame}"
        if not self.is_planar or tilt_rad(T) <= TILTED_RAD:
            return T, ""
        return T, f"its plane is tilted by {np.degrees(tilt_rad(T)):.0f} deg against frame {self.frame}"

    def _further(self, frame: str, name: str) -> Publisher:
        T, why = self.joined(frame, self._away_ns(frame))
        if not why:
            note = f"scans of {name} are moved to frame {self.frame}: by the transforms it is at {place_text(T)}"
            return Publisher(frame, T, note)
        why = f"a second publisher of scans, {name}, is left out: {why}; record each on a topic of its own"
        return Publisher(frame, None, why, is_used=False)

    def _away_ns(self, frame: str) -> int:
        """Median offset of the clock of ``frame`` from that of the first publisher, over consecutive messages."""
        of_both = [each for each in self.offsets_ns if each[0] in (frame, self.frame)]
        signs = {frame: 1, self.frame: -1}
        away_ns = sorted((b - a) * signs[g] for (f, a), (g, b) in pairwise(of_both) if f != g)
        return away_ns[len(away_ns) // 2] if away_ns else 0


def seen_together(
    returns: Returns, publishers: Publishers, latest: dict[str, tuple[int, OtherPoints]], *, is_mirrored: bool
) -> tuple[OtherPoints, tuple[OtherPoints, ...]]:
    """Points of a scan in the first publisher's frame, and those of each other publisher just before it.

    latest : header stamp and points of the last scan of each frame; updated
    """
    own = in_first_frame(returns, publishers.of(returns.frame).T_first_frame, is_mirrored=is_mirrored)
    if len(publishers.known) < 2:
        return own, returns.others
    near = tuple(
        other._replace(times_s=other.times_s + np.float32(1e-9 * (other_ns - returns.stamp_ns)))
        for frame, (other_ns, other) in latest.items()
        if frame != returns.frame and 0 <= returns.stamp_ns - other_ns <= _TOGETHER_NS
    )
    times_s = returns.times_s if len(returns.times_s) else np.zeros(len(own.points), np.float32)
    latest[returns.frame] = returns.stamp_ns, own._replace(times_s=times_s)
    return own, (*near, *returns.others)


def in_first_frame(returns: Returns, T_first_frame: Pose | None, *, is_mirrored: bool) -> OtherPoints:
    """Points of a message in the first publisher's frame, their times, and where its lidar is there."""
    d = returns.points.shape[1]
    points = moved(returns.points, T_first_frame)
    origin = np.zeros(d) if T_first_frame is None else T_first_frame[:d, -1]
    if is_mirrored:
        points, origin = points * np.array([1.0, -1.0], np.float32), origin * [1.0, -1.0]
    return OtherPoints(points, returns.times_s, origin)


def with_jumps(messages: Iterable[tuple[Decoded, Pose | None]]) -> Iterator[tuple[Decoded, Pose | None, float]]:
    """Messages with the jump of their stamp since the previous one, in seconds; usually 0.

    A step back, or a step ahead that the log times do not show, is a jump if the next scans' offsets from log time
    to stamp have all shifted too: single wrong stamps, jitter and late messages are not jumps.
    """
    before: deque[tuple[int, int]] = deque(maxlen=31)  # that a step is compared with
    waiting: deque[tuple[Decoded, Pose | None]] = deque()
    rest = iter(messages)
    while first := waiting.popleft() if waiting else next(rest, None):
        now, jump_s = _times(first[0]), 0.0
        if now and len(before) >= _STEADY and not 0 <= now[0] - before[-1][0] <= _STEP_NS:
            waiting += islice(rest, _STEADY - len(waiting))
            jump_s = _jump_s(before, [now, *filter(None, (_times(message) for message, _ in waiting))])
        if jump_s:
            before.clear()
        if now:
            before.append(now)
        yield *first, jump_s


def _times(message: Decoded) -> tuple[int, int] | None:
    """Stamp of a scan and its offset from the log time; None without a stamp or a point."""
    returns = message.value
    if not isinstance(returns, Returns) or not len(returns.points) or not returns.stamp_ns:
        return None
    return returns.stamp_ns, returns.stamp_ns - message.log_time_ns


def _jump_s(before: Sequence[tuple[int, int]], after: Sequence[tuple[int, int]]) -> float:
    """Size of a jump in seconds, from ``_times`` of the scans before and after it; 0 if it is none."""
    stamps_ns, offsets_ns = np.array(before, np.float64).T  # times of a damaged log may overflow integers
    step_ns, after_ns = after[0][0] - before[-1][0], [offset_ns for _, offset_ns in after]
    limit_ns = max(_STEP_NS, _STEP_PERIODS * float(np.median(np.diff(stamps_ns))))
    is_back = step_ns < -limit_ns and max(after_ns) < np.median(offsets_ns) - limit_ns
    is_ahead = step_ns > limit_ns and min(after_ns) > offsets_ns.max() + limit_ns
    return 1e-9 * step_ns if is_back or is_ahead else 0.0
