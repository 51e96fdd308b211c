import math

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_distribution

from scanchain.config import GraphConfig
from scanchain.errors import InputError
from scanchain.graph.losses import RobustLoss, fair_price, limit_shares, rejection_limit, robust_loss
from tests.support.graphs import with_false_loops

LOSSES = [
    robust_loss("none", 3.0, 3),
    robust_loss("huber", 1.5, 3),
    robust_loss("cauchy", 2.0, 3),
    robust_loss("geman-mcclure", 3.0, 3),
    RobustLoss("geman-mcclure", 3.0, 7.0),
    robust_loss("tukey", 7.0, 3),
    RobustLoss("tukey", 3.0, 20.0),
    RobustLoss("truncated", 3.0, 0.5),
]


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: f"{loss.kernel}-{loss.control}")
def test_a_weight_is_the_slope_of_its_loss_and_one_at_zero(loss):
    chi2 = np.array([1e-6, 0.5, 2.0, 8.7, 12.0, 40.0, 1e3])
    step = 1e-6 * chi2
    slope = (loss.loss(chi2 + step) - loss.loss(chi2 - step)) / (2.0 * step)
    assert np.allclose(loss.weight(chi2), slope, rtol=1e-5, atol=1e-8)
    assert loss.weight(np.zeros(1))[0] == pytest.approx(1.0)
    assert loss.loss(np.array([1e-9]))[0] == pytest.approx(1e-9, rel=1e-6)


class OtherSlope:
    """Weight and loss of two functions."""

    def weight(self, chi2, s, mu):
        return s**2 / (s**2 + chi2)

    def loss(self, chi2, s, mu):
        return s**2 * -np.expm1(-chi2 / s**2)


class Scalar(OtherSlope):
    """A loss that takes one residual at a time."""

    def loss(self, chi2, s, mu):
        return s**2 * -math.expm1(-chi2 / s**2)


@pytest.mark.parametrize(("name", "fault"), [("OtherSlope", "slope of loss"), ("Scalar", "fails for")])
def test_a_loss_of_the_users_that_is_none_is_refused(name, fault):
    graph, _, _ = with_false_loops("intel", 0.03)
    with pytest.raises(InputError, match=fault):
        graph.optimize(GraphConfig(robust=f"{__name__}:{name}"))


def test_an_edge_is_rejected_above_the_limit_that_one_of_1000_true_ones_exceeds():
    for degrees in range(1, 7):
        limit = rejection_limit(1e-3, degrees)
        assert chi2_distribution.sf(limit, degrees) == pytest.approx(1e-3)
        assert rejection_limit(9.0, degrees) == 81.0
        truncated = robust_loss("truncated", 1e-3, degrees)
        assert truncated.weight(limit * np.array([0.999, 1.001])).tolist() == [1.0, 0.0]
    limits = [rejection_limit(1.0, degrees) for degrees in (1, 1, 2, 3)]
    assert limit_shares(1.0, np.array([0, 1, 2, 3]), 3) == pytest.approx(np.array(limits) / limits[-1])


@pytest.mark.parametrize("kernel", ["geman-mcclure", "tukey", "truncated", "huber", "cauchy"])
@pytest.mark.parametrize("largest", [5.0, 1e3, 1e6])
def test_a_schedule_begins_where_the_largest_residual_has_weight_and_ends_with_the_loss_itself(kernel, largest):
    loss = robust_loss(kernel, 2.0, 3)
    steps = list(loss.graduated(np.array([1.0, largest])))
    weights = np.array([step.weight(np.array([largest]))[0] for step in steps])
    assert steps[-1] == loss and weights[0] > 0.0 and (np.diff(weights) <= 0.0).all()
    if kernel in ("huber", "cauchy"):
        assert len(steps) == 1
    elif largest > 1e2:
        assert weights[-1] < 0.01 * weights[0] and 5 < len(steps) < 100
        controls = np.array([step.control for step in steps[:-1]])
        assert np.exp(np.abs(np.diff(np.log(controls)))).max() <= 4.0 + 1e-9


@pytest.mark.parametrize("degrees", [1, 3, 6])
def test_a_price_falls_with_distances_far_below_what_their_noise_should_make_them_and_never_rises(degrees):
    against = chi2_distribution.rvs(degrees, size=2000, random_state=degrees)
    residuals = np.full(2000, degrees)
    assert fair_price(against, 20.0, residuals) == fair_price(100.0 * against, 20.0, residuals) == 20.0
    assert fair_price(1e-2 * against, 20.0, residuals) == pytest.approx(6e-2 * 20.0, rel=0.1)
    assert fair_price(1e-2 * against[:9], 20.0, residuals[:9]) == 20.0
