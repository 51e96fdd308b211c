import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import scanchain
from scanchain import lie
from scanchain.__main__ import main
from scanchain.data import Keyframe
from scanchain.errors import InputError
from scanchain.logs.formats.clouds import read_ply
from scanchain.maps import Edges, SavedMap, SavedPoints, Session, write_saved_map
from scanchain.sessions.changes import Changes, Label, Part, changes_between
from scanchain.sessions.joining import Joined
from scanchain.sessions.merged_map import MergedMap, updated
from scanchain.settings import load_settings
from scanchain.simulation.solids import Scenery, Solids
from scanchain_viz.report.maps import _changes_picture, _cluster_grid

NO_EDGES = Edges(np.empty((0, 2), int), *np.empty((2, 0, 3, 3)), np.empty(0, bool), np.empty(0))
BOX, HIDDEN = (5.0, 3.0), (8.0, 6.5)  # the first stands free, the second behind a wall
CORNER = SavedPoints(np.random.default_rng(0).uniform(-0.3, 0.3, (200, 2)), 1.0)  # of what stands there


def room(*boxes: tuple[float, float], edge_m: float = 0.6) -> Solids:
    """12 x 8 m, with a wall that hides its far corner, a cupboard, and boxes."""
    scenery = Scenery()
    for center, size in (((6, 0), (12, 0.2)), ((6, 8), (12, 0.2)), ((0, 4), (0.2, 8)), ((12, 4), (0.2, 8))):
        scenery.box(center, size, (0.0, 2.5))
    scenery.box((8.5, 5.0), (7.0, 0.2), (0.0, 2.5))
    scenery.box((2.0, 6.0), (1.2, 0.7), (0.0, 2.5))
    for center in boxes:
        scenery.box(center, (edge_m, edge_m), (0.0, 2.5))
    return scenery.finish()


def hall() -> Solids:
    """Another place: 20 x 4 m with three pillars."""
    scenery = Scenery()
    for center, size in (((6, 0), (20, 0.2)), ((6, 4), (20, 0.2)), ((-4, 2), (0.2, 4)), ((16, 2), (0.2, 4))):
        scenery.box(center, size, (0.0, 2.5))
    for x in (-1.0, 5.0, 12.5):
        scenery.box((x, 2.8), (0.8, 0.8), (0.0, 2.5))
    return scenery.finish()


def part(name: str, solids: Solids, T_map_room=None, count: int = 8) -> Part:
    """A map of views along the room, in the plane."""
    angle = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    directions = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(720)])
    T_map_room = lie.identity(2) if T_map_room is None else T_map_room
    keyframes, poses = [], []
    for k, x in enumerate(np.linspace(1.5, 10.0, count)):
        lidar = np.eye(4)
        lidar[:3, 3] = x, 1.5, 0.3
        ranges_m = solids.cast(lidar[None], np.zeros(720, np.int32), directions, 30.0)
        pose = T_map_room @ lie.pose_2d(float(x), 1.5, 0.0)
        keyframes.append(Keyframe(k, k, k, SavedPoints(directions[:, :2] * ranges_m[:, None], 1.0), pose, 1.2 * k))
        poses.append(pose)
    return Part(name, keyframes, np.array(poses))


def compared(before: Solids, after: Solids, **options) -> Changes:
    return changes_between(part("a", before), part("b", after), load_settings(2).config, **options)


def saved(folder: Path, *parts: Part) -> Path:
    """A map of one or several sessions, as a run leaves it."""
    keyframes = tuple(keyframe for each in parts for keyframe in each.keyframes)
    numbers = np.repeat(np.arange(len(parts)), [len(each.keyframes) for each in parts])
    sessions = tuple(Session(each.name, 0, 9, len(each.keyframes)) for each in parts)
    write_saved_map(SavedMap(folder / "map", 2, keyframes, numbers, sessions, NO_EDGES))
    return folder


