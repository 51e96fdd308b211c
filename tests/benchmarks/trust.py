"""Whether our 3D odometry knows what it knows: its covariance and its flags of degeneracy against the truth.

    python -m tests.benchmarks.trust [--worlds town,...] [--sensors vlp-16,...] [--scans N] [--cache DIR]

Worlds, sensors and cache are those of tests.benchmarks.odometry3d_set; the odometry has no wheels. A line says

  NEES/6    squared error of the motion between two scans over its covariance, mean, divided by its dimension:
            1 is exact, more is overconfident; from scans that are not degenerate
  blind     scans whose true geometry says next to nothing along some direction (scanchain.simulation.information)
  flagged   share of those that are called degenerate; in brackets the median angle between the direction that is
            named and the blind ones
  sound     scans whose true geometry says enough along every direction
  wrongly   share of those that are called degenerate
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.config import LogConfig
from scanchain.data import Matrix, State
from scanchain.evaluation import motion_nees
from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.settings import Override, load_settings
from scanchain.simulation import Drive, plan
from scanchain.simulation.information import information, spectrum
from tests.benchmarks.odometry3d_set import SEED, log_of, parser_of

BLIND_SHARE, SOUND_SHARE = 1e-6, 1e-3  # of the returns that speak about the worst direction
WARM_UP_SCANS = 3
NO_WHEELS = (Override("odometry.prior", "constant-velocity", "this benchmark"),)


@dataclass(frozen=True, slots=True)
class Trust:
    """What a line of the table holds; angles in degrees, empty where nothing is blind."""

    nees: NDArray[np.float64]
    angles_deg: NDArray[np.float64]
    flags_of_blind: NDArray[np.bool_]
    flags_of_sound: NDArray[np.bool_]

    def __str__(self) -> str:
        blind, sound = self.flags_of_blind, self.flags_of_sound
        nees = f"{self.nees.mean() / 6.0:8.2f}" if len(self.nees) else f"{'-':>8}"
        flagged = f"{100.0 * blind.mean():7.1f} % ({np.median(self.angles_deg):4.1f} deg)" if blind.any() else "-"
        wrongly = f"{100.0 * sound.mean():.1f} %" if len(sound) else "-"
        return f"{nees}{len(blind):8}{flagged:>22}{len(sound):8}{wrongly:>10}"


def trust(path: Path, drive: Drive) -> Trust:
    """Run the odometry over a simulated log and compare."""
    log = open_log([path], LogConfig())
    odometry = Odometry(load_settings(3, overrides=NO_WHEELS).config, log.T_base_lidar)
    truth = drive.truth()
    steps = [odometry.process(scan) for scan in log.scans()]
    flags = np.array([step.state is State.DEGENERATE for step in steps])
    shares, angles = np.empty(len(steps)), np.full(len(steps), np.nan)
    for k, step in enumerate(steps):
        H = information(drive.solids, truth.poses[k], drive.sensor, index=int(drive.scans[k]))
        all_shares, twists = spectrum(H)
        shares[k] = all_shares[0]
        if flags[k] and shares[k] < BLIND_SHARE:
            angles[k] = _angle_deg(step.match.degeneracy_direction, twists[all_shares < BLIND_SHARE], H)
    judged = np.arange(len(steps)) >= WARM_UP_SCANS
    blind, sound = judged & (shares < BLIND_SHARE), judged & (shares > SOUND_SHARE)
    covariances = np.linalg.pinv(np.array([step.match.information for step in steps]), hermitian=True)
    nees = motion_nees(np.array([step.T_odom_lidar for step in steps]), covariances, truth.poses[: len(steps)])
    sure = judged[1:] & ~flags[1:] & ~flags[:-1]
    return Trust(6.0 * nees[sure], angles[blind & flags], flags[blind], flags[sound])


def _angle_deg(named: NDArray[np.float64], blind: Matrix, H: Matrix) -> float:
    """Between a twist and the span of blind ones, rotations counted as the lengths they move a return by."""
    lever_m = np.sqrt(np.trace(H[3:, 3:]) / np.trace(H[:3, :3]))
    even = np.repeat([1.0, lever_m], 3)
    basis = np.linalg.qr((blind * even).T)[0]
    named = named * even
    return float(np.degrees(np.arccos(min(np.linalg.norm(basis.T @ named) / np.linalg.norm(named), 1.0))))


def main() -> None:
    arguments = parser_of(__doc__).parse_args()
    print(f"{'sequence':22}{'NEES/6':>8}{'blind':>8}{'flagged':>22}{'sound':>8}{'wrongly':>10}")
    for world in arguments.worlds.split(","):
        for sensor in arguments.sensors.split(","):
            path = log_of(world, sensor, arguments.scans, arguments.cache)
            answer = trust(path, plan(world, seed=SEED, sensor=sensor))
            print(f"{world + ' ' + sensor:22}{answer}", flush=True)


if __name__ == "__main__":
    main()
