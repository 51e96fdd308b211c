from dataclasses import dataclass
from typing import get_args

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.cholesky import SingularMatrixError
from scanchain.graph.losses import RobustLoss, limit_shares
from scanchain.graph.minimizer import Limits, LocalModel, Minimizer, Optimizer, descend, step_rule
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


@dataclass(frozen=True)
class Point:
    """Where two residuals are, e = (a (y − x²), 1 − x), and their cost."""

    x: np.ndarray
    a: float

    @property
    def errors(self):
        return np.array([self.a * (self.x[1] - self.x[0] ** 2), 1.0 - self.x[0]])

    @property
    def cost(self):
        return float(self.errors @ self.errors)

    def moved(self, step):
        return Point(self.x + step, self.a)


def model_at(point):
    J = np.array([[-2.0 * point.a * point.x[0], point.a], [-1.0, 0.0]])
    H, diagonal = J.T @ J, np.einsum("ia,ia->a", J, J)
    gradient = J.T @ point.errors
    return LocalModel(
        gradient, diagonal, lambda damping: np.linalg.solve(H + damping * np.diag(diagonal), -gradient), H.dot
    )


@pytest.mark.parametrize(
    ("optimizer", "steps"), [("gauss-newton", 4), ("levenberg-marquardt", 100), ("gradient-descent", 5000)]
)
def test_every_rule_descends_along_a_curved_valley_to_its_end(optimizer, steps):
    costs = []

    def model(point):
        costs.append(point.cost)
        return model_at(point)

    start = Point(np.array([-1.2, 1.0]), 3.0)
    found = descend(model, Point.moved, start, step_rule(optimizer), steps, 1e-12)
    assert found.converged and found.iterations <= steps
    np.testing.assert_allclose(found.estimate.x, [1.0, 1.0], atol=1e-4)
    assert optimizer == "gauss-newton" or (np.diff(costs) <= 0.0).all()


def refusing(below):
    """A model at x = 0 of the cost (1 − x)², that cannot be solved below this damping."""

    def solve(damping):
        if damping < below:
            raise SingularMatrixError(0, 0)
        return np.ones(2) / (1.0 + damping)

    return LocalModel(-np.ones(2), np.ones(2), solve, lambda step: step)


def test_damping_grows_until_there_is_a_step_and_without_any_the_descent_says_so():
    start, away = Point(np.zeros(2), 0.0), Point(np.array([np.inf, -np.inf]), 1.0)
    step, to = step_rule("levenberg-marquardt").move(start, refusing(0.5), start.moved)
    assert 0.0 < step[0] <= 1.0 / 1.5 and to.cost < start.cost
    with pytest.raises(SingularMatrixError):
        step_rule("gauss-newton").move(start, refusing(0.5), start.moved)
    for optimizer in get_args(Optimizer):
        stuck = descend(lambda _: refusing(0.0), lambda *_: away, start, step_rule(optimizer), 9, 1e-6)
        assert stuck.estimate is start and not stuck.converged and stuck.reason == "no step lowers χ²"


def test_the_cost_is_the_loss_of_robust_edges_and_chi2_of_all_others(dimension):
    graph, true = ring(dimension, noise=0.2)
    poses = true @ lie.exp(0.1 * np.random.default_rng(0).normal(size=(12, graph.freedom)))
    problem = graph._prepared()
    shares = limit_shares(1.0, problem.residuals, problem.freedom)
    minimizer = Minimizer(problem, "levenberg-marquardt", Limits(9, 1e-6), shares)
    for loss in (
        RobustLoss("cauchy", 2.0, 1.0),
        RobustLoss("truncated", 2.0, np.inf),
        RobustLoss("none", 2.0, 1.0),
    ):
        now = minimizer.evaluate(poses, loss)
        plain, robust = now.chi2[~graph.is_loop].sum(), loss.loss(now.chi2[graph.is_loop]).sum()
        assert now.cost == pytest.approx(plain + robust)
        weights = minimizer.weights(now.chi2, loss)
        assert (weights[~graph.is_loop] == 1.0).all()
        assert np.array_equal(weights[graph.is_loop], loss.weight(now.chi2[graph.is_loop]))
        assert (
            minimizer.reweighted(minimizer.evaluate(poses, RobustLoss("huber", 0.1, 1.0)), loss).cost == now.cost
        )
