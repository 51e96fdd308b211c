"""Wrong loop edges added to published graphs, and what becomes of them.

To the loops of a graph are added, in proportion to their number, edges between random poses that never saw each
other: "anywhere", their relative pose drawn from the extent of the map; "nearby", within 2 m and any angle, as a
matcher that was deceived would give; "groups" and "groups of 10", nearby ones that agree in runs of five and ten
successive poses, as along a corridor that looks like another. A share is of the true loops: 0.43 makes 30 % of all
wrong. The trajectory is compared with the optimum of the graph without them.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.data import Trajectory
from scanchain.graph.g2o import read_g2o
from tests.benchmarks.harness import ate_m, options_of, table
from tests.support.scenes import DATA

KINDS = {"anywhere": 1, "nearby": 1, "groups": 5, "groups of 10": 10}  # how many agree with each other


@dataclass(frozen=True, slots=True)
class Outcome:
    """Shares of wrong edges and of true loops that were rejected, ATE without and with wrong edges, time."""

    wrong_rejected: float
    true_rejected: float
    ate_clean_m: float
    ate_m: float
    time_s: float
    certified: bool


def add_wrong_loops(graph, share, kind, rng):
    """Add them, ``share`` times as many as there are loops; which edges they are, (E,) bool."""
    real = len(graph.edges)
    wanted = int(share * graph.is_loop.sum())
    omega = np.median(graph.information[graph.is_loop], axis=0)
    pairs, poses, agreeing = [], [], KINDS[kind]
    while len(pairs) < wanted:
        i, j = rng.integers(0, len(graph) - max(agreeing, 5), 2)
        if abs(i - j) <= 10:
            continue
        T = random_pose(graph, kind, rng)
        for k in range(agreeing):  # the same mistake a few poses later: T carried along the poses of both ends
            pairs.append((i + k, j + k))
            back, ahead = (lie.between(graph.poses[end], graph.poses[end + k]) for end in (i, j))
            poses.append(lie.inverse(back) @ T @ ahead)
    graph.add_edges(
        np.array(pairs), np.array(poses), np.tile(omega, (len(pairs), 1, 1)), np.ones(len(pairs), bool)
    )
    return np.arange(len(graph.edges)) >= real


def random_pose(graph, kind, rng):
    d, k = graph.dimension, graph.freedom
    turn = rng.uniform(-np.pi, np.pi) if d == 2 else rng.normal(size=3)
    reach = np.ptp(graph.poses[:, :d, d], axis=0) / 2 if kind == "anywhere" else np.full(d, 2.0)
    twist = np.zeros(k)
    twist[d:] = turn
    T = lie.exp(twist)
    T[:d, d] = rng.uniform(-reach, reach)
    return T


def try_wrong_loops(path, share, kind, seed, robust="truncated"):
    """Optimize with and without them."""
    clean = read_g2o(path).graph
    clean.optimize(GraphConfig())
    alone = read_g2o(path, loops="robust").graph
    alone.optimize(GraphConfig(robust=robust))
    graph = read_g2o(path, loops="robust").graph
    is_wrong = add_wrong_loops(graph, share, kind, np.random.default_rng(seed))
    answer = graph.optimize(GraphConfig(robust=robust))
    rejected = np.empty(len(is_wrong), bool)
    rejected[np.argsort(graph.is_loop, kind="stable")] = answer.rejected
    return Outcome(
        float(rejected[is_wrong].mean()),
        float(rejected[graph.is_loop & ~is_wrong].mean()),
        *(ate_m(*(Trajectory(g.stamps_ns, g.poses) for g in (each, clean))) for each in (alone, graph)),
        answer.time_s,
        graph.certify().certified,
    )


def main():
    graphs, shares = ["manhattan", "intel"], [0.1, 0.3, 0.5]
    more = {"kinds": KINDS, "seeds": 3, "robust": "truncated"}
    options = options_of(__doc__, "graphs", cache=False, graphs=graphs, shares=shares, **more)
    row = table("graph", "kind", "added", "seed", "wrong rejected", "true rejected", "ATE m", "without", "time s")
    for name, kind, share, seed in product(options.graphs, options.kinds, options.shares, range(options.seeds)):
        found = try_wrong_loops(DATA / "graphs" / f"{name}.g2o", share, kind, seed, options.robust)
        rejected = f"{100 * found.wrong_rejected:.2f} %", f"{100 * found.true_rejected:.2f} %"
        ate = f"{found.ate_m:.4f}", f"{found.ate_clean_m:.4f}"
        row(name, kind, f"{100 * share:.0f} %", seed, *rejected, *ate, f"{found.time_s:.2f}")


if __name__ == "__main__":
    main()
