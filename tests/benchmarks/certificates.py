"""Certificates of simulated pose graphs, up to noise for which the relaxation is not tight, and their soundness.

Each graph is optimized and certified; *auto* and *globally* are ½χ² of ``PoseGraph.optimize`` and of
``optimize_globally``, which starts again from the relaxation where there is no certificate. random: small graphs
with several minima, of which each is solved from many starts; a lower bound above the least χ² found would be an
error of the program.
"""

import time

import numpy as np

from scanchain.config import GraphConfig
from tests.benchmarks.harness import options_of, table
from tests.support.graphs import garage, restarted, streets, tangled

CONFIG = GraphConfig(robust="none", max_iterations=200)
GRAPHS = {
    "garage": lambda: garage(),
    "garage, noise of 0.2 m": lambda: garage(sigma=(0.2, 0.05)),
    "garage, noise of 0.5 m": lambda: garage(sigma=(0.5, 0.15)),
    "garage, soft rotations": lambda: garage(kappa=0.1),
    "streets": lambda: streets(),
    "streets, noise of 5 cm": lambda: streets(sigma=(0.05, 0.05)),
    "streets, anisotropy of 10": lambda: streets(anisotropy=10.0),
    "streets, anisotropy of 100": lambda: streets(anisotropy=100.0),
}


def simulated(options):
    row = table("graph", "auto ½χ²", "globally ½χ²", "gap %", "certificate ms", "optimize ms")
    for name, make in GRAPHS.items():
        plain, graph = make(), make()
        begin = time.perf_counter()
        auto = plain.optimize(CONFIG)
        spent_s = time.perf_counter() - begin
        best, certificate = graph.optimize_globally(CONFIG)
        halves = (f"{0.5 * each.chi2_after:.5g}" for each in (auto, best))
        times = (f"{1e3 * each:.0f}" for each in (certificate.time_s, spent_s))
        row(name, *halves, f"{100.0 * certificate.relative_gap:.2g}", *times)


def random(options):
    row = table("dimension", "graphs", "certified", "bounds above χ²", "not least: auto", "globally")
    for dimension in (2, 3):
        certified, false, missed = 0, 0, np.zeros(2, int)
        for seed in range(options.seeds // 2):
            graph, rng = tangled(dimension, seed), np.random.default_rng(seed)
            starts = [graph, *(restarted(graph, rng, size) for size in (0.1, 0.5, 1.5, 3.0) for _ in range(6))]
            found = [
                each.optimize(CONFIG, initialize="given" if index else "auto").chi2_after
                for index, each in enumerate(starts)
            ]
            answer, certificate = restarted(graph, rng, 0.0).optimize_globally(CONFIG)
            least = min(*found, answer.chi2_after)
            certified += certificate.certified
            bounds = [certificate, *(starts[index].certify() for index in {0, np.argmin(found), np.argmax(found)})]
            false += sum(each.lower_bound > least * (1.0 + 1e-7) + 1e-9 for each in bounds)
            missed += np.array([found[0], answer.chi2_after]) > least * 1.0001 + 1e-9
        row(dimension, options.seeds // 2, certified, false, *missed)


if __name__ == "__main__":
    options = options_of(__doc__, "which", cache=False, which=("simulated", "random"), seeds=300)
    {"simulated": simulated, "random": random}[options.which](options)
