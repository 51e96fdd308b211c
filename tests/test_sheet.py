"""Drawings of a page: axes with round numbers, lines with gaps, pixels that any reader of PNG reads."""

import base64
import io
import re

import matplotlib.image
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from viz.axis import Axis
from viz.png import png_address
from viz.sheet import Pen, Sheet


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(2, 12))
def test_ticks_are_few_round_and_evenly_spaced(low, length, most):
    axis = Axis(low, low + length)
    if axis.high - axis.low < 1e-9 * abs(low):
        return
    ticks = axis.ticks(most)
    assert len(ticks) <= most + 1
    if len(ticks) > 1:
        step = ticks[1] - ticks[0]
        np.testing.assert_allclose(np.diff(ticks), step, rtol=1e-3)
        leading = step / 10.0 ** np.floor(np.log10(step) + 1e-6)
        assert np.min(np.abs(np.array([1.0, 2.0, 2.5, 5.0, 10.0]) - leading)) < 1e-2
    shares = axis.share(ticks)
    assert (shares > -1e-6).all() and (shares < 1.0 + 1e-6).all()


@given(st.floats(-9.0, 9.0), st.floats(0.05, 9.0), st.integers(3, 12))
def test_logarithmic_ticks_are_one_two_five_or_powers_of_ten(low, decades, most):
    axis = Axis(10.0**low, 10.0 ** (low + decades), is_logarithmic=True)
    ticks = axis.ticks(most)
    assert len(ticks) <= max(most + 1, 7)
    leading = ticks / 10.0 ** np.floor(np.log10(ticks) + 1e-9)
    assert np.isin(np.rint(leading), [1.0, 2.0, 5.0]).all() and np.allclose(leading, np.rint(leading))


@pytest.mark.parametrize("is_logarithmic", [False, True])
def test_an_axis_has_room_for_all_values_even_one_or_none(is_logarithmic):
    for values in ([3.0, np.nan, 40.0], [7.0], [np.nan], []):
        known = np.array([value for value in values if np.isfinite(value)])
        axis = Axis.around(np.array(values), is_logarithmic=is_logarithmic)
        assert axis.low < axis.high
        assert ((axis.share(known) > 0.0) & (axis.share(known) < 1.0)).all()
        assert not is_logarithmic or axis.low > 0.0


def test_values_lie_where_the_axis_says():
    assert Axis(2.0, 4.0).share(np.array([2.0, 3.0, 4.0])).tolist() == [0.0, 0.5, 1.0]
    shares = Axis(0.1, 1000.0, is_logarithmic=True).share(np.array([0.1, 10.0, 1000.0]))
    np.testing.assert_allclose(shares, [0.0, 0.5, 1.0])


def test_a_line_has_a_gap_where_a_point_is_unknown():
    sheet = Sheet("a")
    sheet.line(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, np.nan], [3.0, 3.0], [4.0, 4.0]]), Pen("red"))
    svg = sheet.svg(Axis(0.0, 4.0), Axis(0.0, 4.0))
    (drawn,) = re.findall(r'<path d="([^"]*)" style="fill:none;stroke:red', svg)
    assert re.sub(r"[\d. ]", "", drawn) == "MLML"


def test_pixels_are_read_back_as_they_were():
    pixels = np.random.default_rng(0).integers(0, 256, (7, 5, 4), dtype=np.uint8)
    data = base64.b64decode(png_address(pixels).removeprefix("data:image/png;base64,"))
    read = np.rint(255.0 * matplotlib.image.imread(io.BytesIO(data), format="png"))
    np.testing.assert_array_equal(read, pixels)
