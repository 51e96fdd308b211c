"""Information of an ideal scan about the motion, by how its ranges change where the lidar is moved a little."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose
from scanchain.simulation.sensors import Sensor
from scanchain.simulation.solids import Solids

_STEP_M = 1e-4  # of the differences; rays that leave a surface within it count for another


def information(solids: Solids, T_world_lidar: Pose, sensor: Sensor, *, index: int = 0) -> Matrix:
    """Point-to-plane information H (6, 6) = Σ JᵀJ of an ideal scan number ``index`` taken standing at a pose.

    A right twist ξ = (ρ, φ), T ← T exp(ξ), moves a return p with true normal n, both in the lidar's frame, by
        r = nᵀ(ρ + φ × p)        J = ∂r/∂ξ = [nᵀ, (p × n)ᵀ]
    There is neither noise nor loss. H / σ² is the information where ranges are good to σ along the normals,
    which the gradients of the ranges by the lidar's position are parallel to.
    """
    rays = sensor.rays(index)

    def ranges_m(shift_m: NDArray[np.float64]) -> NDArray[np.float64]:
        T = T_world_lidar.copy()
        T[:3, 3] += T[:3, :3] @ shift_m
        return solids.cast(T[None], np.zeros(len(rays.directions), np.int32), rays.directions, sensor.max_range_m)

    reached_m = ranges_m(np.zeros(3))
    with np.errstate(invalid="ignore"):  # out of reach
        gradient = np.stack([ranges_m(step) - ranges_m(-step) for step in _STEP_M * np.eye(3)], axis=1)
    hit = np.isfinite(gradient).all(axis=1) & np.isfinite(reached_m) & (reached_m >= sensor.min_range_m)
    normals = gradient[hit] / np.linalg.norm(gradient[hit], axis=1, keepdims=True)
    J = np.hstack([normals, np.cross(rays.directions[hit] * reached_m[hit, None], normals)])
    return J.T @ J


def spectrum(information: Matrix) -> tuple[NDArray[np.float64], Matrix]:
    """Shares (k,) of the returns that constrain each direction, least first, and the directions (k, k) as rows.

    Rotations are measured by what they do to the returns: H is scaled by L = √(Σ|p × n|² / N), N = Σ|n|², so that
    the twist of every row, in meters and radians, moves the returns by about a meter. Shares do not depend on the
    number of returns nor on units; a share of 1e-4 means that H constrains the direction as well as if one
    return in ten thousand faced it squarely.
    """
    k, d = len(information), (len(information) + 1) // 2
    count, levers = np.trace(information[:d, :d]), np.trace(information[d:, d:])
    if count <= 0.0:
        return np.zeros(k), np.eye(k)
    scale = lie.by_component(k, 1.0, float(np.sqrt(count / max(levers, 1e-12 * count))))
    shares, columns = np.linalg.eigh(scale[:, None] * information * scale / count)
    return np.maximum(shares, 0.0), (scale[:, None] * columns).T
