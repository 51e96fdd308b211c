"""Verification of proposed closures: submaps that agree or do not, and free space that contradicts a match."""

from dataclasses import replace

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import ClosureVerdict, Keyframe, Problem
from scanchain.loops.connectivity import Segments
from scanchain.loops.submaps import Submap, submap_around
from scanchain.loops.verification import Verifier, free_space_agreement
from scanchain.registration import VoxelMap
from tests.support.scenes import configured, square, stored
from tests.support.town import blocked, passage, place_in_the_middle, pose, street


def test_submaps_of_one_place_agree_and_those_of_two_do_not():
    here = place_in_the_middle()
    again = place_in_the_middle(4.0, True)
    truth = lie.inverse(here.anchor.T_odom_lidar) @ again.anchor.T_odom_lidar
    true = Verifier(configured(3)).submap(again, here, truth @ pose(2.0, -0.8, yaw=0.06))
    error = lie.inverse(truth) @ true.match.T_target_source
    assert true.match.converged and true.overlap > 0.6 and true.agreement > 0.9
    assert np.linalg.norm(error[:3, 3]) < 0.1 and lie.rotation_angle(error) < 0.005
    false = Verifier(configured(3)).submap(again, here, truth @ pose(0.0, 9.0))
    assert false.agreement < 0.87


def test_a_wall_in_what_was_seen_as_free_is_held_against_a_match():
    here = place_in_the_middle()
    wall = np.stack(np.meshgrid([6.0], np.linspace(-3, 3, 40), np.linspace(-1, 2, 20)), axis=-1).reshape(-1, 3)
    own = here.points()[::20]
    assert free_space_agreement(here, own, lie.identity(3), 1.0) > 0.75
    assert free_space_agreement(here, wall, lie.identity(3), 1.0) < 0.2


def test_submaps_that_agree_too_little_about_free_space_are_rejected():
    here = place_in_the_middle()
    found = Verifier(configured(3)).submap(here, here, lie.identity(3), min_agreement=1.1)
    assert found.agreement == pytest.approx(1.0, abs=0.02)
    assert found.problem.cause == "free-space agreement < the limit for a recognized place (1.1)"


def cause_between(source, target):
    """The cause for which the true alignment of two submaps is rejected, without its limit; None if accepted."""
    true = lie.between(target.anchor.T_odom_lidar, source.anchor.T_odom_lidar)
    found = Verifier(configured(3)).submap(source, target, true)
    return found.problem and found.problem.cause.partition(" < ")[0]


@pytest.mark.parametrize(("panels", "cause"), [(20, None), (30, "free-space agreement")])
def test_what_blocks_a_street_that_was_seen_free_rejects_a_place_that_fits(panels, cause):
    here = place_in_the_middle()
    there = replace(here, members=blocked(here.members, panels))
    assert cause_between(there, here) == cause_between(here, there) == cause


@pytest.mark.parametrize(("radius_m", "other", "cause"), [(15.0, 5, None), (10.0, 11, "overlap")])
def test_submaps_of_places_apart_are_a_closure_where_they_share_two_fifths(radius_m, other, cause):
    keyframes = passage(street())
    source, target = (submap_around(keyframes, k, radius_m, Segments()) for k in (other, 8))
    assert cause_between(source, target) == cause


def test_a_place_that_is_the_same_all_along_is_rejected_however_well_it_fits():
    rng, along = np.random.default_rng(0), np.random.default_rng(1).uniform(-20.0, 20.0, 9000)
    ground = np.column_stack([along, rng.uniform(-4.0, 4.0, 9000), np.full(9000, -1.7)])
    walls = np.column_stack([along, np.where(along * 1e3 % 2.0 < 1.0, 4.0, -4.0), rng.uniform(-1.7, 3.0, 9000)])
    keyframe = Keyframe(0, 0, 0, stored(np.vstack([ground, walls])), lie.identity(3), 0.0)
    corridor = Submap(keyframe, [keyframe], 18.0)
    assert cause_between(corridor, corridor) == "information"


def verified(points, changes=None, **options):
    """The verification of a scan in a room of 8 m, whose true pose is 0.3 m away from the initial one."""
    config, T = configured(2, changes), lie.pose_2d(0.3, 0.0, 0.0)
    target = VoxelMap(2, config.local_map)
    target.insert(square(4.0), lie.identity(2))
    source = Keyframe(0, 0, 0, stored(lie.transform(lie.inverse(T), points)), lie.identity(2), 0.0)
    return T, Verifier(config).scan(source, target, lie.identity(2), **options)


CORRIDOR = square(4.0)[np.abs(square(4.0)[:, 1]) == 4.0]  # nothing shows the position along it
WITH_CROWD = np.vstack([square(4.0), np.random.default_rng(0).uniform(-1.0, 1.0, (300, 2))])  # a quarter of them


@pytest.mark.parametrize(
    ("points", "changes", "options", "cause"),
    [
        (square(4.0), {}, {}, None),
        (WITH_CROWD, {}, {}, None),
        (WITH_CROWD, {}, {"alone": True}, "overlap < loops.min_overlap"),
        (WITH_CROWD, {"loops.min_overlap": 0.9}, {}, "overlap < loops.min_overlap"),
        (0.8 * square(4.0), {}, {}, "no point has a correspondence in the map"),
        (CORRIDOR, {}, {}, "information < loops.min_information"),
        (CORRIDOR, {}, {"in_map": True}, "information < loops.min_information"),
        (square(4.0), {"loops.min_information": 0.9}, {}, "information < loops.min_information"),
        (square(4.0), {"loops.min_information": 0.9}, {"in_map": True}, None),
        (square(4.0), {"loops.max_radius_m": 0.2}, {}, "distance from the prediction > loops.max_radius_m"),
    ],
)
def test_a_scan_is_accepted_where_it_overlaps_is_determined_and_near_its_initial_pose(
    points, changes, options, cause
):
    T, found = verified(points, changes, **options)
    assert (found.problem and found.problem.cause) == cause
    if cause is None:
        off_m, off_rad = lie.apart(T, found.match.T_target_source)
        assert off_m < 0.01 and off_rad < 0.002


def test_a_problem_of_the_alignment_comes_before_any_other_of_its_closure():
    other = Problem("other", "some other reason")
    _, good = verified(square(4.0))
    _, bad = verified(CORRIDOR)
    assert good.closure(3, 7).verdict is ClosureVerdict.ACCEPTED
    assert [good.closure(3, 7, problem=other).cause, bad.closure(3, 7, problem=other).cause] == [
        "other",
        "information < loops.min_information",
    ]
