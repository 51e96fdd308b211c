"""Simulated worlds in which people and cars move, scanned from known places."""

from dataclasses import dataclass, replace

import numpy as np

from scanchain import lie
from scanchain.data import Points, Pose, Scan
from scanchain.evaluation import path_length
from scanchain.kernels.raycast import BOX, CYLINDER
from scanchain.preprocess import first_per_voxel
from scanchain.simulation.drive import plan
from scanchain.simulation.solids import FIXED
from scanchain.simulation.worlds.outdoor import town

PLACE_SEED = 3


@dataclass(frozen=True)
class LabeledScan:
    """A scan as a keyframe holds it: points (N, d) thinned out, lidar frame, and which of them moved."""

    T_world_lidar: Pose
    points: Points
    moves: np.ndarray


def walkers_in_the_office(duration_s=120.0, every_m=0.5):
    """People who walk up and down the corridors, a robot among them with a laser scanner."""
    drive = plan("office", seed=PLACE_SEED, duration_s=duration_s)
    ways = np.array([[[4.6, 5.4], [21.4, 5.4]], [[21.4, 12.7], [4.6, 12.7]], [[4.7, 12.5], [4.7, 5.5]],
                     [[21.3, 5.5], [21.3, 12.5]], [[12.4, 6.5], [12.4, 11.5]]])  # fmt: skip

    def cylinders_at(time_s):
        return [_walker(a, b, 1.2 + 0.1 * k, time_s + 7.0 * k, 0.0) for k, (a, b) in enumerate(ways)]

    return _scans(drive, every_m, 0.01, cylinders_at, lambda time_s: [])


def traffic_in_the_town(duration_s=60.0, every_m=2.0, sensor="hdl-64"):
    """Cars that come toward a car with a lidar or overtake it, and people on the pavements; no car is parked."""
    drive = plan("town", seed=PLACE_SEED, duration_s=duration_s, sensor=sensor)
    solids = town(np.random.default_rng(PLACE_SEED), parked=0.0)
    drive = replace(drive, solids=solids)
    streets = [(axis, at) for axis, places in ((0, (0.0, 40.0)), (1, (0.0, 50.0, 100.0))) for at in places]

    def boxes_at(time_s):
        return [
            _car(solids, axis, at + side, (side * 2.5 * time_s + 40.0 * k) % 160.0 - 40.0)
            for axis, at in streets for side in (-2.7, 2.7) for k in range(2)
        ]  # fmt: skip

    def cylinders_at(time_s):
        people = []
        for k, (axis, at) in enumerate(streets):
            ends = np.array([[-20.0, at + 5.9], [110.0, at + 5.9]])
            a, b = ends if axis == 0 else ends[:, ::-1]
            place = _walker(a, b, 1.4, time_s + 20.0 * k, 0.0)[:2]
            people.append(_walker(a, b, 1.4, time_s + 20.0 * k, float(solids.ground_height(np.array(place)))))
        return people

    return _scans(drive, every_m, 0.5, cylinders_at, boxes_at)


def ground_height(xy):
    """Height of the town's ground at (N, 2) places."""
    return town(np.random.default_rng(PLACE_SEED), parked=0.0).ground_height(xy)


def _walker(a, b, speed_m_s, time_s, ground_m):
    """An upright cylinder that goes from a to b and back."""
    length_m = np.linalg.norm(b - a)
    share = abs((speed_m_s * time_s / length_m + 1.0) % 2.0 - 1.0)
    return (*(a + share * (b - a)), 0.22, ground_m, ground_m + 1.75)


def _car(solids, axis, across, along):
    """A box 4.4 m long and 0.2 m off the ground."""
    x, y = (along, across) if axis == 0 else (across, along)
    ground_m = float(solids.ground_height(np.array([x, y])))
    half = (2.2, 0.9) if axis == 0 else (0.9, 2.2)
    return (x, y, *half, ground_m + 0.2, ground_m + 1.6, 1.0, 0.0)


def _scans(drive, every_m, voxel_m, cylinders_at, boxes_at):
    """A scan every so many meters of the way, taken from a lidar that stands still for it."""
    random = np.random.default_rng(PLACE_SEED)
    sensor = drive.sensor
    times_s = drive.scans * sensor.period_ns * 1e-9
    poses = drive.motion.lidar(times_s)
    picked = np.flatnonzero(np.diff(np.floor(path_length(poses) / every_m), prepend=-1.0))
    for number in picked:
        rays = sensor.rays(number)
        time_s, T = times_s[number], poses[number]
        moving = _among(drive.solids, boxes_at(time_s), cylinders_at(time_s))
        pose_of_ray = np.zeros(len(rays.directions), np.int32)
        still_m = drive.solids.cast(T[None], pose_of_ray, rays.directions, sensor.max_range_m)
        ranges_m = moving.cast(T[None], pose_of_ray, rays.directions, sensor.max_range_m)
        moves = ranges_m < still_m
        noisy_m = ranges_m + sensor.noise_m * random.standard_normal(len(ranges_m))
        kept = np.isfinite(ranges_m) & (noisy_m > sensor.min_range_m)
        points = np.ascontiguousarray((rays.directions[kept] * noisy_m[kept, None])[:, : sensor.dimension])
        chosen = first_per_voxel(points, voxel_m, 0.0, 1e9)
        yield LabeledScan(T if sensor.dimension == 3 else lie.flatten(T), points[chosen], moves[kept][chosen])


def _among(solids, boxes, cylinders):
    """Solids and others that move."""
    rows = [(BOX, x, y, half_x, half_y, c, s, low, high) for x, y, half_x, half_y, low, high, c, s in boxes]
    rows += [(CYLINDER, x, y, radius, radius, 1.0, 0.0, low, high) for x, y, radius, low, high in cylinders]
    return solids.with_object(np.reshape(rows, (-1, 9)), FIXED)


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
        solids = _among(drive.solids, boxes, cylinders)
        begun = lie.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, random.uniform(0.0, 6.3)]))[:3, :3]
        directions = rays.directions @ begun.T
        ranges_m = solids.cast(T, np.zeros(len(directions), np.int32), directions, 100.0)
        returned = np.isfinite(ranges_m)
        noisy_m = ranges_m[returned] + drive.sensor.noise_m * random.standard_normal(np.count_nonzero(returned))
        points = (directions[returned] * noisy_m[:, None]).astype(np.float32)
        yield Scan.of(points, 1000.0 + 0.1 * index, index=index)
