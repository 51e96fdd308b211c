"""Rays start at the lidar that measured them, also where a scan holds points of two lidars."""

from dataclasses import replace

import numpy as np
import pytest

import scanchain
from scanchain.config import MapsConfig
from scanchain.data import Keyframe, OtherPoints, RaySpan, Scan
from scanchain.errors import InputError
from scanchain.loops.evidence import compared
from scanchain.maps import Edges, SavedMap, SavedPoints, Session, open_saved_map, write_saved_map
from scanchain.runs.results import grid_of, views_of
from scanchain.sessions.merged_map import RemainingPoints
from tests.support.scenes import configured

ASIDE = np.array([0.0, 4.0])  # of the second lidar, which sees the wall behind the pillar
PILLAR = np.column_stack([np.full(9, 5.0), np.linspace(-0.4, 0.4, 9)])
WALL = np.column_stack([np.full(71, 10.0), np.linspace(-3.0, 4.0, 71)])
NORTH = np.column_stack([np.linspace(-4.0, 9.0, 131), np.full(131, 6.0)])


def keyframe(points, spans=()):
    return Keyframe(0, 0, 0, SavedPoints(points, 1.0, spans), np.eye(3), 0.0)


def two_lidars(with_origins):
    """What the first lidar sees to the north, and the second one of the wall, past the pillar."""
    spans = RaySpan(np.zeros(2), len(NORTH)), RaySpan(ASIDE, len(WALL))
    return keyframe(np.vstack([NORTH, WALL]), spans if with_origins else ())


@pytest.mark.parametrize("with_origins", [True, False])
def test_what_the_second_lidar_sees_past_does_not_contradict(with_origins):
    agreeing, contradicting = compared([two_lidars(with_origins)], [keyframe(np.vstack([PILLAR, NORTH]))])
    assert agreeing > 100 and (contradicting == 0) == with_origins


@pytest.mark.parametrize("with_origins", [True, False])
def test_the_grid_is_free_along_the_rays_there_were(with_origins):
    grid = grid_of([two_lidars(with_origins)], np.eye(3)[None], MapsConfig(grid_resolution_m=0.1))
    column, row = ((PILLAR[4] - grid.origin_m) / 0.1).astype(int)
    assert (grid.drawn[row, column] == 0) == with_origins
    assert len(list(views_of([two_lidars(with_origins)], np.eye(3)[None], configured(2)))) == 1 + with_origins


def test_spans_of_chosen_points_are_those_of_a_label_for_each():
    chosen = np.random.default_rng(0)
    for _ in range(50):
        counts = chosen.integers(0, 9, 4)
        spans = tuple(RaySpan(np.full(2, k), int(count)) for k, count in enumerate(counts))
        kept = chosen.random(counts.sum()) < 0.5
        expected = [int((np.repeat(np.arange(4), counts)[kept] == k).sum()) for k in range(4)]
        assert [span.rays for span in RaySpan.among(spans, np.flatnonzero(kept))] == expected
        remaining = RemainingPoints(SavedPoints(np.zeros((counts.sum(), 2)), 1.0, spans), kept)
        assert [span.rays for span in remaining.spans] == expected


def test_origins_go_from_the_scan_into_keyframes_and_saved_maps(tmp_path):
    slam = scanchain.Slam(dimension=2)
    for k in range(8):
        moved = np.array([0.3 * k, 0.0])
        others = (OtherPoints(np.float32(WALL - moved), np.zeros(len(WALL), np.float32), ASIDE),)
        slam.process(replace(Scan.of(np.vstack([NORTH, PILLAR]) - moved, 0.1 * k), others=others))
    result = slam.finish()
    edges = Edges(np.empty((0, 2), int), np.empty((0, 3, 3)), np.empty((0, 3, 3)), np.empty(0, bool), np.empty(0))
    session, count = Session("made up", 0, 1, len(result.keyframes)), len(result.keyframes)
    write_saved_map(SavedMap(tmp_path / "map", 2, result.keyframes, np.zeros(count, int), (session,), edges))
    saved = open_saved_map(tmp_path).keyframes
    for each, again in zip(result.keyframes, saved, strict=True):
        assert [(*span.origin, span.rays) for span in again.stored.spans] == [
            (*span.origin, span.rays) for span in each.stored.spans
        ]
        (_, own), (T, seen) = each.views(np.eye(3))
        np.testing.assert_array_equal(T[:2, 2], ASIDE)
        np.testing.assert_allclose(np.vstack([own, seen + ASIDE]), each.points, atol=1e-12)
        assert len(seen) == each.stored.spans[1].rays > 50


@pytest.mark.parametrize("counts", [(-1, 3), (1, 2), (0, 0)])
def test_spans_that_are_not_those_of_the_points_are_refused(tmp_path, counts):
    spans = tuple(RaySpan(np.zeros(2), count) for count in counts)
    edges = Edges(np.empty((0, 2), int), np.empty((0, 3, 3)), np.empty((0, 3, 3)), np.empty(0, bool), np.empty(0))
    session, keyframes = Session("made up", 0, 1, 1), (keyframe(WALL[:2], spans),)
    write_saved_map(SavedMap(tmp_path / "map", 2, keyframes, np.zeros(1, int), (session,), edges))
    with pytest.raises(InputError, match="spans"):
        open_saved_map(tmp_path)


def test_an_origin_that_is_none_is_refused():
    with pytest.raises(InputError, match="origin"):
        replace(Scan.of(WALL, 0.0), origin=np.zeros(3))
    with pytest.raises(InputError, match="origin"):
        replace(Scan.of(WALL, 0.0), origin=np.array([0.0, np.nan]))
