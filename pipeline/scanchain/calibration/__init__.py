"""Parameters of sensors, estimated from the motion of a log."""

from scanchain.calibration.calibrate import Calibration, Parameter, calibrate

__all__ = ["Calibration", "Parameter", "calibrate"]
