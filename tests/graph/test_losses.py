import math

import numpy as np
import pytest

from scanchain.config import GraphConfig
from scanchain.errors import InputError
from scanchain.graph.losses import RobustLoss, robust_loss
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
