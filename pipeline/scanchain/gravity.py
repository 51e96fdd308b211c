"""Gravity, by the accelerometer of an IMU: it levels a result in space, and corrects drift of its tilt."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.data import GRAVITY_M_S2, Integers, Matrix, RestForce, Vector
from scanchain.graph.consistency import is_bent
from scanchain.graph.factors import Prior
from scanchain.graph.losses import rejection_limit
from scanchain.graph.pose_graph import PoseGraph

MOUNTED_RAD = 0.05  # σ of the vertical by the mounting of the lidar
_CORRELATED_S = 1.0  # time constant of the errors
_HELD = (1e-4, 1e-5)  # m and rad, σ of the first pose, whose position and heading gravity and ground leave free


def upright(up: Vector) -> Matrix:
    """The smallest rotation (3, 3) that makes a unit vector vertical."""
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix()


def hold_first(graph: PoseGraph, up: Vector, *, height: bool) -> None:
    """Add a prior of the first pose: heading about ``up`` (3,), position along the ground, and ``height``."""
    normal, information = graph.poses[0, :3, :3].T @ up, np.zeros((6, 6))
    across = np.outer(normal, normal)
    information[:3, :3] = (np.eye(3) if height else np.eye(3) - across) * _HELD[0] ** -2.0
    information[3:, 3:] = across * _HELD[1] ** -2.0
    graph.add_factor(Prior(), 0, information, graph.poses[0])


def leveled(graph: PoseGraph, forces: Mapping[int, RestForce], config: GraphConfig) -> tuple[PoseGraph, str]:
    """A graph in space whose world is level, and a note on it.

    Its z axis is the mean of the upward directions of the poses. Where they differ by more than their errors, a
    prior of the tilt of each pose corrects it, unless that contradicts the lidar by more than its own standard
    deviations.

    forces : by index of the pose
    """
    chosen = np.array(sorted(forces))
    best = min(forces.values(), key=lambda each: float(np.trace(each.bias_covariance)))
    ups = np.array([forces[k].force for k in chosen]) - best.bias
    ups /= np.linalg.norm(ups, axis=1, keepdims=True)
    spacing_s = max(1e-9 * float(np.ptp(graph.stamps_ns[chosen])) / len(chosen), 0.01)
    independent = math.tanh(0.5 * spacing_s / _CORRELATED_S)  # share of them
    sigma_rad = np.array([_tilt_sigma(up, forces[k].covariance) for k, up in zip(chosen, ups, strict=True)])
    sigma_rad /= math.sqrt(independent)
    mean = sigma_rad**-2.0 @ np.einsum("nij,nj->ni", graph.poses[chosen, :3, :3], ups)
    known_rad = math.hypot(_tilt_sigma(ups[-1], best.bias_covariance), float(np.sum(sigma_rad**-2.0)) ** -0.5)
    result, T_level = graph.copy(), lie.identity(3)
    T_level[:3, :3] = upright(mean / np.linalg.norm(mean))
    result.move(0, T_level)
    note = f"IMU: its accelerometer levels the result to {math.degrees(known_rad):.1g}°"
    tilts_rad = np.linalg.norm(np.einsum("nij,nj->ni", result.poses[chosen, :2, :3], ups), axis=1)
    if np.sum((tilts_rad / sigma_rad) ** 2) < rejection_limit(0.0, 2 * len(chosen)):
        return result, note
    corrected = result.copy()
    _constrain(corrected, chosen, ups, sigma_rad)
    state = corrected.optimize(config, initialize="given").state
    if is_bent(result.state(), state, config.robust_scale):
        return result, f"{note}, but contradicts the lidar by more than its standard deviations"
    return corrected, f"{note}, and corrects drift of the tilt of up to {math.degrees(tilts_rad.max()):.2g}°"


def _tilt_sigma(up: Vector, covariance: Matrix) -> float:
    """Mean σ in radians of a direction by a force of this covariance (3, 3), about the axes across it."""
    return math.sqrt(0.5 * float(np.trace(covariance) - up @ covariance @ up)) / GRAVITY_M_S2


def _constrain(graph: PoseGraph, chosen: Integers, ups: Matrix, sigma_rad: Vector) -> None:
    """Add priors of the tilt of poses (N,), and one of the first one's position and heading."""
    hold_first(graph, np.array([0.0, 0.0, 1.0]), height=True)
    for k, up, sigma in zip(chosen.tolist(), ups, sigma_rad.tolist(), strict=True):
        Z, information = graph.poses[k].copy(), np.zeros((6, 6))
        Z[:3, :3] = upright(Z[:3, :3] @ up) @ Z[:3, :3]
        information[3:, 3:] = (np.eye(3) - np.outer(up, up)) / sigma**2
        graph.add_factor(Prior(), k, information, Z)
