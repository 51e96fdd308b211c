"""Solids of outdoor worlds: trees and parked cars."""

from __future__ import annotations

import numpy as np

from scanchain.simulation.solids import Scenery

BELOW_M = -1.0  # foundations reach this deep, so that nothing floats on a slope


def parked_car(scenery: Scenery, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
    """A body, a cabin and four wheels; now and then a van."""
    length, width = rng.uniform(3.8, 4.8), rng.uniform(1.7, 1.85)
    c, s = np.cos(yaw), np.sin(yaw)
    with scenery.movable():
        if rng.random() < 0.15:
            scenery.box((x, y), (length + 0.4, width + 0.15), (0.25, rng.uniform(2.0, 2.5)), yaw)
        else:
            back = rng.choice([-1.0, 1.0]) * 0.08 * length
            scenery.box((x, y), (length, width), (0.22, rng.uniform(0.8, 1.0)), yaw)
            cabin = (x + c * back, y + s * back)
            scenery.box(cabin, (0.5 * length, width - 0.2), (0.8, rng.uniform(1.4, 1.6)), yaw)
        for u in (-0.32 * length, 0.32 * length):
            for v in (-0.5 * width + 0.1, 0.5 * width - 0.1):
                scenery.box((x + c * u - s * v, y + s * u + c * v), (0.6, 0.2), (-0.1, 0.3), yaw)


def tree(scenery: Scenery, x: float, y: float, rng: np.random.Generator) -> None:
    """A trunk, a crown of two ellipsoids, sometimes a shrub at its foot."""
    radius, height = rng.uniform(0.12, 0.28), rng.uniform(3.2, 4.6)
    scenery.cylinder((x, y), radius, (BELOW_M, height))
    size = rng.uniform(1.1, 1.9)
    scenery.ellipsoid((x, y, height + 0.5 * size), (size, size, rng.uniform(0.9, 1.3) * size))
    offset = rng.normal(0.0, 0.4, 2)
    scenery.ellipsoid((x + offset[0], y + offset[1], height + 1.4 * size), (0.8 * size, 0.7 * size, 0.8 * size))
    if rng.random() < 0.3:
        scenery.ellipsoid((x, y, 0.3), (rng.uniform(0.4, 0.7), rng.uniform(0.4, 0.7), rng.uniform(0.4, 0.8)))
