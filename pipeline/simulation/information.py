"""What a scan can tell about the motion, from the true geometry of the place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix, Pose
from scanchain.simulation.normals import surface_normals
from scanchain.simulation.sensors import Sensor
from scanchain.simulation.solids import Solids


def information(solids: Solids, T_world_lidar: Pose, sensor: Sensor, *, index: int = 0) -> Matrix:
    """Point-to-plane information H (6, 6) = Σ JᵀJ of an ideal scan number ``index`` taken standing at a pose.

    A right twist ξ = (ρ, φ), T ← T exp(ξ), moves a return p with true normal n, both in the lidar's frame, by
        r = nᵀ(ρ + φ × p)        J = ∂r/∂ξ = [nᵀ, (p × n)ᵀ]
    There is neither noise nor loss. H / σ² is the information where ranges are good to σ along the normals.
    """
    rays = sensor.rays(index)
    standing = np.zeros(len(rays.directions), dtype=np.int32)
    ranges_m, solid_of_ray = solids.strike(T_world_lidar[None], standing, rays.directions, sensor.max_range_m)
    hit = np.isfinite(ranges_m) & (ranges_m >= sensor.min_range_m)
    points = rays.directions[hit] * ranges_m[hit, None]
    R, t = T_world_lidar[:3, :3], T_world_lidar[:3, 3]
    normals = surface_normals(points @ R.T + t, solid_of_ray[hit], solids) @ R
    J = np.hstack([normals, np.cross(points, normals)])
    return J.T @ J


def spectrum(information: Matrix) -> tuple[NDArray[np.float64], Matrix]:
    """Shares (6,) of the returns that speak about each direction, least first, and the directions (6, 6) as rows.

    Rotations are measured by what they do to the returns: H is scaled by L = √(Σ|p × n|² / N), N = Σ|n|², so that
    the twist of every row, in meters and radians, moves the returns by about a meter. Shares do not depend on the
    number of returns nor on units; a share of 1e-4 means that H knows the direction as well as it would if one
    return in ten thousand faced it squarely.
    """
    count, levers = np.trace(information[:3, :3]), np.trace(information[3:, 3:])
    if count <= 0.0:
        return np.zeros(6), np.eye(6)
    scale = np.repeat([1.0, np.sqrt(count / max(levers, 1e-12 * count))], 3)
    shares, columns = np.linalg.eigh(scale[:, None] * information * scale / count)
    return np.maximum(shares, 0.0), (scale[:, None] * columns).T


def undetermined(information: Matrix, *, share: float = 1e-6) -> Matrix:
    """Twists (K, 6) in the lidar's frame along which fewer than that ``share`` of the returns say anything."""
    shares, twists = spectrum(information)
    return twists[shares < share]