def test_what_moved_vanished_where_it_was_and_appeared_where_it_is():
    found = compared(room(BOX), room((3.0, 3.5)))
    assert {(each.kind, *np.round(each.center)) for each in found.clusters} == {
        ("vanished", 5.0, 3.0), ("appeared", 3.0, 3.0)
    }  # fmt: skip
    for cluster in found.clusters:
        assert 0.55 < cluster.size_m[0] < 0.8
        on = found.points[found.of_cluster == cluster.number]
        assert len(on) == cluster.points
        assert (found.labels[found.of_cluster == cluster.number] == Label[cluster.kind.upper()]).all()


def test_nothing_is_named_where_nothing_changed():
    found = compared(room(BOX), room(BOX))
    assert found.clusters == ()
    assert found.agreement == 1.0


def test_what_the_other_map_did_not_see_is_unknown():
    before, after = part("a", room(BOX)), part("b", room(), count=3)
    hidden = Keyframe(8, 8, 8, CORNER, before.poses[0], 20.0)
    there = lie.pose_2d(*HIDDEN, 0.0)
    seen_once = Part("a", [*before.keyframes, hidden], np.concatenate([before.poses, there[None]]))
    found = changes_between(seen_once, after, load_settings(2).config)
    near = np.linalg.norm(found.points - HIDDEN, axis=1) < 0.5
    assert near.sum() > 30
    assert (found.labels[near] == Label.UNKNOWN).all()
    assert [each.kind for each in found.clusters] == ["vanished"]


def test_what_is_smaller_than_asked_for_is_unknown():
    found = compared(room(BOX), room(), min_size_m=2.0)
    assert found.clusters == ()
    assert not (found.labels == Label.VANISHED).any()


def test_legs_of_a_table_are_one_change_and_a_post_alone_is_unknown():
    legs = [(4.2, 2.6), (5.0, 2.6), (4.2, 3.2), (5.0, 3.2)]
    found = compared(room(*legs, edge_m=0.06), room())
    assert [each.kind for each in found.clusters] == ["vanished"]
    assert np.abs(found.clusters[0].center - [4.6, 2.9]).max() < 0.1
    assert compared(room(legs[0], edge_m=0.06), room()).clusters == ()


def test_maps_in_different_frames_are_refused():
    other = part("b", room(), lie.pose_2d(1.0, 0.7, 0.4))
    with pytest.raises(InputError, match="not in one frame"):
        changes_between(part("a", room()), other, load_settings(2).config)


def test_the_command_writes_labels_a_table_and_pictures(tmp_path, capsys):
    a, b = saved(tmp_path / "a", part("a", room(BOX))), saved(tmp_path / "b", part("b", room((3.0, 3.5))))
    assert main(["changes", str(a), str(b), "--aligned", "--out", str(tmp_path / "ab")]) == 0
    assert "1 cluster" in capsys.readouterr().out
    names = {path.name for path in (tmp_path / "ab").iterdir()}
    assert names == {
        "changes.ply", "changes.csv", "changes.parquet", "summary.txt", "metrics.json", "report.html",
        "recording.rrd", "run.json",
    }  # fmt: skip
    cloud = read_ply(tmp_path / "ab" / "changes.ply")
    assert set(cloud["label"]) >= {Label.SAME, Label.APPEARED, Label.VANISHED}
    with (tmp_path / "ab" / "changes.csv").open() as file:
        assert [row["kind"] for row in csv.DictReader(file)] == sorted(("appeared", "vanished"), reverse=True)


def test_boxes_in_the_plan_carry_the_numbers_of_the_table_which_has_no_empty_column(tmp_path):
    a, b = saved(tmp_path / "a", part("a", room(BOX))), saved(tmp_path / "b", part("b", room((3.0, 3.5))))
    found = scanchain.changes(a, b, tmp_path / "ab", T_earlier_later=lie.identity(2))
    page = (tmp_path / "ab" / "report.html").read_text()
    for number in ("1", "2"):
        assert page.count(f'text-anchor="start">{number}</text>') == 4  # wide, narrow, and in two close-ups
    assert "counterpart" not in page
    moved = replace(found, clusters=(replace(found.clusters[0], counterpart=2), found.clusters[1]))
    grid = _cluster_grid(moved)
    assert grid.heads[-1].text == "counterpart" and [row.cells[-1] for row in grid.rows] == ["2", ""]


