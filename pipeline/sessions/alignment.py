"""Alignment of a map to another one: its keyframes are placed in it by loop closures, as a log's scans are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import ClosureVerdict, Keyframe, KeyframeErrors, Matrix, Points, Prior, RawPoints, Scan, State
from scanchain.errors import InputError
from scanchain.maps import SavedMap
from scanchain.odometry.front_end import Located
from scanchain.odometry.tracked import Tracked, first_match
from scanchain.slam import Slam
from scanchain.words import counted


@dataclass(frozen=True, slots=True)
class Alignment:
    """A map placed in another one.

    Attributes
    ----------
    poses : (K, d+1, d+1) T_target_lidar of its keyframes
    loops : number of loop closures between the two that are in force
    """

    poses: Matrix
    loops: int


def align_maps(target: SavedMap, source: SavedMap, config: Config) -> Alignment:
    """The keyframes of ``source`` in the frame of ``target``, wherever they are in it; the target stays as it is.

    Raises InputError where the source is not found in the target.
    """
    slam = Slam(config, dimension=source.dimension, prior=target)
    first, information = source.keyframes[0], _information(source, config)
    for keyframe, known in zip(source.keyframes, information, strict=True):
        slam.place(_located(keyframe, known, first.points, config))
    result = slam.finish()
    fixed = len(target.keyframes)
    pairs = result.state.edges[result.state.is_loop & ~result.state.is_rejected]
    loops = int(((pairs < fixed).any(axis=1) & (pairs >= fixed).any(axis=1)).sum())
    if not loops or result.components[0] != result.components[-1]:
        tried = [closure.verdict for closure in slam.closures if closure.target < fixed]
        accepted = tried.count(ClosureVerdict.ACCEPTED)
        raise InputError(
            f"{source.name}: is not found in {target.name} ({counted(len(tried), 'place')} tried, "
            f"{accepted} fit); give maps of one place, or the transform between them"
        )
    return Alignment(result.trajectory.poses, loops)


def _information(source: SavedMap, config: Config) -> Matrix:
    """(K, k, k) of the motion to each keyframe from the one before, from its edge where there is one."""
    k = lie.twist_size(source.keyframes[0].T_odom_lidar)
    usual = lie.by_component(k, config.odometry.edge_sigma_m, config.odometry.edge_sigma_rad) ** -2.0
    result = np.tile(np.diag(usual), (len(source.keyframes), 1, 1))
    edges = source.edges
    is_step = (edges.pairs[:, 1] == edges.pairs[:, 0] + 1) & ~edges.is_loop
    result[edges.pairs[is_step, 1]] = edges.information[is_step]
    return result


def _located(keyframe: Keyframe, information: Matrix, first_points: Points, config: Config) -> Located:
    """A keyframe of a map as odometry would hand it on, its final pose for that of odometry."""
    points, T = keyframe.points, keyframe.T_odom_lidar
    raw: RawPoints = points.astype(np.float32)
    scan = Scan(keyframe.scan_index, keyframe.stamp_ns, keyframe.stamp_ns, raw, np.empty(0, np.float32), 0, None)
    match = first_match(T, points, config.matching)
    covariance = np.linalg.inv(information).astype(np.float64)
    prior = Prior(T, covariance, np.zeros(len(information)))
    tracked = Tracked(scan, points, points, T, match, State.OK, "", prior, 0.0, 0.0, 0.0)
    errors = KeyframeErrors(1.0, np.zeros_like(information), 0.0)
    return Located(tracked, True, keyframe.scale, points[:0], information, errors, first_points)
