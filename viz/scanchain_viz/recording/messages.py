"""A message: columns of one entity, for every sink of a recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Times:
    """Times of the rows of a message, on the timelines ``scan`` and ``sensor_time``.

    Header stamps may step back in time, so the rows need not be in order of ``stamps_ns``.
    """

    scans: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]

    @staticmethod
    def at(scan: int, stamp_ns: int) -> Times:
        """One instant."""
        return Times(np.array([scan], np.int64), np.array([stamp_ns], np.int64))

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Times:
        return Times(self.scans[rows], self.stamps_ns[rows])

    def columns(self) -> tuple[rr.TimeColumn, rr.TimeColumn]:
        """The two time columns."""
        return (
            rr.TimeColumn("scan", sequence=self.scans),
            rr.TimeColumn("sensor_time", timestamp=self.stamps_ns.view("datetime64[ns]")),
        )


@dataclass(frozen=True, slots=True)
class Message:
    """Columns of an entity over ``times``; an archetype without times holds for ever."""

    entity: str
    content: rr.AsComponents | rr.ComponentColumnList
    times: Times | None = None

    def send(self, stream: rr.RecordingStream) -> None:
        """Write it to a stream; raises where rerun refuses it."""
        if isinstance(self.content, rr.ComponentColumnList):
            assert self.times is not None
            stream.send_columns(self.entity, self.times.columns(), self.content, strict=True)
        else:
            stream.log(self.entity, self.content, static=True, strict=True)
