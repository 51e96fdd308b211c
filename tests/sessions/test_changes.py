"""Changes between two maps in one frame: what vanished, appeared, and was not seen."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Keyframe
from scanchain.errors import InputError
from scanchain.maps import SavedPoints
from scanchain.sessions.changes import Changes, Label, Part, _clusters, changes_between
from scanchain.settings import load_settings
from scanchain.simulation.solids import Scenery, Solids
from scanchain_viz.report.maps import _changes_picture
from tests.support.rooms import BOX, CORNER, HIDDEN, part, room


def compared(before: Solids, after: Solids, **options) -> Changes:
    return changes_between(part("a", before), part("b", after), load_settings(2).config, **options)


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
    back = changes_between(after, seen_once, load_settings(2).config)
    near = np.linalg.norm(back.points - HIDDEN, axis=1) < 0.5
    assert near.sum() > 30 and (back.labels[near] == Label.UNKNOWN).all()


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


def seen_in_space(*boxes):
    """A map of six views in space of a hall 12 x 8 m with boxes: (x, y), (length, width), height, yaw."""
    scenery = Scenery()
    scenery.box((6, 4), (14, 10), (-0.2, 0.0))
    for center, size in (((6, 0), (12, 0.2)), ((6, 8), (12, 0.2)), ((0, 4), (0.2, 8)), ((12, 4), (0.2, 8))):
        scenery.box(center, size, (0.0, 2.5))
    for center, size, height_m, yaw_rad in boxes:
        scenery.box(center, size, (0.0, height_m), yaw_rad)
    solids, keyframes = scenery.finish(), []
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 360), np.radians(np.arange(-30.0, 16.0)))
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    for k, x_m in enumerate(np.linspace(1.5, 10.0, 6)):
        T = np.eye(4)
        T[:3, 3] = x_m, 6.7 if k % 2 else 1.2, 1.2
        ranges_m = solids.cast(T[None], np.zeros(len(rays), np.int32), rays, 30.0)
        hit = ranges_m < 29.0
        keyframes.append(Keyframe(k, k, k, SavedPoints(rays[hit] * ranges_m[hit, None], 1.0), T, 2.0 * k))
    return Part("hall", keyframes, np.array([each.T_odom_lidar for each in keyframes]))


def crate(x_m, y_m, yaw_rad=0.0):
    return (x_m, y_m), (1.2, 0.6), 1.0, yaw_rad


def compared_in_space(before, after):
    """The clusters, by the position of their center, to half a meter."""
    maps = seen_in_space(*before), seen_in_space(*after)
    found = changes_between(*maps, load_settings(3).config, voxel_size_m=0.2)
    return {tuple(0.5 * np.round(2.0 * each.center[:2])): each for each in found.clusters}


def test_in_space_an_object_that_moved_is_known_by_its_size_and_has_a_height_and_a_heading():
    post, stool = ((8.0, 5.0), (0.5, 0.5), 1.6, 0.0), ((2.0, 2.0), (0.5, 0.5), 0.6, 0.0)
    found = compared_in_space([crate(5.0, 3.0, 0.5), post], [crate(3.5, 4.5, 2.0), stool])
    assert {at: each.kind for at, each in found.items()} == {
        (5.0, 3.0): "vanished", (3.5, 4.5): "appeared", (8.0, 5.0): "vanished", (2.0, 2.0): "appeared"
    }  # fmt: skip
    gone, come = found[5.0, 3.0], found[3.5, 4.5]
    assert (gone.counterpart, come.counterpart) == (come.number, gone.number)
    assert found[8.0, 5.0].counterpart == found[2.0, 2.0].counterpart == 0
    for cluster, yaw_rad in ((gone, 0.5), (come, 2.0)):
        assert cluster.yaw_rad == pytest.approx(yaw_rad, abs=0.05) and cluster.center[2] == pytest.approx(
            0.5, abs=0.15
        )
        assert cluster.size_m == pytest.approx([1.2, 0.6, 1.0], abs=0.25)


def test_of_two_objects_of_one_size_it_is_not_said_which_moved_where():
    found = compared_in_space([crate(3.0, 3.0), crate(6.0, 5.0)], [crate(4.5, 5.0), crate(7.5, 3.0)])
    assert len(found) == 4 and not any(each.counterpart for each in found.values())


def test_ground_that_rays_grazed_is_no_change_and_what_stands_on_it_is():
    x, y = (each.ravel() for each in np.meshgrid(np.arange(0.0, 4.0, 0.1), np.arange(0.0, 1.0, 0.1)))
    ground = np.column_stack([x, y, np.zeros(len(x))])
    ground_labels = np.where(x < 1.8, Label.SAME, np.where(x < 2.2, Label.VANISHED, Label.SAME))
    panel = np.column_stack([np.full(len(y[x < 1.0]), 3.0), y[x < 1.0], 0.3 + x[x < 1.0]])
    points = np.vstack([ground, panel])
    labels = np.append(ground_labels, np.full(len(panel), Label.VANISHED)).astype(np.uint8)
    of_cluster, clusters = _clusters(points, labels, 0.1, 0.2)
    assert [each.points for each in clusters] == [len(panel)] and not of_cluster[: len(ground)].any()
    raised = points + (labels == Label.VANISHED)[:, None] * [0.0, 0.0, 0.4]  # a shelf in the air
    assert len(_clusters(raised, labels, 0.1, 0.2)[1]) == 2


def test_maps_in_different_frames_are_refused():
    other = part("b", room(), lie.pose_2d(1.0, 0.7, 0.4))
    with pytest.raises(InputError, match="not in one frame"):
        changes_between(part("a", room()), other, load_settings(2).config)


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
