import re
from base64 import b64decode
from io import BytesIO

import numpy as np
import pytest

from scanchain.verdict import Kind
from scanchain_viz.colors import ODOMETRY, OPTIMIZED, SEGMENT_COLORS, TRUTH, palette_of, rgb
from scanchain_viz.pictures.axis import Axis, width_of
from scanchain_viz.pictures.figure import Line, Plot
from scanchain_viz.pictures.maps import draw_map, draw_points

image = pytest.importorskip("matplotlib.image")


def circle(radius_m):
    angle = np.linspace(0.0, 1.9 * np.pi, 100)
    return radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros(100)], axis=1)


WHITE = (1.0, 1.0, 1.0)


@pytest.fixture
def drawn(tmp_path):
    """Pixels of a map with lines and what else is given."""

    def pixels(*lines, **what):
        draw_map(tmp_path / "a.png", "t", lines, **what)
        return image.imread(tmp_path / "a.png")

    return pixels


def share_of(pixels, color, tolerance=0.06):
    """Share of the pixels that have a color."""
    return float(np.mean(np.all(np.abs(pixels[..., :3] - np.array(color)) < tolerance, axis=-1)))


def test_lines_are_drawn_in_their_colors_over_a_map_on_white(drawn):
    names = (OPTIMIZED, ODOMETRY, TRUTH, SEGMENT_COLORS[Kind.WHEELS])
    colors = {color: np.array(rgb(color)) / 255.0 for color in names}
    lines = [Line("", circle(8.0 + k), color) for k, color in enumerate(colors)]
    pixels, alone = drawn(*lines, path=lines[0].positions), drawn(lines[0])
    assert all(share_of(pixels, color) > 0.001 for color in colors.values())
    assert share_of(pixels, WHITE) > 0.8
    assert [share_of(alone, colors[name]) for name in names[1:]] == [0.0, 0.0, 0.0]
    points = np.random.default_rng(3).uniform(-15.0, 15.0, (20_000, 3))
    assert share_of(drawn(lines[0], points=points), WHITE) < 0.95
    assert share_of(drawn(Line("", np.zeros((1, 3)), "#1f5fd0")), WHITE) > 0.9


def test_a_grid_lies_where_its_origin_says_with_row_0_at_the_bottom(drawn):
    cells = np.zeros((200, 200), np.int8)
    cells[:60] = 100  # a wall along the lowest y
    cells[:, 100:] = np.where(cells[:, 100:] == 0, -1, cells[:, 100:])
    pixels = drawn(Line("", circle(9.0), "#1f5fd0"), grid=(cells, 0.1, (-10.0, -10.0)))[..., 0]
    dark_rows = np.nonzero((np.abs(pixels - 0.15) < 0.03).mean(axis=1) > 0.4)[0]
    assert dark_rows.min() > 0.5 * len(pixels)
    assert (np.abs(pixels - 0.90) < 0.01).mean() > 0.15  # unknown is gray, not white


CONFUSIONS = {  # of linear red, green, blue (Machado et al. 2009)
    "none": np.eye(3),
    "deuteranopia": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
    "protanopia": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
}
TO_LMS = [[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]]  # Oklab (Ottosson 2020)
TO_LAB = [[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]]


@pytest.mark.parametrize("sight", CONFUSIONS)
def test_lines_of_a_run_have_colors_of_their_own_on_white_and_on_black_for_color_blind_readers_too(sight):
    kinds = (
        Kind.DEGENERATE,
        Kind.LOST,
        Kind.CONTRADICTED,
        Kind.WHEELS,
        Kind.OVERLAP,
        Kind.ACCELERATION,
        Kind.LOOPS,
    )
    names = [OPTIMIZED, ODOMETRY, TRUTH, *(SEGMENT_COLORS[kind] for kind in kinds)]
    linear = (np.array([rgb(name) for name in names]) / 255.0) ** 2.2
    seen = np.clip(linear @ np.transpose(CONFUSIONS[sight]), 0.0, 1.0)
    lab = np.cbrt(seen @ np.transpose(TO_LMS)) @ np.transpose(TO_LAB)
    apart = np.linalg.norm(lab[:, None] - lab, axis=-1)[np.triu_indices(len(names), 1)]
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    contrast = np.minimum(1.05 / (luminance + 0.05), (luminance + 0.05) / 0.057)  # to white, to the dark paper
    assert apart.min() > 0.05 and contrast.min() > 2.2, (apart.min(), contrast.min())


@pytest.mark.parametrize("is_upright", [False, True])
def test_ticks_are_round_numbers_where_they_belong_that_do_not_touch(is_upright):
    random, length = np.random.default_rng(4), 150.0 if is_upright else 260.0
    for _ in range(300):
        axis, low = Axis(), random.choice([-1.0, 1.0]) * 10.0 ** random.uniform(-4.0, 6.7)
        size = abs(low) * 10.0 ** random.uniform(-4.0, 1.0)
        axis.limit(low, low + size)
        places, texts = zip(*axis.ticks(length, is_upright=is_upright), strict=True)
        values = np.array([float(text.replace("−", "-")) for text in texts])
        np.testing.assert_allclose(low + np.array(places) * size, values, atol=1e-6 * size)
        steps = np.diff(values)
        np.testing.assert_allclose(steps, steps[:1].sum(), rtol=1e-6)
        sizes = np.array([8.0 if is_upright else width_of(text) for text in texts])
        assert (length * np.diff(places) > 0.5 * (sizes[1:] + sizes[:-1])).all()
        assert len(values) >= (4 if is_upright else 1), (low, size)


