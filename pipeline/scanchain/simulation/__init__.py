"""Simulated worlds with exact ground truth, written as MCAP."""

from scanchain.simulation.another_day import Change
from scanchain.simulation.drive import NO_SLIP, Drive, Slip, plan, record, simulate
from scanchain.simulation.imu import IMUS
from scanchain.simulation.sensors import SENSORS
from scanchain.simulation.worlds import WORLDS

__all__ = ["IMUS", "NO_SLIP", "SENSORS", "WORLDS", "Change", "Drive", "Slip", "plan", "record", "simulate"]
