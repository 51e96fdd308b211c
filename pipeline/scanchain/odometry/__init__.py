"""Predict, match against the local map, extend it."""

from scanchain.odometry.front_end import FrontEnd, Located
from scanchain.odometry.odometry import Odometry, Tracked, checked_start

__all__ = ["FrontEnd", "Located", "Odometry", "Tracked", "checked_start"]
