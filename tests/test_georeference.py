"""A trajectory is placed on Earth by fixes half of which may be wrong; they correct drift, and never do harm."""

import numpy as np
import pytest

import scanchain
from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.data import Trajectory
from scanchain.evaluation import absolute_error_of_any_path, pair
from scanchain.georeference import Georeferencing
from scanchain.loops import spread
from tests.support.fixes import drive_of, driven, fixes_along, positions_by, true_positions
from tests.support.scenes import shared_data

CAR = np.eye(4)
DRIFT_RAD_M = 1e-4


def located(drive, fixes, yaw_rad_m=0.0, config=None):
    """Place on Earth, trajectory in the end, and ATE before and after."""
    truth = drive.truth()
    trajectory, graph, chosen = driven(truth, yaw_rad_m)
    found = Georeferencing([fixes], lie.lift(drive.T_base_lidar)[2, :3], config or GraphConfig())
    before, constrained = trajectory, found.constrained(trajectory, graph, chosen)
    if constrained is not None:
        trajectory = Trajectory(truth.stamps_ns, spread(constrained.poses, chosen, before.poses))
    return found.place(trajectory), trajectory, [ate_m(each, truth) for each in (before, trajectory)], found


def ate_m(trajectory, truth):
    return absolute_error_of_any_path(pair(trajectory, truth)).translation_m.rmse


def away_m(place, trajectory, truth):
    """Root mean square of the horizontal error on Earth."""
    errors = positions_by(place, trajectory) - true_positions(truth)
    return float(np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))))


@pytest.mark.parametrize("seed", range(3))
def test_with_multipath_in_half_of_the_fixes_it_is_within_a_meter_and_these_are_named(seed):
    drive = drive_of("town", "rtk-multipath", seed)
    fixes, is_wrong = fixes_along(drive)
    place, trajectory, (before_m, after_m), _ = located(drive, fixes)
    assert 0.35 < is_wrong.mean() < 0.65
    assert away_m(place, trajectory, drive.truth()) < 0.05
    of_place = is_wrong[np.isin(fixes.stamps_ns, place.stamps_ns)]
    assert place.is_rejected[of_place].mean() > 0.95 and place.is_rejected[~of_place].mean() < 0.05
    assert 0.2 < np.sqrt(np.mean(place.innovations[~place.is_rejected] ** 2)) < 1.3
    assert place.innovations[place.is_rejected].min() > place.innovations[~place.is_rejected].max()
    assert after_m == before_m and not place.origin.is_constrained


def test_a_standard_receiver_places_it_within_what_it_states_and_leaves_an_exact_trajectory_as_it_is():
    drive = drive_of("rounds", "standard")
    fixes, _ = fixes_along(drive)
    place, trajectory, (before_m, after_m), _ = located(drive, fixes)
    assert away_m(place, trajectory, drive.truth()) < 2.0 * place.origin.sigma_m < 4.0
    assert after_m == before_m


@pytest.mark.parametrize(("gnss", "least"), [("rtk", 0.1), ("rtk-multipath", 0.4)])
def test_drift_that_exact_fixes_show_is_corrected_and_the_first_pose_stays(gnss, least):
    drive = drive_of("rounds", gnss)
    place, trajectory, (before_m, after_m), _ = located(drive, fixes_along(drive)[0], DRIFT_RAD_M)
    assert place.origin.is_constrained and after_m < least * before_m
    assert np.max(lie.apart(trajectory.poses[0], np.eye(4))) < 0.02
    assert away_m(place, trajectory, drive.truth()) < 1.0


def test_only_the_datum_leaves_drift():
    drive = drive_of("rounds", "rtk")
    fixes = fixes_along(drive)[0]
    place, _, (before_m, after_m), _ = located(drive, fixes, DRIFT_RAD_M, GraphConfig(gnss="datum"))
    assert place is not None and not place.origin.is_constrained and after_m == before_m > 0.5


def test_an_unknown_antenna_is_estimated():
    drive = drive_of("rounds", "rtk")
    (fixes, _), (unknown, _) = fixes_along(drive), fixes_along(drive, is_antenna_known=False)
    place, trajectory, _, _ = located(drive, unknown)
    np.testing.assert_allclose(place.antenna_m[:2], fixes.antenna_m[:2], atol=0.03)
    assert away_m(place, trajectory, drive.truth()) < 0.05


def test_ten_times_as_many_fixes_are_worth_no_more():
    drive = drive_of("rounds", "standard")
    fixes, _ = fixes_along(drive)
    few = fixes._replace(
        **{name: getattr(fixes, name)[::10] for name in ("stamps_ns", "positions", "covariances")}
    )
    many, fewer = (located(drive, each)[0] for each in (fixes, few))
    assert fewer.origin.sigma_m == pytest.approx(many.origin.sigma_m, rel=0.05)


def lying(fixes, name):
    """Fixes that lie."""
    positions, count = fixes.positions.copy(), len(fixes.stamps_ns)
    if name == "late":
        return fixes._replace(stamps_ns=fixes.stamps_ns + 200_000_000)
    if name == "frozen":
        positions[count // 3 :] = positions[count // 3]
    if name == "wandering":
        positions[:, :2] += 1e-6 * np.cumsum(np.random.default_rng(0).standard_normal((count, 2)), axis=0)
    if name == "latitude and longitude swapped":
        positions[:, :2] = (
            positions[:, :2].mean(axis=0) + (positions[:, :2] - positions[:, :2].mean(axis=0))[:, ::-1]
        )
    return fixes._replace(positions=positions)


@pytest.mark.parametrize("gnss", ["rtk", "standard"])
@pytest.mark.parametrize("name", ["late", "frozen", "wandering", "latitude and longitude swapped"])
def test_a_receiver_that_lies_makes_an_exact_trajectory_no_worse(name, gnss):
    drive = drive_of("rounds", gnss, seconds=100.0)
    place, _, (before_m, after_m), found = located(drive, lying(fixes_along(drive)[0], name))
    assert after_m <= max(before_m, 0.001)
    if place is None:
        assert "agree with the trajectory" in found.note


def test_fixes_at_one_place_tell_nothing():
    drive = drive_of("town", "rtk", seconds=20.0)
    fixes, _ = fixes_along(drive)
    noise = 1e-8 * np.random.default_rng(0).standard_normal(fixes.positions.shape)
    still = fixes._replace(positions=fixes.positions[0] + noise)
    truth = drive.truth()
    standing = Trajectory(truth.stamps_ns, np.tile(np.eye(4), (len(truth), 1, 1)))
    found = Georeferencing([still], lie.lift(drive.T_base_lidar)[2, :3], GraphConfig())
    _, graph, chosen = driven(standing)
    assert found.constrained(standing, graph, chosen) is None and found.place(standing) is None
    assert "far enough apart" in found.note


def test_the_receiver_of_kitti_places_it_and_does_not_bend_it():
    log = scanchain.open_log(
        [shared_data("3d/kitti_0005_first60.mcap"), shared_data("3d/kitti_0005_first60_imu_gnss.mcap")]
    )
    slam = scanchain.Slam(dimension=3)
    for scan in log:
        slam.process(scan)
    result = slam.finish()
    place = result.georeference
    assert any("GNSS: 0 % of 59 fixes rejected" in note for note in result.sensor_notes)
    assert not place.origin.is_constrained and not result.graph.is_of_origin.any()
    moved = place.enu(result.trajectory).positions[-1]
    track = place.geodesy.enu(log[59].fixes.positions if log[59].fixes else np.zeros((1, 3)))[0]
    assert np.linalg.norm((moved - track)[:2]) < 2.0
