"""Predict, match against the local map, extend it."""

from pipeline.odometry.odometry import Odometry, Tracked

__all__ = ["Odometry", "Tracked"]
