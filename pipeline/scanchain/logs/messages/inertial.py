"""Samples of an IMU: of sensor_msgs/Imu."""

from __future__ import annotations

from math import isfinite
from typing import Any, NamedTuple

from scanchain.logs.messages.ros import MalformedMessageError, frame_of, stamp_ns


class ImuSample(NamedTuple):
    """Angular rates in rad/s and specific forces in m/s², in the sensor's frame; units as the message has them."""

    stamp_ns: int
    frame: str
    rates: tuple[float, ...]
    accelerations: tuple[float, ...]


def read_imu(message: Any) -> ImuSample:
    """A sensor_msgs/Imu. Raises MalformedMessageError for values that are not finite."""
    rate, force = message.angular_velocity, message.linear_acceleration
    rates, accelerations = (rate.x, rate.y, rate.z), (force.x, force.y, force.z)
    if not all(map(isfinite, rates + accelerations)):
        raise MalformedMessageError("its rates or accelerations are not finite")
    return ImuSample(stamp_ns(message), frame_of(message), rates, accelerations)
