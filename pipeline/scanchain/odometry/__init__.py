"""Predict, match against the local map, extend it."""

from scanchain.odometry.front_end import FrontEnd, Located
from scanchain.odometry.intervals import LiveStamps
from scanchain.odometry.odometry import Odometry, Tracked, checked_start, owned

__all__ = ["FrontEnd", "LiveStamps", "Located", "Odometry", "Tracked", "checked_start", "owned"]
