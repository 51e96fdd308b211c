"""The map of several sessions: their names, trajectories and frame, and what an update removes from it."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from scanchain import Trajectory, lie, write_tum
from scanchain.data import Keyframe
from scanchain.maps import Edges, SavedMap, Session
from scanchain.sessions.changes import Part
from scanchain.sessions.joining import Joined
from scanchain.sessions.merged_map import MergedMap, merged_map, session_names, updated
from scanchain.settings import load_settings
from tests.support.rooms import BOX, CORNER, HIDDEN, hall, map_of, part, room
from tests.support.scenes import configured

NO_EDGES = Edges(np.empty((0, 2), int), *np.empty((2, 0, 3, 3)), np.empty(0, bool), np.empty(0))


def test_runs_of_equal_names_get_names_that_differ():
    noon = map_of(Path("noon"), part("noon", room()))
    assert session_names([noon, noon, noon], [1, 0, 2]) == [["noon-2"], ["noon"], ["noon-3"]]


def test_sessions_are_in_the_frame_of_the_first_map_with_the_motion_of_their_scans_and_in_order_of_time(tmp_path):
    rng = np.random.default_rng(2)
    maps, scans = [], []
    for number, begin_ns in enumerate((5000, 1000)):
        saved = map_of(tmp_path / f"run-{number}" / "map", part(str(number), room(), lie.exp(rng.normal(size=3))))
        poses = np.repeat(saved.poses, 3, axis=0) @ lie.exp(rng.normal(0.0, 0.2, (24, 3)))
        poses[::3] = saved.poses
        scans.append(Trajectory(begin_ns + np.arange(24), poses))
        keyframes = [
            replace(each, scan_index=3 * k, stamp_ns=begin_ns + 3 * k) for k, each in enumerate(saved.keyframes)
        ]
        sessions = (Session(str(number), begin_ns, begin_ns + 23, 8),)
        maps.append(replace(saved, keyframes=tuple(keyframes), sessions=sessions))
        (tmp_path / f"run-{number}").mkdir()
        write_tum(tmp_path / f"run-{number}" / "trajectory.tum", Trajectory(scans[-1].stamps_ns, lie.lift(poses)))
    motions = lie.exp(rng.normal(size=(2, 3)))
    poses = np.concatenate([T @ saved.poses for T, saved in zip(motions, maps, strict=True)])
    joined = Joined((0, 1), (*maps[0].keyframes, *maps[1].keyframes), np.repeat([0, 1], 8), NO_EDGES)
    merged = merged_map(
        joined.placed(poses), maps, [["late"], ["early"]], configured(2, {"loops.refine": False}),
        folder=tmp_path / "map", first=0, held=-1,
    )  # fmt: skip
    assert [session.name for session in merged.saved.sessions] == ["early", "late"]
    assert merged.saved.session.tolist() == [1] * 8 + [0] * 8
    assert np.allclose(merged.saved.poses[:8], maps[0].poses)
    T_late_early = lie.inverse(motions[0]) @ motions[1]
    for trajectory, T, given in zip(merged.trajectories, (T_late_early, np.eye(3)), scans[::-1], strict=True):
        assert np.array_equal(trajectory.stamps_ns, given.stamps_ns)
        assert np.allclose(trajectory.poses, T @ given.poses, atol=1e-7)


def updated_rooms(*parts: Part):
    """Sessions of 8 keyframes each, brought up to date."""
    keyframes = [replace(k, stamp_ns=100 * n + k.stamp_ns) for n, each in enumerate(parts) for k in each.keyframes]
    numbers = np.repeat(np.arange(len(parts)), [len(each.keyframes) for each in parts])
    sessions = tuple(Session(each.name, 100 * n, 100 * n + 9, 8) for n, each in enumerate(parts))
    none = np.zeros(len(keyframes), np.int64)
    merged = SavedMap(Path("map"), 2, tuple(keyframes), numbers, sessions, NO_EDGES)
    joined = Joined((0,), tuple(keyframes), none, NO_EDGES)
    return keyframes, updated(MergedMap(joined, merged, (), none), load_settings(2).config)


def test_what_newer_sessions_saw_through_is_removed_from_older_ones_and_nothing_else():
    before, after = updated_rooms(part("monday", room(BOX)), part("tuesday", room(BOX)), part("friday", room()))
    for k, (old, new) in enumerate(zip(before, after.saved.keyframes, strict=True)):
        away = np.abs(lie.transform(old.T_odom_lidar, old.points) - BOX)
        is_box = (away < 0.32).all(axis=1) & (k < 16)
        assert np.array_equal(new.points, old.points[~is_box])
        assert after.removed[k] == is_box.sum()
    assert after.removed[:8].sum() > 100
    assert after.warnings == ()


def test_what_came_stays_and_what_no_newer_session_saw_stays():
    _, after = updated_rooms(part("monday", room((8.0, 3.0))), part("friday", room(BOX, (8.0, 3.0))))
    assert after.removed.sum() == 0
    corner = Keyframe(0, 0, 5, CORNER, lie.identity(2), 0.0)
    hidden = part("monday", room(BOX))
    there = Part("monday", [*hidden.keyframes, replace(corner, T_odom_lidar=lie.pose_2d(*HIDDEN, 0.0))],
                 np.concatenate([hidden.poses, lie.pose_2d(*HIDDEN, 0.0)[None]]))  # fmt: skip
    _, after = updated_rooms(there, part("friday", room()))
    assert after.removed[8] == 0
    assert len(after.saved.keyframes[8].points) == 200


def test_a_session_that_shares_no_view_removes_nothing_and_is_named():
    _, after = updated_rooms(part("monday", room(BOX)), part("friday", hall(), lie.pose_2d(70.0, 0.0, 1.0)))
    assert after.removed.sum() == 0
    assert [warning.partition(":")[0] for warning in after.warnings] == ["friday"]
