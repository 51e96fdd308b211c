"""Pose graphs for tests: published ones, of given poses and edges, and rings."""

import numpy as np

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
