"""Pose graphs for tests: published ones, of given poses and edges, and rings."""

from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.g2o import read_g2o
from scanchain.graph.pose_graph import PoseGraph
from tests.support.scenes import shared_data

PLAIN = GraphConfig(robust="none")
BEST = {"manhattan": 1774.5205, "intel": 22.5021, "MIT": 20.6035, "sphere2500": 675.701, "torus3D": 12117.6}  # ½χ²


def published(name, **options):
    """A published graph as its file has it."""
    return read_g2o(shared_data(f"graphs/{name}.g2o"), **options).graph


def graph_of(poses, edges=(), measurements=(), information=None, is_loop=None, stamps_ns=None):
    """A graph of these poses and edges; information (E, k, k), or (k, k) for all of them."""
    graph = PoseGraph(len(poses[0]) - 1)
    for index, pose in enumerate(poses):
        graph.add_pose(pose, int(index if stamps_ns is None else stamps_ns[index]))
    count, k = len(edges), graph.freedom
    if count:
        every = np.broadcast_to(information, (count, k, k)).copy()
        loops = np.zeros(count, bool) if is_loop is None else np.asarray(is_loop)
        graph.add_edges(np.asarray(edges), np.asarray(measurements), every, loops)
    return graph


def chained(keyframes, sigma_m):
    """The graph of the odometry of keyframes, each of whose motions has so much noise."""
    poses, edges = np.array([each.T_odom_lidar for each in keyframes]), [*pairwise(range(len(keyframes)))]
    information = np.diag(lie.by_component(lie.twist_size(poses[0]), sigma_m, 1e-3) ** -2.0)
    return graph_of(poses, edges, lie.between(poses[:-1], poses[1:]), information)


def ring(dimension, count=12, *, noise=0.0, seed=0):
    """A closed ring whose guess follows the noisy odometry, its last edge the loop; and the true poses."""
    rng = np.random.default_rng(seed)
    k = 3 if dimension == 2 else 6
    twist = np.zeros(k)
    twist[0], twist[-1] = 1.0, 2.0 * np.pi / count
    true, poses, measured = [lie.identity(dimension)], [lie.identity(dimension)], []
    for _ in range(count - 1):
        true.append(true[-1] @ lie.exp(twist))
        measured.append(lie.inverse(true[-2]) @ true[-1] @ lie.exp(noise * rng.normal(size=k)))
        poses.append(poses[-1] @ measured[-1])
    edges = [*((index, index + 1) for index in range(count - 1)), (count - 1, 0)]
    is_loop = np.arange(count) == count - 1
    graph = graph_of(poses, edges, [*measured, lie.inverse(true[-1])], 100.0 * np.eye(k), is_loop)
    return graph, np.array(true)


def closed_ring(dimension, count, turns, noise=0.0):
    """Poses that each measure the next one where they are, the last the first; they start wound up some turns."""
    k = 3 if dimension == 2 else 6
    rng = np.random.default_rng(0)
    twists = np.zeros((count, k))
    twists[:, -1] = 2.0 * np.pi * turns * np.arange(count) / count
    edges = np.stack([np.arange(count), (np.arange(count) + 1) % count], axis=1)
    measured = lie.exp(noise * rng.normal(size=(count, k)))
    return graph_of(lie.exp(twists), edges, measured, np.diag([100.0] * dimension + [1e4] * (k - dimension)))


def field(seed=0, noise=0.05, poses=12, points=5):
    """Poses on a circle that see points inside and outside of it; the guess of the points is poor."""
    rng = np.random.default_rng(seed)
    angles = 2.0 * np.pi * np.arange(poses) / poses
    true = np.array([lie.pose_2d(4 * np.cos(a), 4 * np.sin(a), a + np.pi / 2) for a in angles])
    marks = rng.uniform(-6.0, 6.0, (points, 2))
    graph = graph_of([T @ lie.exp(0.05 * rng.normal(size=3)) if index else T for index, T in enumerate(true)])
    for index, mark in enumerate(marks):
        graph.add_point(mark + rng.normal(size=2), 100 + index)
    for i in range(poses - 1):
        Z = lie.inverse(true[i]) @ true[i + 1] @ lie.exp(noise * rng.normal(size=3))
        graph.add_edge(i, i + 1, Z, np.diag([4.0, 9.0, 25.0]) / noise**2 / 9)
    pairs = np.array([(i, poses + p) for i in range(poses) for p in range(points) if (i + p) % 2])
    T_i = lie.inverse(true[pairs[:, 0]])
    seen = (T_i[:, :2, :2] @ marks[pairs[:, 1] - poses][..., None])[..., 0] + T_i[:, :2, 2]
    seen += noise * rng.normal(size=seen.shape)
    for pair, position in zip(pairs.tolist(), seen, strict=True):
        sight(graph, pair, position, [[2.0, 0.5], [0.5, 1.0]] / np.array(noise**2))
    return graph


def sight(graph, pair, position, information):
    """Add a point as seen from a pose."""
    graph.add_edge(*pair, lie.pose_2d(*position, 0.0), np.pad(information, (0, 1)))


def with_false_loops(name, share, seed=0):
    """A published graph, its loops under suspicion, with random ones added, and the poses it should end with."""
    true, graph = published(name), published(name, loops="robust")
    true.optimize(GraphConfig())
    rng = np.random.default_rng(seed)
    count = int(share * graph.is_loop.sum())
    pairs = rng.integers(0, len(graph), (count, 2))
    pairs = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > 1]
    span = np.ptp(true.poses[:, :2, 2], axis=0)
    twists = rng.uniform(-0.5, 0.5, (len(pairs), 3)) * [*span, 2.0 * np.pi]
    omega = np.median(graph.information[graph.is_loop], axis=0)
    real = len(graph.edges)
    graph.add_edges(pairs, lie.exp(twists), np.tile(omega, (len(pairs), 1, 1)), np.ones(len(pairs), bool))
    return graph, true, np.arange(len(graph.edges)) >= real


