import numpy as np
import pytest

from scanchain import lie
from scanchain.verdict import Kind, Stretch
from scanchain.viz.pictures.run import GridPicture, draw_map

image = pytest.importorskip("matplotlib.image")


def circle(radius_m, dimension=2):
    twists = np.zeros((100, 3 if dimension == 2 else 6))
    twists[:, -1] = np.linspace(0.0, 1.9 * np.pi, 100)
    arm = np.eye(dimension + 1)
    arm[0, -1] = radius_m
    return lie.exp(twists) @ arm


def share_of(pixels, color, tolerance=0.06):
    """Share of the pixels that have a color."""
    return float(np.mean(np.all(np.abs(pixels[..., :3] - np.array(color)) < tolerance, axis=-1)))


def test_ways_are_drawn_in_their_colors_on_white(tmp_path):
    draw_map(
        tmp_path / "a.png", title="t", optimized=circle(10.0), odometry=circle(12.0), ground_truth=circle(8.0)
    )
    pixels = image.imread(tmp_path / "a.png")
    for color in ((0.122, 0.373, 0.816), (0.878, 0.482, 0.0), (0.878, 0.149, 0.62)):
        assert share_of(pixels, color) > 0.001
    assert share_of(pixels, (1.0, 1.0, 1.0)) > 0.8


def test_stretches_to_check_are_marked_on_their_trajectory(tmp_path):
    stretches = (Stretch(Kind.WHEELS, 10, 30, 21, 1.0, 3.0, 0.7), Stretch(Kind.WHEELS, 60, 60, 1, 6.0, 6.0))
    draw_map(tmp_path / "a.png", title="t", optimized=circle(10.0), stretches=stretches)
    draw_map(tmp_path / "b.png", title="t", optimized=circle(10.0))
    pink = (0.839, 0.188, 0.561)
    marked, plain = (share_of(image.imread(tmp_path / name), pink) for name in ("a.png", "b.png"))
    assert marked > 0.001 and plain == 0.0


def test_without_odometry_and_ground_truth_only_one_way_is_drawn(tmp_path):
    draw_map(tmp_path / "a.png", title="t", optimized=circle(10.0))
    assert share_of(image.imread(tmp_path / "a.png"), (0.878, 0.482, 0.0)) == 0.0


def test_one_far_outlier_does_not_shrink_the_map(tmp_path):
    rng = np.random.default_rng(2)
    points = rng.uniform(-10.0, 10.0, (5000, 2))
    draw_map(tmp_path / "a.png", title="t", optimized=circle(10.0), points=points)
    draw_map(tmp_path / "b.png", title="t", optimized=circle(10.0), points=np.vstack([points, [[4000.0, 0.0]]]))
    blue = (0.122, 0.373, 0.816)
    near, far = (share_of(image.imread(tmp_path / name), blue) for name in ("a.png", "b.png"))
    assert far == pytest.approx(near, rel=0.1)


def test_a_grid_lies_where_its_origin_says_with_row_0_at_the_bottom(tmp_path):
    cells = np.zeros((200, 200), np.int8)
    cells[:60] = 100  # a wall along the lowest y
    cells[:, 100:] = np.where(cells[:, 100:] == 0, -1, cells[:, 100:])
    grid = GridPicture(cells, 0.1, (-10.0, -10.0))
    draw_map(tmp_path / "a.png", title="t", optimized=circle(9.0), grid=grid)
    pixels = image.imread(tmp_path / "a.png")[..., 0]
    dark_rows = np.nonzero((np.abs(pixels - 0.15) < 0.03).mean(axis=1) > 0.4)[0]
    assert dark_rows.min() > 0.5 * len(pixels)
    assert (np.abs(pixels - 0.90) < 0.01).mean() > 0.15  # unknown is gray, not white


def test_a_3d_map_is_drawn_from_above(tmp_path):
    points = np.random.default_rng(3).uniform(-15.0, 15.0, (20_000, 3))
    draw_map(tmp_path / "a.png", title="t", optimized=circle(10.0, dimension=3), points=points)
    assert share_of(image.imread(tmp_path / "a.png"), (1.0, 1.0, 1.0)) < 0.95


def test_a_run_without_any_scan_gives_an_empty_sheet_and_no_error(tmp_path):
    draw_map(tmp_path / "a.png", title="t", optimized=np.empty((0, 3, 3)))
    assert (tmp_path / "a.png").stat().st_size > 0


def test_a_picture_that_cannot_be_drawn_leaves_the_old_one(tmp_path, monkeypatch):
    def fail(figure, file, **_):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    (tmp_path / "a.png").write_bytes(b"old")
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", fail)
    with pytest.raises(OSError, match="No space"):
        draw_map(tmp_path / "a.png", title="t", optimized=circle(10.0))
    assert (tmp_path / "a.png").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1
