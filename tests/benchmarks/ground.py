"""Simulated drives with wheels, with and without the prior that the ground is flat: height of the result.

The error of the height is that above the first pose, where the trajectory without the prior is turned to the true
tilt; its bend is what remains of it once the best plane is subtracted. Of several seeds the largest figures are
given. Time is that of the prior alone.
"""

from __future__ import annotations

import math
import time
from itertools import product
from pathlib import Path

import numpy as np
from msgspec.structs import replace

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
    """Largest and root mean square error of the height above the first pose, and its largest bend."""
    errors = poses[:, 2, 3] - true[:, 2, 3]
    errors -= errors[0]
    A = np.column_stack([true[:, :2, 3], np.ones(len(true))])
    bend = errors - A @ np.linalg.lstsq(A, errors)[0]
    return [float(each) for each in (np.abs(errors).max(), np.sqrt(np.mean(errors**2)), np.abs(bend).max())]


def figures(path: Path, elevation_deg: float) -> tuple[list[float], str]:
    """Errors without and with the prior, seconds that it takes, and what it says."""
    config = load_settings(3).config
    config = replace(config, graph=replace(config.graph, ground="off"))
    log = scanchain.open_log(path, elevation_offset_rad=math.radians(elevation_deg))
    slam = scanchain.Slam(config, log.T_base_lidar, dimension=3)
    for scan in log:
        slam.process(scan)
    result = slam.finish()
    true = scanchain.read_tum(path.with_suffix(".tum")).poses[[each.scan_index for each in result.keyframes]]
    without, up = result.graph.poses, lie.lift(result.T_base_lidar)[2, :3]
    begun_s = time.perf_counter()
    graph, note = flattened(result.graph, result.map_errors, up, config, levels=True)
    seconds = time.perf_counter() - begun_s
    first = true[0] @ lie.inverse(without[0])
    found = errors_m((first if graph is result.graph else lie.identity(3)) @ graph.poses, true)
    both = [each for pair in zip(errors_m(first @ without, true), found, strict=True) for each in pair]
    says = "contradicted" if "contradicts" in note else note.partition("flat over ")[2].partition(" of")[0]
    return [*both, seconds], says or "not flat"


def main() -> None:
    worlds = FLAT | OTHERS
    options = options_of(__doc__, worlds=worlds, sensors=["vlp-16", "os1-32"], seeds=1, elevation_deg=0.0)
    row = table(
        "world, sensor", "max m without", "with", "rms m without", "with", "bend m without", "with", "s", "flat"
    )
    for world, sensor in product(options.worlds, options.sensors):
        seeds = range(options.seeds)
        made_by = {"folder": options.cache, "sensor": sensor, "seconds": worlds[world]}
        found = [figures(made.log(world, seed=seed, **made_by), options.elevation_deg) for seed in seeds]
        largest = np.max([each for each, _ in found], axis=0)
        row(f"{world}, {sensor}", *(f"{each:.3f}" for each in largest), ", ".join({says for _, says in found}))


if __name__ == "__main__":
    main()
