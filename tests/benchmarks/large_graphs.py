"""Simulated graphs as large as the largest published ones: python -m tests.benchmarks.large_graphs [FOLDER].

"city": 10,000 poses of a Manhattan grid, most places passed several times, loops between poses near each other.
"storys": 5,750 poses in space through the storys of a building, with ramps between them; information matrices
that differ from edge to edge by up to a factor of 100, translation and rotation coupled.
Both are drawn with the very noise that their information matrices state, so that ½χ² at the minimum is near half
the degrees of freedom. The files go to FOLDER; each is compared with GTSAM as in ``tests.benchmarks.graphs``, from
the odometry that the file holds, ours also with all poses at the origin, and certified.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.g2o import read_g2o, write_g2o
from scanchain.graph.pose_graph import PoseGraph
from tests.benchmarks.graphs import certify, compare, report

SIGHT_M = 2.1  # how far apart two poses may be that see each other


def city_poses(rng, count=10_000, blocks=40):
    """Steps of 1 m along streets, turning at crossings every 3 m, inside a square of so many crossings."""
    poses, at, heading = [], np.zeros(2), 0
    for k in range(count):
        poses.append(lie.pose_2d(*at, heading * np.pi / 2))
        if k % 3 == 0:
            heading = turned(rng, at, heading, 3.0 * blocks / 2)
        at = at + np.round([np.cos(heading * np.pi / 2), np.sin(heading * np.pi / 2)])
    return np.array(poses)


def turned(rng, at, heading, half_m):
    """Straight on twice as often as left or right, and never out of the square."""
    for turn in [*rng.permutation([0, 0, 1, -1]).tolist(), 2]:
        there = at + 3.0 * np.array([np.cos((heading + turn) * np.pi / 2), np.sin((heading + turn) * np.pi / 2)])
        if np.abs(there).max() <= half_m:
            return heading + turn
    return heading + 2


def story_poses(rng, count=5750, storys=5):
    """The same in each story, 4 m above each other, with ramps between them and a sensor that sways."""
    flat = city_poses(rng, count, 12)
    poses = lie.lift(flat)
    climb = np.linspace(0.0, storys, count)
    poses[:, 2, 3] = 4.0 * (np.floor(climb) + np.clip((climb % 1.0 - 0.9) / 0.1, 0.0, 1.0))
    sway = np.zeros((count, 6))
    sway[:, 3:5] = 0.1 * rng.normal(size=(count, 2))
    return poses @ lie.exp(sway)


def pairs_in_sight(poses, rng, most):
    """Poses within sight of each other that do not follow each other, at most so many, drawn at random."""
    pairs = cKDTree(poses[:, :-1, -1]).query_pairs(SIGHT_M, output_type="ndarray")
    pairs = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > 10]
    return np.sort(rng.permutation(pairs)[:most], axis=1)


def informations(dimension, count, rng):
    """Ω of every edge: in the plane all alike; in space uneven, and with translation and rotation coupled."""
    if dimension == 2:
        return np.tile(np.diag([1 / 0.05**2, 1 / 0.05**2, 1 / 0.02**2]), (count, 1, 1))
    root = rng.normal(size=(count, 6, 6)) * 0.15 + np.eye(6)
    sigma = np.array([0.05, 0.05, 0.05, 0.01, 0.01, 0.01]) * 10.0 ** rng.uniform(-0.5, 0.5, (count, 1))
    root = root / sigma[:, None, :]
    return np.swapaxes(root, 1, 2) @ root


def simulated(truth, loops, rng, path):
    """Write the graph of these poses, measured with noise, with the odometry as its guess."""
    dimension, count = truth.shape[-1] - 1, len(truth)
    chain = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    edges = np.concatenate([chain, loops])
    omega = informations(dimension, len(edges), rng)
    noise = rng.normal(size=(len(edges), omega.shape[-1], 1))
    off = np.linalg.solve(np.swapaxes(np.linalg.cholesky(omega), 1, 2), noise)[..., 0]
    measured = lie.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ lie.exp(off)
    graph, pose = PoseGraph(dimension), lie.identity(dimension)
    for k in range(count):
        graph.add_pose(pose, k)
        if k + 1 < count:
            pose = pose @ measured[k]
    graph.add_edges(edges, measured, omega, np.zeros(len(edges), bool))
    write_g2o(path, graph)
    return len(edges)


def make(folder):
    """The two files, the same each time."""
    rng = np.random.default_rng(0)
    city, storys = city_poses(rng), story_poses(rng)
    for name, truth, most in (("city", city, 11_000), ("storys", storys, 11_000)):
        path = folder / f"{name}.g2o"
        edges = simulated(truth, pairs_in_sight(truth, rng, most), rng, path)
        print(f"{path}: {len(truth):,} poses, {edges:,} edges", flush=True)
        yield path


def from_nothing(path):
    """Ours with every pose at the origin."""
    graph = read_g2o(path).graph
    nowhere = PoseGraph(graph.dimension)
    for k in range(len(graph)):
        nowhere.add_pose(lie.identity(graph.dimension), k)
    nowhere.add_edges(graph.edges, graph.measurements, graph.information, graph.is_loop)
    done = nowhere.optimize(GraphConfig())
    print(
        f"  ours, all poses at the origin: ½χ² {0.5 * done.chi2_after:.4f} after {done.iterations} iterations,"
        f" {1e3 * done.time_s:.0f} ms, first guess {done.initialization}"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    for path in make(options.folder):
        for warm in ("levenberg-marquardt", "gauss-newton"):
            graph = read_g2o(path).graph
            graph.optimize(GraphConfig(optimizer=warm))
            graph.certify()
        report(path.stem, compare(path, options.repeats, slow_s=2.0))
        certify(path)
        from_nothing(path)


if __name__ == "__main__":
    main()
