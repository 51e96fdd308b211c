"""Scenes to match scans in: a room with a matcher set up for it, a corridor with a dent; and a match assumed."""

import msgspec
import numpy as np

from scanchain import lie
from scanchain.config import LocalMapConfig, MatchingConfig
from scanchain.data import Problem
from scanchain.loops.verification import Verification
from scanchain.odometry.odometry import first_match
from scanchain.registration import VoxelMap, create_matcher


def room(dimension, seed=0, unit=1.0):
    """Points on the walls (and floor) of a room with a pillar, some centimeters of noise."""
    rng = np.random.default_rng(seed)
    n = 3000
    z = rng.uniform(0.0, 2.5, n)
    x, y = rng.uniform(-4.0, 4.0, n), rng.uniform(-3.0, 3.0, n)
    walls = [
        np.column_stack([x, np.full(n, 3.0), z]),
        np.column_stack([x, np.full(n, -3.0), z]),
        np.column_stack([np.full(n, 4.0), y, z]),
        np.column_stack([np.full(n, -4.0), y, z]),
    ]
    if dimension == 3:
        walls.append(np.column_stack([x, y, np.zeros(n)]))
    points = np.concatenate(walls) + 0.01 * rng.normal(size=(n * len(walls), 3))
    return unit * np.ascontiguousarray(points[:, :dimension])


def set_up(dimension, unit=1.0, **changes):
    """A matcher for the room, every length of its configuration in the given unit."""
    settings = {
        "max_distance_m": 0.8, "kernel_scale_m": 0.2, "wide_max_distance_m": 1.0, "wide_kernel_scale_m": 0.5,
        "tolerance_m": 1e-5, "sensor_noise_m": 0.02,
    }  # fmt: skip
    scaled = {name: unit * value for name, value in settings.items()}
    config = msgspec.convert({"tolerance_rad": 1e-6, "max_iterations": 200, **scaled, **changes}, MatchingConfig)
    target = VoxelMap(dimension, LocalMapConfig(voxel_size_m=0.4 * unit))
    target.insert(room(dimension, unit=unit), lie.identity(dimension))
    return create_matcher(config), target


def truth(dimension, unit=1.0):
    T = lie.exp(np.array([0.12, -0.07, 0.04] if dimension == 2 else [0.12, -0.07, 0.05, 0.02, -0.03, 0.04]))
    T[:-1, -1] *= unit
    return T


def scan_at(T, unit=1.0):
    """The room seen from T, a tenth of its points."""
    return lie.transform(lie.inverse(T), room(T.shape[0] - 1, seed=1, unit=unit)[::10])


def off(T_a, T_b):
    return np.abs(lie.log(lie.inverse(T_a) @ T_b)).max()


def dented_corridor(dents, seed=0):
    """Two walls 20 m long, 1 cm of noise, with so many points on the faces of a dent across them."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-10, 10, 4000)
    walls = np.column_stack([x, np.where(rng.random(4000) < 0.5, 1.0, -1.0) + 0.01 * rng.normal(size=4000)])
    faces = np.column_stack([0.01 * rng.normal(size=dents) + 2.0, rng.uniform(0.2, 1.0, dents)])
    return np.concatenate([walls, faces])


class Assumed:
    """A verifier that leaves every initial pose as it is, accepted or not, and keeps the submaps it was given."""

    def __init__(self, *, is_accepted):
        self.problem = None if is_accepted else Problem.plain("assumed")
        self.submaps = []

    def scan(self, source, target, T_first, **options):
        self.submaps.append(target)
        return Verification(
            first_match(T_first, np.empty((0, len(T_first) - 1)), MatchingConfig()), 1.0, self.problem
        )
