"""A saved map: as exact as it says, and refused by its file where anything in it was changed."""

from dataclasses import replace

import numpy as np
import pytest

import scanchain
from scanchain.data import Keyframe
from scanchain.errors import InputError
from scanchain.maps import Edges, SavedMap, SavedPoints, Session, open_saved_map, write_saved_map
from scanchain.slam import SlamResult


@pytest.fixture
def written(tmp_path):
    """A map of three keyframes with two edges, in the folder map; the second has a far return."""
    near, far = np.array([[1.2345, -2.0], [0.0, 3.3333]]), np.array([[5e4, 0.0]])
    keyframes = [
        Keyframe(k, 4 * k, 10 * k, SavedPoints(points, 1.0), np.eye(3) * [1, 1, 1 + k / 3], 0.7 * k, 1.5)
        for k, points in enumerate((near, np.vstack([near, far]), near))
    ]
    pairs, eyes = np.array([[0, 1], [1, 2]]), np.tile(np.eye(3), (2, 1, 1))
    edges = Edges(pairs, eyes, 3.0 * eyes, np.array([False, True]), np.array([1.0, 0.5]))
    session, numbers = Session("made up", 0, 20, 3), np.zeros(3, int)
    saved = SavedMap(tmp_path / "map", 2, tuple(keyframes), numbers, (session,), edges)
    write_saved_map(saved)
    return tmp_path, saved


def test_a_saved_map_holds_its_keyframes_to_the_millimeter_and_the_poses_to_the_bit(written):
    folder, before = written
    saved, edges = open_saved_map(folder), before.edges
    assert saved.sessions == (Session("made up", 0, 20, 3),)
    for name in Edges.__match_args__:
        assert np.array_equal(getattr(saved.edges, name), getattr(edges, name))
    for old, new in zip(before.keyframes, saved.keyframes, strict=True):
        np.testing.assert_allclose(new.points, old.points, atol=1e-3)  # one far return makes none coarse
        assert np.array_equal(new.T_odom_lidar, old.T_odom_lidar)
        assert replace(new, stored=None, T_odom_lidar=None) == replace(old, stored=None, T_odom_lidar=None)
    assert edges.among(np.array([2, 1])).pairs.tolist() == [[1, 0]]


@pytest.mark.parametrize("name", ["keyframes.npz", "edges.npz", "points.i16"])
def test_a_file_that_is_cut_off_missing_or_has_a_flipped_bit_is_refused_by_its_name(written, name):
    file = written[0] / "map" / name
    whole = file.read_bytes()
    flipped = np.random.default_rng(0).integers(len(whole), size=20).tolist()
    for data in (whole[:-7], *(whole[:k] + bytes([whole[k] ^ 0x10]) + whole[k + 1 :] for k in flipped)):
        file.write_bytes(data)
        with pytest.raises(InputError, match=f"{name}: is damaged or cut off: .*; make the map again"):
            open_saved_map(written[0])
    file.unlink()
    with pytest.raises(InputError, match=f"{name}: cannot be read"):
        open_saved_map(written[0])


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('"version": 3', '"version": 1', r"is of version 1, this scanchain reads 3; make the map again"),
        ("{", "", r"map.json: cannot be read"),
    ],
)
def test_an_index_of_another_version_or_without_sense_is_refused(written, before, after, message):
    index = written[0] / "map" / "map.json"
    index.write_text(index.read_text().replace(before, after))
    with pytest.raises(InputError, match=message):
        open_saved_map(written[0])


def test_points_out_of_this_world_are_refused_whatever_the_checksums_say(written):
    folder, saved = written
    stored = SavedPoints(np.array([[1e300, 0.0]]), 1.0)
    keyframes = (replace(saved.keyframes[0], stored=stored), *saved.keyframes[1:])
    write_saved_map(replace(saved, folder=folder / "far", keyframes=keyframes))
    with pytest.raises(InputError, match=r"is not as scanchain writes it \(step_m reaches"):
        open_saved_map(folder / "far")


def test_a_folder_without_a_map_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"holds no map \(map/map.json\); give the directory of a finished run"):
        open_saved_map(tmp_path)


def test_the_poses_of_all_keyframes_are_computed_a_few_times_not_once_for_each(office, tmp_path, monkeypatch):
    """Each time takes memory for all of them, which views of one pose would keep."""
    poses, asked = SlamResult.T_world_keyframes.fget, []
    monkeypatch.setattr(SlamResult, "T_world_keyframes", property(lambda result: asked.append(0) or poses(result)))
    scanchain.run(office, tmp_path / "run", recording=False)
    assert 0 < len(asked) < len(open_saved_map(tmp_path / "run").keyframes)
