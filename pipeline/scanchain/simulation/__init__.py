"""Worlds with exact ground truth, written as MCAP."""

from scanchain.simulation.another_day import Change
from scanchain.simulation.drive import Drive, plan
from scanchain.simulation.log import NO_SLIP, Slip, record, simulate
from scanchain.simulation.sensors import SENSORS
from scanchain.simulation.worlds.registry import WORLDS

__all__ = ["NO_SLIP", "SENSORS", "WORLDS", "Change", "Drive", "Slip", "plan", "record", "simulate"]
