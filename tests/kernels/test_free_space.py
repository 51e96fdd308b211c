"""Ranges of a view, and points that lie on what it saw or in front of it."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.kernels.free_space import FAR, compare_ranges, nearest_ranges
from tests.support import naive
from tests.support.town import pose


@pytest.mark.parametrize("seed", range(3))
def test_ranges_compare_as_the_naive_ones(seed):
    rng = np.random.default_rng(seed)
    seen = rng.normal(0.0, 8.0, (2000, 3))
    points = seen[::3] * rng.uniform(0.5, 1.2, (len(seen[::3]), 1))
    T = pose(0.1, 0.2, 0.0, yaw=0.02)
    ranges_m = np.empty((20, 40))
    nearest_ranges(seen, ranges_m)
    found = compare_ranges(points, T, ranges_m, 0.5, 0.05)
    assert found == naive.agreement(seen, points, T, ranges_m.shape, 0.5, 0.05)
    assert min(found) > 20


def test_where_nothing_was_seen_nothing_is_said():
    ranges_m = np.empty((10, 20))
    nearest_ranges(np.empty((0, 3)), ranges_m)
    assert np.all(ranges_m == FAR)
    assert compare_ranges(np.ones((5, 3)), lie.identity(3), ranges_m, 0.5, 0.0) == (0, 0)
    assert compare_ranges(np.zeros((1, 3)), lie.identity(3), ranges_m, 0.5, 0.0) == (0, 0)
