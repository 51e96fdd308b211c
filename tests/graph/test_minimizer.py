from typing import get_args

import numpy as np

from scanchain.config import GraphConfig
from scanchain.graph.minimizer import Optimizer
from tests.support.graphs import PLAIN, published, ring


def test_every_optimizer_ends_in_the_same_minimum_of_a_ring(dimension):
    """Gradient descent too, only that it takes its time."""
    chi2 = {}
    for optimizer in get_args(Optimizer):
        graph, _ = ring(dimension, noise=0.05)
        config = GraphConfig(optimizer=optimizer, max_iterations=20_000, tolerance=1e-10, robust="none")
        answer = graph.optimize(config)
        assert answer.converged, (optimizer, answer.reason)
        chi2[optimizer] = answer.chi2_after
    assert np.allclose(list(chi2.values()), chi2["levenberg-marquardt"], rtol=1e-5)


def test_every_reason_to_stop_is_reported():
    assert published("MIT").optimize(GraphConfig(max_iterations=1, robust="none")).reason == "1 iteration reached"
    assert "χ² change" in published("intel").optimize(PLAIN).reason
    graph, _ = ring(2, noise=0.05)
    graph.optimize(GraphConfig(robust="none", tolerance=1e-10))
    assert "gradient" in graph.optimize(PLAIN).reason
    graph, _ = ring(2)
    assert graph.optimize(PLAIN).reason.split()[0] in {"gradient", "step", "χ²"}
