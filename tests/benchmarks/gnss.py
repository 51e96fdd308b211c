"""Place on Earth of simulated drives by simulated receivers, half of whose fixes may be wrong by 5 to 20 m.

Each drive is processed once, with loops and without, and then compared with the fixes of several seeds; a drifting
one is not scanned: its odometry turns by 1e-4 rad per meter too far. "Earth" is
the horizontal error on Earth, in m (root mean square), "stated" the standard deviation of the origin, "named" the
share of wrong fixes that are rejected, "false" that of right ones; ATE in m with the fixes and without.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import scanchain
from scanchain import lie
from scanchain.data import Trajectory
from scanchain.georeference import Georeferencing
from scanchain.loops import spread
from scanchain.settings import overrides_of
from scanchain.simulation import plan
from scanchain.simulation.gnss import RECEIVERS
from tests.benchmarks.harness import ate_m, options_of, table
from tests.support import made
from tests.support.fixes import driven as driven_exactly
from tests.support.fixes import fixes_along, positions_by, true_positions

WORLDS = {"town": 60.0, "rounds": 160.0}


def driven(world: str, sensor: str, cache: Path, *, has_loops: bool) -> scanchain.SlamResult:
    """SLAM result of a drive without fixes."""
    log = scanchain.open_log(made.log(world, folder=cache, sensor=sensor, seconds=WORLDS[world]))
    settings = scanchain.load_settings(log.dimension, overrides=overrides_of({"loops__enabled": has_loops}))
    slam = scanchain.Slam(settings.config, log.stated_mounting, dimension=log.dimension)
    for scan in log:
        slam.process(replace(scan, T_odom_base=None))
    return slam.finish()


def drifting(world: str, sensor: str) -> SimpleNamespace:
    """What an exact odometry but for a drift makes of a drive."""
    trajectory, graph, keyframes = driven_exactly(
        plan(world, sensor=sensor, duration_s=WORLDS[world]).truth(), 1e-4
    )
    keyframes = [SimpleNamespace(scan_index=each) for each in keyframes]
    config = scanchain.load_settings(3).config
    return SimpleNamespace(
        trajectory=trajectory, odometry=trajectory, graph=graph, keyframes=keyframes, config=config
    )


def row_of(world: str, sensor: str, gnss: str, result: Any, seeds: int) -> list[str]:
    """Means over the seeds, as text."""
    found, keyframes = [], np.array([each.scan_index for each in result.keyframes])
    drive = plan(world, sensor=sensor, duration_s=WORLDS[world], gnss=gnss)
    truth = drive.truth()
    for seed in range(seeds):
        fixes, is_wrong = fixes_along(replace(drive, seed=seed))
        placing = Georeferencing([fixes], lie.lift(drive.T_base_lidar)[2, :3], result.config.graph)
        trajectory, graph = result.trajectory, placing.constrained(result.trajectory, result.graph, keyframes)
        if graph is not None:
            poses = spread(graph.poses, keyframes, result.odometry.poses)
            trajectory = Trajectory(result.trajectory.stamps_ns, poses)
        if (place := placing.place(trajectory)) is None:
            continue
        away = (positions_by(place, trajectory) - true_positions(truth))[:, :2]
        wrong = is_wrong[np.isin(fixes.stamps_ns, place.stamps_ns)]
        found.append([
            np.sqrt(np.mean(np.sum(away**2, axis=1))), place.origin.sigma_m,
            place.is_rejected[wrong].mean() if wrong.any() else np.nan, place.is_rejected[~wrong].mean(),
            ate_m(trajectory, truth), place.origin.is_constrained,
        ])  # fmt: skip
    if not found:
        return [f"0 of {seeds}"]
    earth, stated, named, false, ate, constrained = np.mean(found, axis=0)
    errors = [f"{earth:.2f}", f"{np.max(found, axis=0)[0]:.2f}", f"{stated:.2f}"]
    shares = ["" if np.isnan(named) else f"{100 * named:.0f} %", f"{100 * false:.0f} %"]
    of_drive = [f"{ate:.4f}", f"{ate_m(result.trajectory, truth):.4f}", f"{100 * constrained:.0f} %"]
    return [f"{len(found)} of {seeds}", *errors, *shares, *of_drive]


def main() -> None:
    options = options_of(
        __doc__,
        worlds=WORLDS,
        sensors=["vlp-16"],
        receivers=dict.fromkeys(RECEIVERS, 0),
        cases=["loops", "odometry", "drifting"],
        seeds=10,
    )
    names = ("Earth m", "worst", "stated", "named", "false", "ATE m", "without", "corrected")
    row = table("world, case, receiver", "placed", *names)
    for world, sensor, case in product(options.worlds, options.sensors, options.cases):
        is_drifting, has_loops = case == "drifting", case == "loops"
        result = (
            drifting(world, sensor) if is_drifting else driven(world, sensor, options.cache, has_loops=has_loops)
        )
        for gnss in options.receivers:
            row(f"{world}, {case}, {gnss}", *row_of(world, sensor, gnss, result, options.seeds))


if __name__ == "__main__":
    main()
