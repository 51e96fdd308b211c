"""A scan with its pose, and matches for scans without a registration."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config, MatchingConfig
from scanchain.data import Match, Points, Pose, Prior, Scan, State, brief
from scanchain.odometry.prediction import Prediction
from scanchain.registration.align import as_ambiguous, with_source_frame

COPY = "the scan before once more, to the last bit: it has that pose, and says nothing of a motion since"
NEW_MAP = "a new map begins"  # in the reason of a scan whose motion from the one before is unknown


class Tracked(msgspec.Struct, frozen=True):
    """A scan with its pose in the odometry frame.

    ``points`` (M, d) are all that went into the map, ``matched`` those that were aligned, both deskewed, as seen
    from the lidar at the scan's stamp, where ``T_odom_lidar`` holds too; the seconds are its times by stage.
    ``prior`` is that of this pose, its covariance that at the middle of the scan;
    ``elsewhere_m`` is its largest possible distance where its motion is unknown, 0 as a rule;
    ``is_repeated`` if its points are those of the scan before.
    """

    __repr__ = brief
    scan: Scan
    points: Points
    matched: Points
    T_odom_lidar: Pose
    match: Match
    state: State
    reason: str
    prior: Prior
    preprocess_s: float
    match_s: float
    map_s: float
    elsewhere_m: float = 0.0
    is_repeated: bool = False


def owned(tracked: Tracked) -> Tracked:
    """The same with arrays of its own, except for ``points``: whoever writes into them moves no later pose."""
    match, prior = tracked.match, tracked.prior
    return msgspec.structs.replace(
        tracked,
        matched=tracked.matched.copy(),
        T_odom_lidar=tracked.T_odom_lidar.copy(),
        match=replace(match, T_target_source=match.T_target_source.copy(), information=match.information.copy()),
        prior=Prior(prior[0].copy(), prior[1].copy(), prior[2].copy(), prior.is_measured),
    )


def first_match(T_odom_lidar: Pose, points: Points, config: MatchingConfig) -> Match:
    """Match of the first scan, where there is no map yet: the frame starts at this scan."""
    k = lie.twist_size(T_odom_lidar)
    return Match(
        T_target_source=T_odom_lidar,
        information=np.diag(np.full(k, len(points) / config.sensor_noise_m**2)),
        cost=0.0,
        inliers=len(points),
        points=len(points),
        iterations=0,
        residual_m=0.0,
        fit=1.0,
        at_minimum=True,
        converged=True,
        reason="first scan: the frame starts here",
        degeneracy_eigenvalue=1.0,
        observability=np.inf,
        degeneracy_direction=np.eye(k)[0],
    )


def nothing_to_match(prediction: Prediction, config: Config) -> Match:
    """Match of a scan without a point left: the prediction."""
    limits = config.preprocess
    return replace(
        first_match(prediction.T_odom_lidar, np.empty((0, 0)), config.matching),
        information=prediction.prior.information,
        fit=0.0,
        at_minimum=False,
        converged=False,
        reason=f"no point lies between preprocess.min_range_m ({limits.min_range_m:g}) and "
        f"preprocess.max_range_m ({limits.max_range_m:g})",
        degeneracy_eigenvalue=0.0,
        observability=0.0,
    )


def blurred(match: Match, error: NDArray[np.float64]) -> Match:
    """The same match with an additional error (k,), one standard deviation, that the residuals do not show."""
    blur = np.diag(error**2)
    return replace(
        match, information=match.information @ np.linalg.inv(np.eye(len(blur)) + blur @ match.information)
    )


def spread(match: Match, rival: NDArray[np.float64]) -> Match:
    """The same match with a covariance that covers another pose, a twist (k,) away, that fits as well."""
    Omega_rival = match.information @ rival
    information = match.information - np.outer(Omega_rival, Omega_rival) / (1.0 + rival @ Omega_rival)
    T_rival = match.T_target_source @ lie.exp(rival)
    return as_ambiguous(replace(match, information=information), *lie.apart(match.T_target_source, T_rival))


def seen_from(tracked: Tracked, T_new_old: Pose) -> Tracked:
    """The same scan as seen from another frame that moves with it: points, poses, information."""
    T_old_new = lie.inverse(T_new_old)
    return msgspec.structs.replace(
        tracked,
        points=lie.transform(T_new_old, tracked.points),
        matched=lie.transform(T_new_old, tracked.matched),
        T_odom_lidar=tracked.T_odom_lidar @ T_old_new,
        match=with_source_frame(tracked.match, T_new_old),
        prior=tracked.prior._replace(T_target_source=tracked.prior.T_target_source @ T_old_new),
    )
