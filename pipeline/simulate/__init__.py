"""Worlds with exact ground truth, written as MCAP."""

from pipeline.simulate.drive import Drive, plan
from pipeline.simulate.information import information, spectrum, undetermined
from pipeline.simulate.log import simulate
from pipeline.simulate.sensors import SENSORS
from pipeline.simulate.worlds import WORLDS

__all__ = ["SENSORS", "WORLDS", "Drive", "information", "plan", "simulate", "spectrum", "undetermined"]
