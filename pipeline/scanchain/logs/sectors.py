"""Messages that are sectors of a revolution: recognized among the first ones, and assembled to sweeps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.data import RawPoints
from scanchain.errors import counted
from scanchain.logs.mcap.records import Decoded
from scanchain.logs.messages.lidar import Returns
from scanchain.logs.messages.point_times import UNITS_S

_SAMPLE = 500  # points of a message, evenly spread, by which its direction and width are estimated
_TURN_RAD = 2.0 * np.pi
_WIDEST_RAD = 4.0 / 3.0 * np.pi  # of a message above which it is a sweep by itself
_FEWEST, _MOST = (
    5,
    2000,
)  # messages after which a lidar that looks in one direction is ruled out, and of the sample
_REVOLUTIONS = 2.0  # least number that the sample shows
_WIDTHS = (0.5, 1.5)  # width of a message over the angle to the next: less leaves holes, more is no sector
_REGULAR = (
    0.6  # least share of messages that follow by the usual angle, the others after a blind angle or a dropout
)
_SLOWEST_S = 1.5  # longest revolution of a lidar; what turns more slowly may be the robot
_CLEAR_RAD = 2.0 / 3.0 * np.pi  # angle between messages up to which it shows by itself which way they turn
_SAME = 0.1  # share of that angle up to which a message a revolution later looks in the same direction
_MISSING = 0.75  # revolutions of time without messages, above which a gap ends the sweep


class Sectors(NamedTuple):
    """Division of a lidar's revolution into messages.

    sense : 1 if it turns counterclockwise, −1 if clockwise
    step_rad : usual angle from one message to the next
    per_sweep : messages per revolution, not whole where they do not divide it
    period_s : of a revolution
    is_stamped : whether each message has a stamp of its own, not that of its revolution
    is_from_sweep : whether point times count from the start of the revolution, whatever the message's stamp
    point_times : value of ``log.point_times`` for the messages: their unit by the duration of a sector, which that
        of a sweep would mistake; ``none`` where the azimuth times the points
    """

    sense: int
    step_rad: float
    per_sweep: float
    period_s: float
    is_stamped: bool
    is_from_sweep: bool = False
    point_times: str = "auto"

    @property
    def assumed(self) -> str:
        """Times of points that have none of their own."""
        direction = "counterclockwise" if self.sense > 0 else "clockwise"
        return f"point times by the azimuth: {direction}, {self.period_s:.3g} s a turn, from the first message's stamp"

    def note(self, topic: str) -> str:
        """What was found, and what is done about it."""
        holds = f"each message holds {360.0 / self.per_sweep:.3g}° of a revolution"
        return f"{topic}: {holds}: {self.per_sweep:.3g} messages are assembled to one sweep"

    def sweeps(self, messages: int) -> int:
        """Number of sweeps that so many messages make, an incomplete one at the end only above half of one."""
        return max(int(messages / self.per_sweep + 0.5), 1)


class Sampled(NamedTuple):
    """One of the first messages of a lidar: its bytes, its returns, its frame."""

    data: memoryview
    returns: Returns
    frame: str


def find_sectors(
    sample: Iterable[Sampled], decoder: Callable[[str], Callable[[memoryview], Returns]], point_times: str
) -> Sectors | None:
    """Sectors in which consecutive messages of one frame look, which recur; None where each is a sweep by itself.

    decoder : decoder of the messages for a value of ``log.point_times``; point_times : the configured one
    """
    seen: list[Sampled] = []
    directions_rad, widths_rad, turned_rad = list[float](), list[float](), 0.0
    for message in sample:
        if not len(message.returns.points):
            continue
        azimuth_rad = _azimuth(message.returns.points[:: len(message.returns.points) // _SAMPLE + 1])
        direction_rad = _mean(azimuth_rad)
        low_rad, high_rad = np.percentile(_wrapped(azimuth_rad - direction_rad), (5.0, 95.0))
        seen.append(message)
        directions_rad.append(direction_rad)
        widths_rad.append((high_rad - low_rad) / 0.9)
        if widths_rad[-1] > _WIDEST_RAD or message.frame != seen[0].frame:
            return None
        steps_rad = np.abs(_wrapped(np.diff(directions_rad[-2:])))
        turned_rad += float(steps_rad.sum())
        if len(seen) == _FEWEST:
            usual_rad = np.median(np.abs(_wrapped(np.diff(directions_rad))))
            if np.median(widths_rad) > _WIDTHS[1] * max(usual_rad, 1e-9):
                return None
        if turned_rad > (_REVOLUTIONS + 1.0) * _TURN_RAD or len(seen) == _MOST:
            break
    found = _sectors(seen, np.array(directions_rad), float(np.median(widths_rad or [0.0])))
    return found and _timed(found, seen, decoder, point_times)


def _sectors(seen: list[Sampled], directions_rad: NDArray[np.float64], width_rad: float) -> Sectors | None:
    """Sectors by the directions (N,) of the first messages, None where these do not turn steadily."""
    if len(seen) < 3:
        return None
    steps_rad = _wrapped(np.diff(directions_rad))
    sense = int(np.sign(np.median(steps_rad)))
    if np.median(np.abs(steps_rad)) > _CLEAR_RAD:
        orders = [_order(each.returns) for each in seen]
        sense = int(np.sign(np.sum(orders))) or 1
    steps_rad = (sense * steps_rad) % _TURN_RAD
    step_rad = float(np.percentile(steps_rad, 50.0, method="lower"))
    is_regular = np.mean(np.abs(_wrapped(steps_rad - step_rad)) < 0.5 * step_rad) >= _REGULAR
    is_narrow = _WIDTHS[0] * step_rad <= width_rad <= _WIDTHS[1] * step_rad
    later = round(_TURN_RAD / float(np.mean(steps_rad))) if step_rad > 0.0 else 0
    if not (is_regular and is_narrow and 2 <= later <= (len(seen) + 1) / _REVOLUTIONS):
        return None
    drift_rad = _wrapped(sense * (directions_rad[later:] - directions_rad[:-later]))
    stamps_ns = np.array([each.returns.stamp_ns for each in seen])
    seconds = 1e-9 * (stamps_ns[later:] - stamps_ns[:-later])
    period_s = float(np.median(seconds * _TURN_RAD / (_TURN_RAD + drift_rad)))
    if not 0.0 < period_s < _SLOWEST_S:
        return None
    recurs = np.median(np.abs(drift_rad)) < _SAME * step_rad
    per_sweep = float(later) if recurs else float(_TURN_RAD / np.mean(steps_rad))
    return Sectors(sense, step_rad, per_sweep, period_s, bool(np.median(np.diff(stamps_ns)) > 0))


def _timed(
    sectors: Sectors,
    seen: list[Sampled],
    decoder: Callable[[str], Callable[[memoryview], Returns]],
    configured: str,
) -> Sectors:
    """The sectors with the unit and the origin of their point times.

    The unit is the one in which a message lasts about as long as a sector: that of a sweep would mistake it.
    """
    point_times = configured if configured in (*UNITS_S, "auto") else "none"
    if configured == "auto":
        decode = decoder("s")
        spans_s = [float(np.ptp(times)) for each in seen if len(times := decode(each.data).times_s)]
        if spans_s:
            longer = max(float(np.median(spans_s)), 1e-9) / sectors.period_s * sectors.per_sweep
            point_times = min(UNITS_S, key=lambda name: abs(np.log(longer * UNITS_S[name])))
    decode = decoder(point_times)
    starts_s = [float(times.min()) for each in seen if len(times := decode(each.data).times_s)]
    last_s = sectors.period_s * (1.0 - 1.0 / sectors.per_sweep)  # from the first sector to the last
    is_from_sweep = len(starts_s) > 1 and float(np.ptp(starts_s)) > 0.5 * last_s
    return sectors._replace(point_times=point_times, is_from_sweep=is_from_sweep)


class _Part(NamedTuple):
    """A message of a sweep: the angle of its middle since the start of the sweep, and its direction."""

    message: Decoded
    returns: Returns
    angle_rad: float
    direction_rad: float


class Assembler:
    """Sweeps of the messages that are sectors of them; ``incomplete`` counts those left out."""

    def __init__(self, sectors: Sectors, topic: str) -> None:
        self.sectors, self.topic = sectors, topic
        self.incomplete = 0

    def sweeps(self, messages: Iterable[Decoded]) -> Iterator[Decoded]:
        """The messages, those of the lidar assembled to sweeps; malformed ones and those of other topics pass.

        A sweep has the stamp of its first message and the log time of its last. It ends where the revolution does
        or messages of most of one are missing; one over less than half of a revolution is left out.
        """
        parts: list[_Part] = []
        for message in messages:
            if message.channel.topic != self.topic or not isinstance(message.value, Returns):
                yield message
                continue
            part, begins = self._following(parts[-1] if parts else None, message, message.value)
            if begins:
                yield from self._complete(parts)
                parts = []
            parts.append(part)
        yield from self._complete(parts)

    def _following(self, last: _Part | None, message: Decoded, returns: Returns) -> tuple[_Part, bool]:
        """A message as part of a sweep, and whether it begins another one. Empty ones follow by the usual angle."""
        step_rad, sense = self.sectors.step_rad, self.sectors.sense
        points = returns.points[:: len(returns.points) // _SAMPLE + 1]
        direction_rad = _mean(_azimuth(points)) if len(points) else 0.0
        first = _Part(message, returns, 0.5 * step_rad, direction_rad)
        if last is None:
            return first, True
        since_rad = step_rad
        if len(points):
            since_rad = (
                sense * (direction_rad - last.direction_rad) + 0.5 * step_rad
            ) % _TURN_RAD - 0.5 * step_rad
        else:
            direction_rad = last.direction_rad + sense * step_rad
        revolutions = 1e-9 * (returns.stamp_ns - last.returns.stamp_ns) / self.sectors.period_s
        if not self.sectors.is_stamped:
            is_apart = returns.stamp_ns != last.returns.stamp_ns
        else:
            is_apart = not -0.5 < revolutions < since_rad / _TURN_RAD + _MISSING
        if is_apart:
            return first._replace(direction_rad=direction_rad), True
        angle_rad = last.angle_rad + since_rad
        begins = angle_rad >= _TURN_RAD
        return _Part(message, returns, angle_rad - _TURN_RAD * begins, direction_rad), begins

    def _complete(self, parts: list[_Part]) -> Iterator[Decoded]:
        """The sweep of its parts, none where these cover less than half of a revolution."""
        if not parts:
            return
        first, last = parts[0], parts[-1]
        if last.angle_rad - first.angle_rad + self.sectors.step_rad < 0.5 * _TURN_RAD:
            self.incomplete += 1
            return
        returns = [part.returns for part in parts]
        points = np.concatenate([each.points for each in returns])
        times_s = np.concatenate([self._times_s(part, first) for part in parts])
        why = "" if len(points) else first.returns.why
        sweep = Returns(first.returns.stamp_ns, points, times_s, sum(each.dropped for each in returns), why)
        yield last.message._replace(value=sweep)

    def _times_s(self, part: _Part, first: _Part) -> NDArray[np.float32]:
        """Seconds (N,) of the points of a part after the stamp of the first: by their own times, else by azimuth."""
        returns, rate = part.returns, self.sectors.period_s / _TURN_RAD
        turned_s = rate * (part.angle_rad - first.angle_rad)
        if not len(returns.times_s):
            turned_rad = _wrapped(_azimuth(returns.points) - part.direction_rad)
            within_s = rate * (self.sectors.sense * turned_rad + 0.5 * self.sectors.step_rad)
            return (turned_s + within_s).astype(np.float32)
        after_s = 1e-9 * (returns.stamp_ns - first.returns.stamp_ns)
        if self.sectors.is_from_sweep:
            after_s = 0.0
        elif not self.sectors.is_stamped or abs(after_s - turned_s) > 0.5 * self.sectors.period_s:
            after_s = turned_s  # its stamp is that of the revolution, or wrong
        return returns.times_s + np.float32(after_s)

    def notes(self) -> list[str]:
        """A line on sweeps that were left out."""
        if not self.incomplete:
            return []
        sweeps = counted(self.incomplete, "sweep")
        return [f"{sweeps} of {self.topic} left out: less than half of a revolution, before a gap or the end"]


def _azimuth(points: RawPoints) -> NDArray[np.float32]:
    return np.arctan2(points[:, 1], points[:, 0])


def _mean(azimuth_rad: NDArray[np.float32]) -> float:
    """The mean direction."""
    return float(np.arctan2(np.sin(azimuth_rad).mean(), np.cos(azimuth_rad).mean()))


def _wrapped(angle_rad: NDArray[np.floating]) -> NDArray[np.floating]:
    """Angles from −π to π."""
    return (angle_rad + np.pi) % _TURN_RAD - np.pi


def _order(returns: Returns) -> float:
    """Covariance of azimuth and time, or else order, of the points of a message: positive counterclockwise."""
    azimuth_rad = _azimuth(returns.points)
    turned_rad = _wrapped(azimuth_rad - _mean(azimuth_rad))
    times_s = returns.times_s if len(returns.times_s) else np.linspace(0.0, 1.0, len(turned_rad))
    return float(np.sign(np.mean(turned_rad * (times_s - np.mean(times_s)))))
