"""Simulated GNSS receivers: positions on Earth along a motion, with the errors and faults of each model."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Mask, Matrix, Pose, Vector
from scanchain.simulation.motion import Motion

ORIGIN = (49.0, 8.4, 115.0)  # latitude and longitude in degrees, altitude in m, of the origin of the world


T_ENU_WORLD: Pose = lie.exp(np.deg2rad(35.0) * np.eye(6)[5])  # its x axis points to 35° north of east


@dataclass(frozen=True, slots=True)
class GnssModel:
    """A GNSS receiver and its antenna.

    sigma_m : (3,) standard deviations east, north and up, as stated; ``white`` is the share of their variance that
        is white noise, the rest is a Gauss-Markov process of this time constant
    multipath_m : least and largest horizontal error in the intervals with multipath, half of the time; none if 0
    outages_s : times of the drive between which there is no fix
    antenna_m : (3,) on base_link, in /tf_static
    """

    sigma_m: tuple[float, float, float]
    white: float
    correlated_s: float = 60.0
    multipath_m: tuple[float, float] = (0.0, 0.0)
    outages_s: tuple[tuple[float, float], ...] = ()
    period_ns: int = 100_000_000
    antenna_m: Vector = field(default_factory=lambda: np.array([-0.5, 0.3, 1.6]))

    def measure(self, motion: Motion, instants_s: NDArray[np.floating], rng: np.random.Generator) -> GnssSamples:
        """Samples (N,) along a motion, ``period_ns`` apart."""
        T_enu_base = T_ENU_WORLD @ motion.base(instants_s)
        true = T_enu_base[:, :3, 3] + T_enu_base[:, :3, :3] @ self.antenna_m
        noise = rng.standard_normal((2, len(true), 3))
        kept = np.exp(-self.period_ns * 1e-9 / self.correlated_s)
        slow = noise[0] * np.where(np.arange(len(true)) > 0, np.sqrt(1.0 - kept**2), 1.0)[:, None]
        for k in range(1, len(slow)):
            slow[k] += kept * slow[k - 1]
        errors = np.sqrt(1.0 - self.white) * slow + np.sqrt(self.white) * noise[1]
        multipath = self._multipath(instants_s, rng)
        is_out = np.zeros(len(true), np.bool_)
        for begin_s, end_s in self.outages_s:
            is_out |= (instants_s >= begin_s) & (instants_s < end_s)
        return GnssSamples(true + np.array(self.sigma_m) * errors + multipath, multipath[:, 0] != 0.0, is_out)

    def _multipath(self, instants_s: NDArray[np.floating], rng: np.random.Generator) -> Matrix:
        """Errors (N, 3) by multipath: constant in intervals of random length, zero in every other one."""
        result, is_wrong = np.zeros((len(instants_s), 3)), True
        begin_s = float(instants_s[0]) + 3.0  # a drive begins in the clear
        while self.multipath_m[1] and begin_s < instants_s[-1]:
            end_s = begin_s + 10.0 * rng.uniform(0.5, 1.5)  # as long with multipath as without
            size_m, azimuth = rng.uniform(*self.multipath_m), rng.uniform(0.0, 2.0 * np.pi)
            error = size_m * np.array([np.cos(azimuth), np.sin(azimuth), 0.5 * rng.standard_normal()])
            result[(instants_s >= begin_s) & (instants_s < end_s)] = error * is_wrong
            begin_s, is_wrong = end_s, not is_wrong
        return result


class GnssSamples(NamedTuple):
    """Positions (N, 3) east, north and up of the origin; wrong by multipath, and missing (N,)."""

    enu_m: Matrix
    is_multipath: Mask
    is_out: Mask


# Data sheet of the u-blox ZED-F9P: 1.5 m CEP, with RTK 0.01 m CEP and 0.01 m (median) in height. A CEP is 1.18 σ
# of each horizontal component; heights without RTK are taken as twice as uncertain.
_STANDARD = GnssModel((1.27, 1.27, 2.5), 0.05)
_RTK = GnssModel((0.0085, 0.0085, 0.015), 0.5)
RECEIVERS: dict[str, GnssModel] = {
    "standard": _STANDARD,
    "standard-multipath": replace(_STANDARD, multipath_m=(5.0, 20.0)),
    "standard-outages": replace(_STANDARD, outages_s=((10.0, 25.0), (40.0, 60.0))),
    "rtk": _RTK,
    "rtk-multipath": replace(_RTK, multipath_m=(5.0, 20.0)),
}
