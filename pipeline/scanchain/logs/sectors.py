"""Messages that are sectors of a revolution: detected in the first messages, assembled into sweeps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.data import RawPoints
from scanchain.errors import counted
from scanchain.logs.index import Decoded
from scanchain.logs.messages.lidar import Returns
from scanchain.logs.messages.point_times import UNITS_S, PointTimes

# limits chosen with the lidars of tests/logs/test_sectors.py
_TURN_RAD = 2.0 * np.pi
_WIDEST_RAD = 4.0 / 3.0 * np.pi  # angular width of a message above which it is a sweep by itself
_FEWEST = 3  # number of messages after which a lidar that always faces one direction is recognized
MOST = 1000  # largest number of messages sampled; usually fewer suffice
_REVOLUTIONS = 2.0  # smallest number of revolutions in the sample
_WIDTHS = (0.5, 1.5)  # limits of a sector's width over the angle to the next
_REGULAR = 0.6  # smallest share of messages at the usual angle to the next; others are lost or blind sectors
_SLOWEST_S = 1.5  # longest revolution of a lidar; a slower rotation may be the robot's
_CLEAR_RAD = 2.0 / 3.0 * np.pi  # largest angle between messages that shows the sense of rotation
_SAME = 0.1  # share of a sector by which directions may differ that count as equal
_MISSING = 0.75  # length of a gap, in revolutions, above which it ends the sweep


class Sectors(NamedTuple):
    """Division of a lidar's revolution into messages.

    sense : 1 if it turns counterclockwise, −1 if clockwise
    step_rad : usual angle from one message to the next
    per_sweep : messages per revolution, not an integer if they do not divide it evenly
    period_s : duration of a revolution
    point_times : ``log.point_times`` for the messages, its unit inferred from the duration of a sector
    assumed : note that point times are computed from azimuth; empty if points have their own
    """

    sense: int
    step_rad: float
    per_sweep: float
    period_s: float
    point_times: str = "auto"
    assumed: str = ""

    def note(self, topic: str) -> str:
        """Description of the sectors and of their assembly, as text."""
        covers = f"each message covers {360.0 / self.per_sweep:.3g}° of a revolution"
        return f"{topic}: {covers}: {self.per_sweep:.3g} messages are assembled to one sweep"


def expected_sweeps(messages: int, sectors: Sectors | None) -> int:
    """Number of sweeps in ``messages`` messages; an incomplete last one counts from half a revolution on."""
    return messages if sectors is None else max(int(messages / sectors.per_sweep + 0.5), 1)


def find_sectors(sample: Iterable[Returns], point_times: str) -> Sectors | None:
    """Sectors that consecutive messages of one frame cover in turn; None if each message is a sweep by itself.

    point_times : ``log.point_times`` as configured
    """
    seen: list[Returns] = []
    directions_rad, widths_rad, steps_rad = list[float](), list[float](), np.empty(0)
    for returns in sample:
        points = returns.points
        if not len(points):
            continue
        seen.append(returns)
        directions_rad.append(_direction(points))
        turned_rad = _wrapped(_azimuth(points[:: len(points) // 250 + 1]) - directions_rad[-1])  # evenly spaced
        widths_rad.append(float(np.ptp(np.percentile(turned_rad, (5.0, 95.0)))) / 0.9)
        steps_rad = np.abs(_wrapped(np.diff(directions_rad)))
        is_one_way = len(seen) == _FEWEST and np.median(widths_rad) > _WIDTHS[1] * np.median(steps_rad)
        if widths_rad[-1] > _WIDEST_RAD or returns.frame != seen[0].frame or is_one_way:
            return None
        if steps_rad.sum() > (_REVOLUTIONS + 1.0) * _TURN_RAD or len(seen) == MOST:
            break
    found = _sectors(seen, np.array(directions_rad), float(np.median(widths_rad))) if len(seen) > 2 else None
    return found and _timed(found, seen, point_times)


def _sectors(seen: Sequence[Returns], directions_rad: NDArray[np.float64], width_rad: float) -> Sectors | None:
    """Sectors from the directions (N,) of the first messages; None if these do not rotate steadily."""
    steps_rad = _wrapped(np.diff(directions_rad))
    sense = int(np.sign(np.median(steps_rad)))
    if np.median(np.abs(steps_rad)) > _CLEAR_RAD:
        sense = int(np.sign(sum(map(_order, seen)))) or 1
    steps_rad = (sense * steps_rad) % _TURN_RAD
    step_rad = float(np.percentile(steps_rad, 50.0, method="lower"))
    turned_rad = np.append(0.0, np.cumsum(steps_rad))
    is_usual = np.abs(_wrapped(steps_rad - step_rad)) <= 0.5 * step_rad
    step_rad = float(steps_rad[is_usual].mean())
    is_sector = _WIDTHS[0] * step_rad <= width_rad <= _WIDTHS[1] * step_rad and np.mean(is_usual) >= _REGULAR
    if not is_sector or turned_rad[-1] + 1.5 * step_rad < _REVOLUTIONS * _TURN_RAD:
        return None
    first = np.flatnonzero(turned_rad + _TURN_RAD < turned_rad[-1] + 0.5 * step_rad)
    later = np.abs(turned_rad[:, None] - turned_rad[first] - _TURN_RAD).argmin(axis=0)
    drift_rad = turned_rad[later] - turned_rad[first] - _TURN_RAD
    stamps_ns = np.array([each.stamp_ns for each in seen])
    seconds = 1e-9 * (stamps_ns[later] - stamps_ns[first])
    period_s = float(np.median(seconds * _TURN_RAD / (_TURN_RAD + drift_rad)))
    if not 0.0 < period_s < _SLOWEST_S:
        return None
    per_sweep = float(_TURN_RAD / np.mean(steps_rad))
    if np.median(np.abs(drift_rad)) < _SAME * step_rad:  # the same sectors recur: a whole number of them
        per_sweep = float(np.max(later - first))
    return Sectors(sense, step_rad, per_sweep, period_s)


def _timed(sectors: Sectors, seen: Sequence[Returns], configured: str) -> Sectors:
    """Sectors with the unit of their point times: that in which a message lasts about as long as a sector.

    Point times are ignored if they count from the start of the revolution, or if only the revolution is stamped.
    """
    point_times = configured if configured in (*UNITS_S, "auto") else "none"
    if configured == "auto":
        spans_s = [float(np.ptp(times_s)) for each in seen if len(times_s := each.seconds("s"))]
        if spans_s:
            longer = max(float(np.median(spans_s)), 1e-9) / sectors.period_s * sectors.per_sweep
            point_times = min(UNITS_S, key=lambda name: abs(np.log(longer * UNITS_S[name])))
    of_each = [each.seconds(point_times) for each in seen] if point_times in UNITS_S else []
    starts_s = [float(times_s.min()) for times_s in of_each if len(times_s)]
    last_s = sectors.period_s * (1.0 - 1.0 / sectors.per_sweep)  # from the first sector to the last
    is_from_sweep = len(starts_s) > 1 and float(np.ptp(starts_s)) > 0.5 * last_s
    is_stamped = np.median(np.diff([each.stamp_ns for each in seen])) > 0
    point_times = point_times if is_stamped and not is_from_sweep else "none"
    turn = f"{'counterclockwise' if sectors.sense > 0 else 'clockwise'}, {sectors.period_s:.3g} s per turn"
    by_azimuth = f"point times by the azimuth: {turn}, from the sweep's first stamp"
    is_own = bool(starts_s) and point_times != "none"
    return sectors._replace(point_times=point_times, assumed="" if is_own else by_azimuth)


class _Part(NamedTuple):
    """A message, or part of one, in a sweep: the angle of its middle from the nominal start, and its azimuth."""

    message: Decoded
    returns: Returns
    angle_rad: float
    direction_rad: float


class Assembler:
    """Assembly of sector messages into sweeps; ``incomplete`` counts the sweeps left out."""

    def __init__(self, sectors: Sectors, topic: str, times: PointTimes) -> None:
        self.sectors, self.topic, self.times = sectors, topic, times
        self.half_rad, self.rate = 0.5 * sectors.step_rad, sectors.period_s / _TURN_RAD
        self.is_split = not sectors.per_sweep.is_integer()
        self.incomplete = 0

    def sweeps(self, messages: Iterable[Decoded]) -> Iterator[Decoded]:
        """Messages, those of the lidar assembled into sweeps; malformed ones and other topics pass unchanged.

        A sweep has the stamp of its beginning and the log time of its last message. It ends with the revolution,
        which splits a message if messages do not divide it evenly, or at a gap of most of a revolution. A sweep of
        less than half a revolution is left out.
        """
        parts: list[_Part] = []
        for message in messages:
            if message.channel.topic != self.topic or not isinstance(message.value, Returns):
                yield message
                continue
            part, is_apart = self._following(parts[-1] if parts else None, message, message.value)
            beyond_rad = part.angle_rad - _TURN_RAD
            following = part._replace(angle_rad=beyond_rad) if beyond_rad >= 0.0 else part
            if self.is_split and abs(beyond_rad) < self.half_rad:
                is_before = self._angles_rad(part) < _TURN_RAD
                parts.append(_chosen(part, is_before, part.returns.dropped))
                following = _chosen(part, ~is_before, 0)._replace(angle_rad=beyond_rad)
            elif beyond_rad < 0.0 and not is_apart:
                parts.append(part)
                continue
            yield from self._complete(parts)
            parts = [following]
        yield from self._complete(parts)

    def _following(self, last: _Part | None, message: Decoded, returns: Returns) -> tuple[_Part, bool]:
        """Part of the next message; True with it if messages before it are missing or its clock steps back.

        A message without points is placed at the usual angle from the last one.
        """
        sectors = self.sectors
        direction_rad = last.direction_rad + sectors.sense * sectors.step_rad if last else 0.0
        if len(returns.points):
            direction_rad = _direction(returns.points)
        part = _Part(message, returns, self.half_rad, direction_rad)
        if last is None:
            return part, True
        turned_rad = sectors.sense * (direction_rad - last.direction_rad)
        turned_rad = (turned_rad + self.half_rad) % _TURN_RAD - self.half_rad
        revolutions = 1e-9 * (returns.stamp_ns - last.returns.stamp_ns) / sectors.period_s
        is_apart = not -0.5 < revolutions < turned_rad / _TURN_RAD + _MISSING
        return (part if is_apart else part._replace(angle_rad=last.angle_rad + turned_rad)), is_apart

    def _complete(self, parts: list[_Part]) -> Iterator[Decoded]:
        """Sweep assembled from its parts; none if these cover less than half a revolution."""
        if not parts:
            return
        first, last, returns = parts[0], parts[-1], [part.returns for part in parts]
        begin_rad = 0.0 if self.is_split else first.angle_rad - self.half_rad
        if last.angle_rad + self.half_rad - begin_rad < 0.5 * _TURN_RAD - _SAME * self.half_rad:
            self.incomplete += 1
            return
        begin_s = self.rate * (begin_rad - (first.angle_rad - self.half_rad))  # relative to the stamp of the first
        begin_ns = first.returns.stamp_ns + round(1e9 * begin_s)
        points = np.concatenate([each.points for each in returns])
        times_s = np.concatenate([self._times_s(part, begin_rad, begin_ns) for part in parts])
        why = "" if len(points) else first.returns.why
        sweep = Returns(begin_ns, points, times_s, sum(each.dropped for each in returns), why, returns[0].frame)
        yield last.message._replace(value=sweep)

    def _times_s(self, part: _Part, begin_rad: float, begin_ns: int) -> NDArray[np.float32]:
        """Times (N,) of a part's points since the beginning of the sweep: their own, else from their angle."""
        if not self.times.assumed.startswith("point times") and len(part.returns.points):
            self.times.assumed = "" if len(part.returns.times_s) else self.sectors.assumed
        if len(part.returns.times_s):
            return part.returns.times_s + np.float32(1e-9 * (part.returns.stamp_ns - begin_ns))
        return (self.rate * (self._angles_rad(part) - begin_rad)).astype(np.float32)

    def _angles_rad(self, part: _Part) -> NDArray[np.float32]:
        """Angles (N,) of the points of a part from the nominal start of its sweep, in the sense of rotation."""
        turned_rad = _wrapped(_azimuth(part.returns.points) - np.float32(part.direction_rad))
        return np.float32(part.angle_rad) + self.sectors.sense * turned_rad

    def notes(self) -> list[str]:
        """Note on sweeps left out."""
        sweeps = f"{counted(self.incomplete, 'sweep')} of {self.topic}"
        left_out = f"{sweeps} left out: less than half of a revolution, before a gap or the end"
        return [left_out] if self.incomplete else []


