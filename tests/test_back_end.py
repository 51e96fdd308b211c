"""The back end takes keyframes with constraints, whatever measured them."""

from itertools import accumulate

import numpy as np
import pytest

from scanchain import lie
from scanchain.back_end import BackEnd, Constraint
from scanchain.data import Keyframe, KeyframeErrors
from scanchain.graph.factors import ORIGIN, Odometry, RobustPosition
from tests.support.scenes import configured, stored

NO_ERRORS = KeyframeErrors(1.0, np.zeros((3, 3)), 0.0)
POINTS = stored(np.random.default_rng(0).uniform(-5.0, 5.0, (50, 2)))


def fed(odometry, constraints, **options):
    """The back end after these keyframes; constraints(k) are those beyond the motion to keyframe k."""
    back_end = BackEnd(configured(2, {"loops.enabled": False}), 2, **options)
    for k, T_odom_lidar in enumerate(odometry):
        motion = [
            Constraint(Odometry(), k - 1, lie.between(odometry[k - 1], T_odom_lidar), np.diag([100.0, 100.0, 1e5]))
        ]
        keyframe = Keyframe(k, k, k * 10**9, POINTS, T_odom_lidar, float(k))
        back_end.add(keyframe, (motion if k else []) + constraints(k), NO_ERRORS)
        assert back_end.advance(is_keyframe=True) == ((), None)
    return back_end


@pytest.mark.parametrize("wrong", [(), (30, 31)])
def test_positions_in_the_world_correct_the_drift_of_odometry_and_wrong_ones_are_rejected(wrong):
    truth = np.array([lie.pose_2d(2.0 * k, 0.0, 0.0) for k in range(60)])
    turned = [lie.pose_2d(2.0, 0.0, 0.002)] * 59
    odometry = np.array(list(accumulate(turned, np.matmul, initial=np.eye(3))))

    def positions(k):
        Z = truth[k] @ lie.pose_2d(0.0, 40.0 if k in wrong else 0.0, 0.0)
        return [Constraint(RobustPosition(), ORIGIN, Z, 4.0 * np.eye(2))]

    state = fed(odometry, positions).finish()
    off_m, left_m = (np.linalg.norm((each - truth)[:, :2, 2], axis=1).max() for each in (odometry, state.poses))
    assert off_m > 5.0 and left_m < 0.5
    assert sorted(state.edges[state.is_rejected, 1].tolist()) == list(wrong)


def test_without_other_constraints_the_keyframes_stay_where_odometry_puts_them():
    odometry = np.array([lie.pose_2d(0.5 * k, 0.1 * k, 0.05 * k) for k in range(6)])
    back_end = fed(odometry, lambda k: [])
    np.testing.assert_allclose(back_end.finish().poses, odometry, atol=1e-9)
    assert len(back_end.keyframes) == len(back_end.errors) == 6


def test_a_keyframe_whose_points_are_deskewed_anew_has_these():
    back_end = fed([np.eye(3)], lambda k: [])
    back_end.replace_points(0, stored(np.zeros((3, 2))))
    assert len(back_end.keyframes[0].points) == 3
