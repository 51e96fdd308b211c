"""What is odd about the scans of a log, counted while they pass and told once they are through."""

from __future__ import annotations

from pipeline.data import Scan


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
        first = f" (the first: {self.first_complaint})"
        return [f"{self.bad} of {self.scans} scans of {self.topic} were left out{first}"] if self.bad else []

    def notes(self) -> list[str]:
        """What was assumed."""
        lines = []
        if self.backwards:
            lines.append(f"{self.backwards} header stamps of {self.topic} step back; the log's order is kept")
        if self.repeated:
            lines.append(f"{self.repeated} scans of {self.topic} have the same header stamp as the one before")
        if self.odometry_topic and self.without_wheels:
            lines.append(
                f"{self.without_wheels} of {self.scans} scans have no reading of {self.odometry_topic} near their "
                "stamp; their motion is predicted from the scans"
            )
        return lines
