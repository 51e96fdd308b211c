"""Parameters of sensors, estimated from the motion of a log."""

from scanchain.calibration.calibrate import Calibration, Parameter, calibrate, delay_of_wheels

__all__ = ["Calibration", "Parameter", "calibrate", "delay_of_wheels"]