def garage(*, count=1661, sigma=(0.02, 0.005), kappa=1.0, seed=0):
    """Laps up and down five floors, a pose every 4 m, with loops between neighboring passes and floors.

    sigma : of the noise, m and rad; the information is 1 m⁻² and κ rad⁻² whatever the noise, as in published ones
    """
    rng = np.random.default_rng(seed)
    along, lap, floors = 4.0 * np.arange(count), 170.0, 5
    cosine, sine = (each(2.0 * np.pi * along / lap) for each in (np.cos, np.sin))
    level = 3.0 * floors * np.abs((along / (floors * lap)) % 2.0 - 1.0)
    oval = (40.0 * np.sign(cosine) * np.abs(cosine) ** 0.6, 22.0 * np.sign(sine) * np.abs(sine) ** 0.6)
    positions = np.stack([oval[0] + 0.3 * rng.normal(size=count), oval[1], level], axis=1)
    ahead = np.gradient(positions, axis=0)
    true = lie.exp(np.stack([*np.zeros((5, count)), np.arctan2(ahead[:, 1], ahead[:, 0])], axis=1))
    true[:, :3, 3] = positions
    return _surveyed(true, 6.0, 3 * count, np.repeat(sigma, 3), np.diag([1.0] * 3 + [kappa] * 3), rng)


def streets(*, count=15000, sigma=(0.01, 0.01), anisotropy=1.0, seed=0):
    """A long walk through a grid of streets with few loops: 100 m⁻² (times the anisotropy ahead), 180 rad⁻²."""
    rng = np.random.default_rng(seed)
    heading, toward, left, position, poses = 0.0, 0.0, 0.0, np.zeros(2), []
    for _ in range(count):
        if left <= 0.0:
            toward, left = toward + 0.5 * np.pi * rng.choice([-1, 0, 1]), rng.choice([60.0, 120.0])
        heading += np.clip(toward - heading, -0.3, 0.3) + 0.01 * rng.normal()
        ahead = np.array([np.cos(heading), np.sin(heading)])
        position, left = position + 0.45 * ahead, left - 0.45
        poses.append([*position, heading])
        if (np.abs(position) > 250.0).any() and position @ ahead > 0.0 and left < 60.0:
            toward, left = toward + np.pi, 60.0
    planar = np.array(poses)
    true = lie.exp(planar * [0.0, 0.0, 1.0])
    true[:, :2, 2] = planar[:, :2]
    omega = np.diag([100.0 * anisotropy, 100.0, 180.0])
    return _surveyed(true, 4.0, count // 9, np.repeat(sigma, (2, 1)), omega, rng)


def _surveyed(true, reach, loops, sigma, information, rng):
    """A graph of odometry and of some of the pairs within reach, which starts from the odometry."""
    pairs = cKDTree(true[:, :-1, -1]).query_pairs(reach, output_type="ndarray")
    pairs = pairs[np.abs(pairs[:, 1] - pairs[:, 0]) > 8]
    pairs = pairs[rng.permutation(len(pairs))[:loops]]
    places = np.arange(len(true))
    edges = np.concatenate([np.stack([places[:-1], places[1:]], axis=1), pairs])
    i, j = edges.T
    measured = lie.inverse(true[i]) @ true[j] @ lie.exp(sigma * rng.normal(size=(len(edges), len(sigma))))
    poses = [true[0]]
    for step in measured[: len(true) - 1]:
        poses.append(poses[-1] @ step)
    return graph_of(poses, edges, measured, information)


def tangled(dimension, seed):
    """A small random graph with noise up to where it has several minima, anisotropic and with long edges."""
    rng = np.random.default_rng(seed)
    k, count = (3, 6)[dimension - 2], int(rng.integers(4, 10))
    poses = lie.exp(rng.normal(size=(count, k)))
    poses[:, :dimension, dimension] *= rng.choice([0.3, 1.0, 10.0])
    edges = {(i, i + 1) for i in range(count - 1)}
    edges |= {
        tuple(sorted(rng.choice(count, 2, replace=False).tolist())) for _ in range(rng.integers(1, 2 * count))
    }
    edges = np.array(sorted(edges))
    sigma = np.repeat(rng.choice([0.03, 0.3, 1.0, 2.0], 2), (dimension, k - dimension))
    sigma = sigma * rng.choice([1.0, 1.0, 0.1, 0.03], size=(len(edges), k))
    noise = rng.choice([0.3, 1.0, 3.0]) * sigma * rng.normal(size=(len(edges), k))
    mix = np.eye(k) + rng.choice([0.0, 0.5]) * rng.normal(size=(len(edges), k, k))
    information = np.swapaxes(mix, 1, 2) @ (mix * sigma[:, :, None] ** -2)
    measured = lie.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ lie.exp(noise)
    graph = graph_of(poses, edges, measured, information)
    if rng.random() < 0.2:
        graph.fix(0)
        graph.fix(count - 1)
    return graph


def restarted(graph, rng, size):
    """A copy whose free poses start off by twists of this size."""
    twists = size * rng.normal(size=(len(graph), graph.freedom))
    twists[graph.fixed] = 0.0
    copy = PoseGraph(graph.dimension)
    for pose in lie.exp(twists) @ graph.poses:
        copy.add_pose(pose, len(copy))
    copy.add_edges(graph.edges, graph.measurements, graph.information, graph.is_loop)
    for index in np.flatnonzero(graph.fixed).tolist():
        copy.fix(index)
    return copy