def _chosen(part: _Part, chosen: NDArray[np.bool_], dropped: int) -> _Part:
    """The part, reduced to the points chosen by a mask (N,)."""
    points, times_s = part.returns.points[chosen], part.returns.times_s[chosen[: len(part.returns.times_s)]]
    return part._replace(returns=part.returns._replace(points=points, times_s=times_s, dropped=dropped))


def _azimuth(points: RawPoints) -> NDArray[np.float32]:
    return np.arctan2(points[:, 1], points[:, 0])


def _direction(points: RawPoints) -> float:
    """Mean azimuth of points (N, d), from a sample of them."""
    x, y = points[:: len(points) // 250 + 1, :2].T
    ranges_m = np.maximum(np.hypot(x, y), np.finfo(np.float32).tiny)
    return float(np.arctan2((y / ranges_m).sum(), (x / ranges_m).sum()))


def _wrapped(angle_rad: NDArray[np.floating]) -> NDArray[np.floating]:
    """Angles wrapped to −π to π."""
    return (angle_rad + np.pi) % _TURN_RAD - np.pi


def _order(returns: Returns) -> float:
    """Sign of the covariance of azimuth and time (else point order) in a message; positive counterclockwise."""
    turned_rad = _wrapped(_azimuth(returns.points) - _direction(returns.points))
    times_s = returns.times_s if len(returns.times_s) else np.linspace(0.0, 1.0, len(turned_rad))
    return float(np.sign(np.mean(turned_rad * (times_s - np.mean(times_s)))))