def test_a_pixel_of_the_plan_is_a_voxel_of_the_comparison(tmp_path, monkeypatch):
    edges_m = []
    monkeypatch.setattr(
        "scanchain_viz.pictures.figure.Plot.image",
        lambda _, pixels, palette, low, high: edges_m.append((high - low[:2]) / pixels.shape[::-1]),
    )
    found = compared(room(BOX), room((3.0, 3.5)))
    points = lie.lift_points(found.points)
    _changes_picture(points, found, points.min(axis=0), points.max(axis=0))
    assert len(edges_m) > 2 and np.allclose(edges_m, 0.05)


def test_a_given_transform_brings_the_later_map_into_the_frame_of_the_earlier(tmp_path):
    T = lie.pose_2d(2.0, -1.0, np.pi / 2)
    a = saved(tmp_path / "a", part("a", room(BOX)))
    b = saved(tmp_path / "b", part("b", room(), lie.inverse(T)))
    found = scanchain.changes(a, b, tmp_path / "ab", T_earlier_later=T, recording=False)
    assert [each.kind for each in found.clusters] == ["vanished"]
    assert main(["changes", str(a), str(b), "--transform", "2,-1,90", "--out", str(tmp_path / "again")]) == 0
    assert (tmp_path / "again" / "changes.csv").read_bytes() == (tmp_path / "ab" / "changes.csv").read_bytes()


def test_the_newest_session_of_a_merged_map_is_compared_with_those_before(tmp_path):
    merged = saved(tmp_path / "m", part("monday", room(BOX)), part("friday", room()))
    found = scanchain.changes(merged, None, tmp_path / "out", recording=False)
    assert found.names == ("monday", "friday")
    assert [each.kind for each in found.clusters] == ["vanished"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["A"], "has one session"),
        (["A", "B"], "is not found in"),
        (["A", "B", "--transform", "1,2"], "give X,Y,YAW"),
        (["A", "B", "--transform", "1,2,0", "--aligned"], "give one of them"),
        (["A", "none"], "holds no map"),
        (["A", "empty"], "has no keyframe"),
        (["A", "B", "--aligned", "--force", "--out", "A"], "is one of the maps"),
        (["A", "B", "--aligned", "--force", "--out", "B"], "is one of the maps"),
    ],
)
def test_what_cannot_be_compared_is_refused_and_leaves_the_maps_as_they_were(tmp_path, capsys, words, message):
    saved(tmp_path / "A", part("a", room(BOX), count=3))
    saved(tmp_path / "B", part("b", hall(), lie.pose_2d(70.0, 0.0, 1.0), count=3))
    saved(tmp_path / "empty", Part("empty", [], np.empty((0, 3, 3))))
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    words = [str(tmp_path / word) if word in ("A", "B", "none", "empty") else word for word in words]
    assert main(["changes", "--out", str(tmp_path / "out"), *words]) == 2
    assert message in capsys.readouterr().err
    assert before == {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}


def test_a_comparison_names_both_maps_and_is_no_run_to_check_or_draw(tmp_path, capsys):
    a, b = saved(tmp_path / "a", part("a", room(BOX))), saved(tmp_path / "b", part("b", room()))
    scanchain.changes(a, b, tmp_path / "ab", T_earlier_later=lie.identity(2), recording=False)
    made = json.loads((tmp_path / "ab" / "run.json").read_text())
    assert [log["path"] for log in made["logs"]] == [str(a / "map"), str(b / "map")]
    assert made["command"] == []  # not that of the program that called it
    assert main(["check", str(tmp_path / "ab")]) == 2
    assert "name a directory of scanchain run" in capsys.readouterr().err
    assert main(["view", str(tmp_path / "ab"), "--png", str(tmp_path / "ab.png")]) == 2
    assert "open report.html" in capsys.readouterr().err


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
