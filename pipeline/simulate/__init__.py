"""Worlds with exact ground truth, written as MCAP."""

from pipeline.simulate.log import simulate
from pipeline.simulate.sensors import SENSORS
from pipeline.simulate.worlds import WORLDS

__all__ = ["SENSORS", "WORLDS", "simulate"]
