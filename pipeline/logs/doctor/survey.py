"""All scans of a log, looked at once, as the doctor's checks need them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import RawPoints
from scanchain.errors import InputError
from scanchain.logs.doctor.scan_facts import ScanFacts, facts_of
from scanchain.logs.doctor.standing_still import Rest, RestWatch
from scanchain.logs.log import Log
from scanchain.logs.mcap.selection import whole_span
from scanchain.logs.mcap.stream import decoded_messages
from scanchain.logs.messages.cdr import MalformedMessageError
from scanchain.logs.messages.point_times import PointTimes
from scanchain.logs.messages.poses import StampedPose
from scanchain.logs.messages.readers import is_scan

_FORGOTTEN = np.empty(0)
_NO_POINTS = np.empty((0, 2), np.float32)
_SAMPLED = 10  # scans whose points are looked at


@dataclass(frozen=True, slots=True)
class Survey:
    """What a log's scans and wheels show.

    Attributes
    ----------
    scans : facts of each readable scan, in the order of log time, their points and outlines left out
    log_ns, stamps_ns : (N,) int64 log times and header stamps of those scans
    samples : (N, d) meters, points of some ten scans from all over the log
    rests : when the surroundings stayed as they were, for a second or more
    wheels : poses of the wheels, in the order of log time; empty where there are none
    malformed : what is wrong with each message that is not readable
    point_times : what a run assumes about per-point times
    damage : what of the files could not be read
    """

    log: Log
    scans: tuple[ScanFacts, ...]
    log_ns: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    samples: tuple[RawPoints, ...]
    rests: tuple[Rest, ...]
    wheels: tuple[StampedPose, ...]
    malformed: tuple[str, ...]
    point_times: str
    damage: tuple[str, ...]

    @property
    def period_s(self) -> float:
        """Median time between two scans, by their stamps or, where those do not move, by log time; 0 if alone."""
        for times_ns in (self.stamps_ns, self.log_ns):
            steps_s = np.diff(times_ns) * 1e-9
            if len(steps_s) and np.median(steps_s) > 0.0:
                return float(np.median(steps_s))
        return 0.0

    def into_log_s(self, log_time_ns: int) -> float:
        """Seconds after the log's first message, as ``--start`` and ``--end`` count."""
        return (log_time_ns - whole_span(self.log.indexes).begin_ns) * 1e-9

    def share(self, part: Callable[[ScanFacts], int]) -> float:
        """A count of beams over all beams of all scans."""
        return sum(part(scan) for scan in self.scans) / max(sum(scan.beams for scan in self.scans), 1)


def survey(log: Log, progress: Callable[[int, int], None] | None = None) -> Survey:
    """Look at every scan of the chosen part. Raises InputError where none is readable."""
    times = PointTimes(log.config)
    decoders = {log.topic: facts_of(log.decoder(times)), **log.pose_decoders}
    damage = list(log.damage)
    scans: list[ScanFacts] = []
    log_ns: list[int] = []
    samples: list[RawPoints] = []
    wheels: list[StampedPose] = []
    malformed: list[str] = []
    watch = RestWatch(log.dimension)
    for message in decoded_messages(
        log.indexes, decoders, log.span, ahead=log.config.prefetch_chunks, damage=damage
    ):
        match message.value:
            case ScanFacts() as facts:
                if len(scans) % max(1, log.scan_count // _SAMPLED) == 0 and facts.kept:
                    samples.append(facts.points)
                scans.append(facts._replace(outline=_FORGOTTEN, points=_NO_POINTS))
                watch.take(facts.outline, message.log_time_ns)
                log_ns.append(message.log_time_ns)
                if progress is not None:
                    progress(len(scans), log.scan_count)
            case StampedPose() as pose if message.channel.topic == log.odometry_topic:
                wheels.append(pose)
            case MalformedMessageError() as error if message.channel.topic == log.topic:
                malformed.append(str(error))
    watch.close()
    if not scans:
        reasons = "; ".join([*malformed[:1], *damage]) or "the chosen part is empty"
        raise InputError(f"{log.name}: no scan of {log.topic} could be read: {reasons}")
    stamps_ns = np.array([scan.stamp_ns for scan in scans], np.int64)
    assumed = "" if is_scan(log.lidar) else times.assumed
    return Survey(
        log=log,
        scans=tuple(scans),
        log_ns=np.array(log_ns, np.int64),
        stamps_ns=stamps_ns,
        samples=tuple(samples),
        rests=tuple(watch.rests),
        wheels=tuple(wheels),
        malformed=tuple(malformed),
        point_times=assumed,
        damage=tuple(damage),
    )
