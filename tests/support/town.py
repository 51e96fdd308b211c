"""Keyframes of a lidar along streets of the simulated town, and graphs of their odometry."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np

from scanchain import lie
from scanchain.data import Keyframe
from scanchain.loops.connectivity import Segments
from scanchain.loops.submaps import submap_around
from scanchain.simulation import plan
from scanchain.simulation.sensors import take_sweep
from tests.support import graphs
from tests.support.scenes import stored

RADIUS_M = 32.0


def pose(x=0.0, y=0.0, z=0.0, yaw=0.0, pitch=0.0):
    return (
        lie.exp(np.array([x, y, z, 0, 0, 0.0]))
        @ lie.exp(np.array([0, 0, 0, 0, 0, yaw]))
        @ lie.exp(np.array([0, 0, 0, 0, pitch, 0.0]))
    )


@cache
def drive():
    return plan("rounds", seed=3, sensor="vlp-16", duration_s=5.0)


def scan_from(x, y, yaw, seed=0):
    """Points (N, 3) of a lidar that stands still in the town, and its true pose."""
    solids, sensor = drive().solids, drive().sensor
    height = float(solids.ground_height(np.array([x, y]))) + 1.73
    T = pose(x, y, height, yaw)

    class Standing:
        def lidar(self, times_s):
            return np.repeat(T[None], len(times_s), axis=0)

    sweep = take_sweep(solids, Standing(), sensor, 0, 0.0, np.random.default_rng(seed))
    return sweep.points().astype(np.float64), T


def passage(places, first_index=0, traveled_m=0.0):
    """Keyframes along places (x, y, yaw), as odometry without drift has them."""
    keyframes = []
    for k, (x, y, yaw) in enumerate(places):
        points, T = scan_from(x, y, yaw, seed=first_index + k)
        if keyframes:
            traveled_m += float(np.linalg.norm((T - keyframes[-1].T_odom_lidar)[:3, 3]))
        index = first_index + k
        keyframes.append(Keyframe(index, index, index, stored(points), T, traveled_m))
    return keyframes


@cache
def street(offset_m=0.0, backwards=False):
    """A drive of 60 m along one street, so far aside of its lane, perhaps the other way."""
    along = np.arange(20.0, 80.1, 4.0)
    if backwards:
        return tuple((x, -2.0 + offset_m, np.pi) for x in along[::-1])
    return tuple((x, -2.0 + offset_m, 0.0) for x in along)


@cache
def place_in_the_middle(offset_m=0.0, backwards=False):
    """Submap around the middle of that drive."""
    keyframes = passage(street(offset_m, backwards))
    return submap_around(keyframes, len(keyframes) // 2, RADIUS_M, Segments())


def blocked(keyframes, count, width_m=5.0):
    """The same keyframes, which also see so many panels across the street, evenly along it, 4 m high."""
    y, z = np.meshgrid(np.arange(-0.5 * width_m, 0.5 * width_m, 0.25), np.arange(0.0, 3.5, 0.25))
    x = 22.0 + 58.0 * (np.arange(count) + 0.5) / count
    panels = np.concatenate([np.column_stack([np.full(y.size, each), y.ravel() - 2.0, z.ravel()]) for each in x])
    seen = (lie.transform(lie.inverse(each.T_odom_lidar), panels) for each in keyframes)
    return [
        replace(each, stored=stored(np.vstack([each.points, points[np.linalg.norm(points, axis=1) < 30.0]])))
        for each, points in zip(keyframes, seen, strict=True)
    ]


def graph_of(keyframes, sigma_rad=0.002):
    """The graph of odometry alone, a keyframe's heading known from the one before with so much."""
    poses = np.array([keyframe.T_odom_lidar for keyframe in keyframes])
    information = np.diag(np.array([0.02, 0.02, 0.02, 0.002, 0.002, sigma_rad]) ** -2.0)
    edges = [*pairwise(range(len(keyframes)))]
    return graphs.graph_of(poses, edges, lie.between(poses[:-1], poses[1:]), information)
