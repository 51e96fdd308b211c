"""Fixes of a GNSS receiver: of NavSatFix, GPSFix and Foxglove's LocationFix."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from scanchain.data import Matrix
from scanchain.logs.messages.ros import MalformedMessageError, frame_of, stamp_ns

_UNKNOWN_M = (5.0, 5.0, 10.0)  # standard deviations east, north and up where the receiver states none


class Fix(NamedTuple):
    """Latitude and longitude in degrees, altitude above the ellipsoid in m; covariance (3, 3), east north up."""

    stamp_ns: int
    frame: str
    position: tuple[float, float, float]
    covariance: Matrix


def read_fix(message: Any) -> list[Fix]:
    """A sensor_msgs/NavSatFix or a GPSFix; nothing while the receiver has no fix. Raises as ``fix_of`` does."""
    return [fix_of(message, stamp_ns(message), frame_of(message))] if message.status.status >= 0 else []


def fix_of(message: Any, at_ns: int, frame: str) -> Fix:
    """The position and covariance of a message.

    Raises MalformedMessageError for a position that is none on Earth, or unset.
    """
    position = float(message.latitude), float(message.longitude), float(message.altitude)
    if not (abs(position[0]) <= 90.0 and abs(position[1]) <= 360.0 and np.isfinite(position[2])):
        raise MalformedMessageError("its position is none on Earth")
    if not any(position[:2]):
        raise MalformedMessageError("its latitude and longitude are 0, as of a receiver without a fix")
    covariance = np.array(message.position_covariance, np.float64)
    is_stated = message.position_covariance_type > 0 and covariance.size == 9 and np.isfinite(covariance).all()
    if not is_stated or np.linalg.eigvalsh(covariance.reshape(3, 3))[0] <= 0.0:
        covariance = np.diag(np.square(_UNKNOWN_M))
    return Fix(at_ns, frame, position, covariance.reshape(3, 3))
