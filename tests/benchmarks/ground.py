"""Simulated drives with wheels, with and without the prior that the ground is flat: height of the result.

The error of the height is that above the first pose, where the trajectory without the prior is turned to the true
tilt; its bend is what remains of it once the best plane is subtracted. Time is that of the prior alone.
"""

from __future__ import annotations

import math
import time
from itertools import product

import numpy as np
from msgspec.structs import replace as with_fields

import scanchain
from scanchain import lie
from scanchain.data import Matrix
from scanchain.ground import flattened
from scanchain.settings import load_settings
from tests.benchmarks.harness import options_of, table
from tests.support import made

FLAT = {"hall": 60.0, "field": 120.0, "corridor": 100.0, "office": 240.0, "identical": 300.0}  # seconds
OTHERS = {"garage": 90.0, "town": 60.0, "rounds": 100.0, "highway": 30.0, "forest": 60.0, "staircase": 40.0}


def errors_m(poses: Matrix, true: Matrix) -> list[float]:
    """Largest and root mean square error of the height above the first pose; the same of its bend."""
    errors = poses[:, 2, 3] - true[:, 2, 3]
    errors -= errors[0]
    A = np.column_stack([true[:, :2, 3], np.ones(len(true))])
    bend = errors - A @ np.linalg.lstsq(A, errors)[0]
    return [
        f(each) for each in (errors, bend) for f in (lambda e: np.abs(e).max(), lambda e: np.sqrt(np.mean(e**2)))
    ]


def main() -> None:
    worlds = FLAT | OTHERS
    options = options_of(__doc__, worlds=worlds, sensors=["vlp-16", "os1-32"], seeds=1, elevation_deg=0.0)
    heads = "max m", "rms m", "bend max m", "bend rms m"
    row = table("world, sensor, seed", "path m", *(f"{each} without" for each in heads), *heads, "note", "s")
    config = load_settings(3).config
    config = with_fields(config, graph=with_fields(config.graph, ground="off"))
    for world, sensor, seed in product(options.worlds, options.sensors, range(options.seeds)):
        path = made.log(world, folder=options.cache, sensor=sensor, seed=seed, seconds=worlds[world])
        log = scanchain.open_log(path, elevation_offset_rad=math.radians(options.elevation_deg))
        slam = scanchain.Slam(config, log.T_base_lidar, dimension=3)
        for scan in log:
            slam.process(scan)
        result = slam.finish()
        true = scanchain.read_tum(path.with_suffix(".tum")).poses[[each.scan_index for each in result.keyframes]]
        up = lie.lift(result.T_base_lidar)[2, :3]
        begun_s = time.perf_counter()
        graph, note = flattened(result.graph, result.map_errors, up, config, levels=True)
        seconds = time.perf_counter() - begun_s
        without = true[0] @ lie.between(result.graph.poses[0], result.graph.poses)
        found = [*errors_m(without, true), *(errors_m(graph.poses, true) if graph is not result.graph else [])]
        cells = [f"{each:.3f}" for each in found] + ["same"] * (8 - len(found))
        traveled_m = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
        row(
            f"{world}, {sensor}, {seed}",
            f"{traveled_m:.0f}",
            *cells,
            note.partition(": ")[2] or "-",
            f"{seconds:.2f}",
        )


if __name__ == "__main__":
    main()