@pytest.mark.parametrize(
    ("ends", "shown"),
    [
        ((0.05, 30.0), ["0.05", "0.1", "0.2", "0.5", "1", "2", "5", "10", "20"]),
        ((3.0, 900.0), ["5", "10", "20", "50", "100", "200", "500"]),
        ((0.02, 200.0), ["0.03", "0.1", "0.3", "1", "3", "10", "30", "100"]),
        ((4.0, 11.0), ["4", "5", "6", "7", "8", "9", "10", "11"]),
        ((1.2, 1.9), ["1.2", "1.3", "1.4", "1.5", "1.6", "1.7", "1.8", "1.9"]),
        ((1e-9, 1e9), [f"{10.0**exponent:g}" for exponent in range(-9, 10, 2)]),
    ],
)
def test_a_logarithmic_axis_has_decades_and_where_they_are_few_more(ends, shown):
    axis = Axis(is_logarithmic=True)
    axis.limit(*ends)
    ticks = axis.ticks(200.0, is_upright=True)
    assert [text.replace("−", "-") for _, text in ticks] == shown
    for place, text in ticks:
        assert ends[0] * (ends[1] / ends[0]) ** place == pytest.approx(float(text.replace("−", "-")))


@pytest.mark.parametrize("name", ["", "x", "y"])
def test_what_is_known_of_a_line_is_within_its_axes_and_breaks_where_it_is_not(name):
    x, y = np.array([1.0, 2.0, np.nan, 4.0, 5.0]), np.array([1.0, 10.0, 10.0, 100.0, 3.0])
    figure = Plot(logarithmic=name)
    figure.line(np.stack([x, y], axis=1), "red")
    drawn = re.search(r'<path d="([^"]*)" style="stroke: red', figure.svg())[1]
    assert re.sub(r"[\d. -]", "", drawn) == "MLML"
    places = np.array(re.findall(r"-?[\d.]+", drawn), float).reshape(-1, 2) / figure.extent
    assert (places > 0.0).all() and (places < 1.0).all()
    known = np.isfinite(x)
    for column, (values, is_logarithmic) in enumerate(((x, name == "x"), (-y, name == "y"))):
        shown = np.log(np.abs(values[known])) * np.sign(values[known]) if is_logarithmic else values[known]
        np.testing.assert_allclose(np.corrcoef(shown, places[:, column])[0, 1], 1.0, atol=1e-6)


def test_a_line_of_many_points_is_as_long_as_it_looks_and_ends_where_it_ends():
    angle = np.linspace(0.0, 1.9 * np.pi, 100_000)
    figure = Plot.of_plan(np.full(2, -1.1), np.full(2, 1.1))
    figure.line(np.stack([np.cos(angle), np.sin(angle)], axis=1), "red")
    end = np.array([np.cos(angle[-1]), np.sin(angle[-1])])
    svg = figure.svg()
    assert len(svg) < 150_000
    path = re.search(r'd="(M[^"]*)" style="stroke: red', svg)[1]
    points = np.array(re.findall(r"-?[\d.]+", path), float).reshape(-1, 2)
    off = np.hypot(*(points / figure.extent * 2.2 - 1.1).T) - 1.0
    assert np.abs(off).max() < 1e-4
    np.testing.assert_allclose(points[-1], 129.6 * (1.0 + np.array([1.0, -1.0]) * end / 1.1), atol=0.1)


def test_the_pixels_of_a_map_are_square_and_begin_at_its_corner():
    low, high = np.zeros(3), np.array([13.7, 6.95, 0.0])
    figure = Plot.of_plan(low, high)
    draw_points(figure, np.random.default_rng(0).uniform(low, high, (1000, 3)), low, high, ("#000000",))
    box = re.search(r'<image x="(.*?)" y="(.*?)" width="(.*?)" height="(.*?)"', figure.svg()).groups()
    (x, y, width, height), (rows, columns) = map(float, box), image_in(figure).shape[:2]
    assert width / columns == pytest.approx(height / rows, rel=1e-3)
    assert (x, y + height) == pytest.approx((0.0, figure.extent[1]), abs=0.01)


def image_in(figure):
    """Pixels of the image in the SVG of a figure."""
    return image.imread(BytesIO(b64decode(re.search(r"base64,([^\"]*)", figure.svg())[1])))


@pytest.mark.parametrize("is_downward", [False, True])
def test_an_image_of_a_figure_has_its_colors_and_its_first_row_at_the_lower_corner(is_downward):
    pixels = np.random.default_rng(0).integers(0, 8, (5, 7)).astype(np.uint8)
    palette = palette_of(("ff0000", "00ff00", "0000ff"), 8)
    palette[:, 3] = np.arange(8) * 36
    figure = Plot.of_plan(np.zeros(2), np.array([7.0, 5.0]))
    if is_downward:
        figure.y.limit(5.0, 0.0)
    figure.image(pixels, palette, np.zeros(2), np.array([7.0, 5.0]))
    expected = palette[pixels if is_downward else pixels[::-1]]
    assert np.array_equal(np.rint(255.0 * image_in(figure)).astype(np.uint8), expected)
