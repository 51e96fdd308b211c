"""Changes between two maps in one frame: what vanished, appeared, and was not seen."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Keyframe
from scanchain.errors import InputError
from scanchain.sessions.changes import Changes, Label, Part, changes_between
from scanchain.settings import load_settings
from scanchain.simulation.solids import Solids
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
