"""Points kept in a file: what goes in comes out, and a state that was kept is gone on from."""

import copy
import gc
import os
import pickle
import zlib

import numpy as np
import pytest

from scanchain import Slam, open_log
from scanchain.errors import InputError
from scanchain.point_store import PointStore
from scanchain.processes import resident_mib


def cloud(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32).astype(np.float64)


def test_every_scan_comes_back_as_it_went_in_and_several_at_once():
    store = PointStore(3)
    clouds = [cloud(count, count) for count in (5, 0, 1000, 1)]
    stored = [store.add(points) for points in clouds]
    for points, kept in reversed(list(zip(clouds, stored, strict=True))):
        assert kept.read().dtype == np.float64
        assert np.array_equal(kept.read(), points)
    assert np.array_equal(store.read(3, 1003), np.vstack(clouds)[3:]) and store.rows == 1006


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_a_result_is_pickled_with_its_points_and_lives_without_the_first(office, copied):
    slam = Slam(dimension=2)
    for scan in open_log(office).scans():
        slam.process(scan)
    result = slam.finish()
    again = copied(result)
    expected = [keyframe.points for keyframe in result.keyframes]
    slam.points.close()
    assert again.trajectory.poses.tobytes() == result.trajectory.poses.tobytes() and len(expected) > 3
    for keyframe, points in zip(again.keyframes, expected, strict=True):
        assert np.array_equal(keyframe.points, points)
    assert len({id(keyframe.stored.store) for keyframe in again.keyframes}) == 1


def test_points_stay_out_of_memory_and_the_file_of_a_store_that_nobody_uses_is_closed():
    store, points = PointStore(3), cloud(100_000)
    store.add(points)
    before_mib = resident_mib(os.getpid())
    for _ in range(100):
        store.add(points)
    assert store.rows * 12 / 2**20 > 100.0
    assert resident_mib(os.getpid()) - before_mib < 20.0
    file = store.file
    del store
    gc.collect()
    assert file.closed


def test_a_state_that_was_kept_goes_on_without_what_came_after_it_unless_its_file_lost_points(tmp_path):
    path = tmp_path / "points"
    store = PointStore(3, path)
    kept = store.add(cloud(10, 1))
    store.add(cloud(7, 2))
    store.close()
    again = PointStore(3)
    again.rows, again.crc = kept.count, zlib.crc32(cloud(10, 1).astype(np.float32).tobytes())
    again.reopen(path)
    added = again.add(cloud(3, 3))
    assert np.array_equal(again.read(0, 13), np.vstack([cloud(10, 1), cloud(3, 3)])) and added.first == 10
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(InputError, match="ends before point 13"):
        added.read()
    with pytest.raises(InputError, match="too short or damaged; run without --resume"):
        again.reopen(path)
    with pytest.raises(InputError, match="missing"):
        again.reopen(tmp_path / "none")
