"""What is odd about the scans of a log, counted while they pass and told once they are through."""

from __future__ import annotations

import math

from scanchain.config import LogConfig
from scanchain.data import Scan
from scanchain.words import counted


def most_bad_scans(scans: int, config: LogConfig) -> float:
    """How many of so many scans may be left out; at 100 % any number: damaged logs may hold more than they say."""
    share = 0.01 * config.max_bad_scans_percent
    return math.ceil(share * scans) if share < 1.0 else math.inf


class Tally:
    """Counts the scans of a topic that were left out, whose stamps make no sense, and that the wheels miss."""

    def __init__(self, topic: str, odometry_topic: str) -> None:
        self.topic = topic
        self.odometry_topic = odometry_topic
        self.scans = self.bad = self.backwards = self.repeated = self.without_wheels = 0
        self.first_complaint = ""
        self.last_stamp_ns: int | None = None

    def skip(self, complaint: str) -> None:
        """Count a scan that is left out."""
        self.scans += 1
        self.bad += 1
        self.first_complaint = self.first_complaint or complaint

    def take(self, scan: Scan) -> None:
        """Count a scan that is passed on."""
        self.scans += 1
        self.without_wheels += scan.T_odom_base is None
        if self.last_stamp_ns is not None:
            self.backwards += scan.stamp_ns < self.last_stamp_ns
            self.repeated += scan.stamp_ns == self.last_stamp_ns
        self.last_stamp_ns = scan.stamp_ns

    def losses(self) -> list[str]:
        """What was left out."""
        if not self.bad:
            return []
        share = f"{self.bad} of {counted(self.scans, 'scan')} of {self.topic} {'was' if self.bad == 1 else 'were'}"
        return [f"{share} left out (the first: {self.first_complaint})"]

    def notes(self) -> list[str]:
        """What was assumed."""
        lines = []
        if self.backwards:
            steps = counted(self.backwards, "step")
            lines.append(f"{steps} back in the header stamps of {self.topic}; the log's order is kept")
        if self.repeated:
            lines.append(
                f"{counted(self.repeated, 'scan')} of {self.topic} with the header stamp of the one before"
            )
        if self.odometry_topic and self.without_wheels:
            lines.append(
                f"{self.without_wheels} of {counted(self.scans, 'scan')} without a reading of "
                f"{self.odometry_topic} near the stamp; their motion is predicted from the scans"
            )
        return lines
