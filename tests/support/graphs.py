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
