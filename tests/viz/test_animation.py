"""The animation of a growing map: what it shows, and that it stays small."""

from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from scanchain.__main__ import main
from scanchain_viz.pictures import animation
from tests.support import made

PATH = (255, 138, 61)


@pytest.fixture(scope="module", params=["office", "town"])
def run(request):
    return made.run(request.param, seconds=6, outputs__error_bars="quick")


def frames_of(path):
    with Image.open(path) as gif:
        frames = []
        for number in range(gif.n_frames):
            gif.seek(number)
            frames.append(np.asarray(gif.convert("RGB")))
        return frames, gif.info


def test_points_and_path_are_added_and_stay(run, tmp_path, capfd):
    assert main(["view", str(run), "--gif", str(tmp_path / "map.gif")]) == 0
    assert capfd.readouterr().out.strip() == str(tmp_path / "map.gif")
    frames, info = frames_of(tmp_path / "map.gif")
    seen = [(frame != frame[0, 0]).any(axis=2) for frame in frames]
    drawn = [np.count_nonzero((frame == PATH).all(axis=2)) for frame in frames]
    assert len(frames) > 5 and info["loop"] == 0 and max(frames[0].shape) <= 720
    assert all(np.count_nonzero(before & ~after) < 60 for before, after in pairwise(seen))  # the head moves on
    assert np.count_nonzero(seen[-1]) > 1.2 * np.count_nonzero(seen[0])
    assert drawn[-1] > 2 * drawn[0]
    heights = {tuple(color) for color in np.unique(frames[-1].reshape(-1, 3), axis=0).tolist()}
    assert (len(heights) > 20) == ("town" in str(run))


def test_a_large_one_has_fewer_frames(run, tmp_path, monkeypatch):
    animation.draw_growing_map(run, tmp_path / "all.gif")
    size = (tmp_path / "all.gif").stat().st_size
    assert size < animation._MOST_BYTES
    monkeypatch.setattr(animation, "_MOST_BYTES", 0.9 * size)
    animation.draw_growing_map(run, tmp_path / "fewer.gif")
    (every, _), (fewer, _) = (frames_of(tmp_path / f"{name}.gif") for name in ("all", "fewer"))
    assert len(fewer) < len(every) and np.array_equal(fewer[-1], every[-1])


@pytest.mark.parametrize(("name", "complaint"), [("map.png", "map.png"), ("no/map.gif", "there is no folder")])
def test_a_file_that_cannot_be_written_is_refused(run, tmp_path, capfd, name, complaint):
    assert main(["view", str(run), "--gif", str(tmp_path / name)]) == 2
    assert complaint in capfd.readouterr().err


def test_a_directory_without_a_map_is_refused(tmp_path, capfd):
    assert main(["view", str(tmp_path), "--gif", str(tmp_path / "map.gif")]) == 2
    assert str(tmp_path) in capfd.readouterr().err
