"""Scans of a simulated lidar that stands among people and cars."""

from dataclasses import replace

import numpy as np

from scanchain import lie
from scanchain.data import Scan
from scanchain.simulation.drive import plan


def standing(sensor, count, world="town", seed=2, noise_m=None, people=0, cars=0):
    """Scans of a lidar that stands, begun at any azimuth; people walk around it, cars drive by."""
    drive = plan(world, sensor=sensor, duration_s=1.0, seed=seed, noise_m=noise_m)
    random = np.random.default_rng(seed + 100)
    rays = drive.sensor.rays(0)
    T = drive.motion.lidar(np.zeros(1))
    here, ahead = T[0, :2, 3], T[0, :2, 0] / np.linalg.norm(T[0, :2, 0])
    left = np.array([-ahead[1], ahead[0]])
    circles = np.column_stack([random.uniform(3.0, 12.0, people), random.uniform(0.0, 6.3, people)])
    lanes = np.column_stack([random.uniform(-60.0, 60.0, cars), random.uniform(4.0, 12.0, cars)])
    for index in range(count):
        a = circles[:, 1] + 0.12 * index / circles[:, 0]
        walkers = here + circles[:, :1] * (np.cos(a)[:, None] * ahead + np.sin(a)[:, None] * left)
        x = (lanes[:, 0] + 0.1 * index * lanes[:, 1] + 80.0) % 160.0 - 80.0
        traffic = here + x[:, None] * ahead + np.where(np.arange(cars) % 2, 3.2, -3.4)[:, None] * left
        ground, below = (drive.solids.ground_height(each) for each in (walkers, traffic))
        cylinders = np.column_stack([walkers, np.full(people, 0.25), ground, ground + 1.75])
        boxes = np.column_stack(
            [traffic, np.full((cars, 2), (2.4, 0.95)), below + 0.2, below + 1.8, np.full((cars, 2), ahead)]
        )
        solids = replace(
            drive.solids,
            cylinders=np.vstack([drive.solids.cylinders, cylinders]),
            boxes=np.vstack([drive.solids.boxes, boxes]),
        )
        begun = lie.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, random.uniform(0.0, 6.3)]))[:3, :3]
        directions = rays.directions @ begun.T
        ranges_m = solids.cast(T, np.zeros(len(directions), np.int32), directions, 100.0)
        returned = np.isfinite(ranges_m)
        noisy_m = ranges_m[returned] + drive.sensor.noise_m * random.standard_normal(np.count_nonzero(returned))
        points = (directions[returned] * noisy_m[:, None]).astype(np.float32)
        yield Scan.of(points, 1000.0 + 0.1 * index, index=index)
