"""Arrays of the pipeline (SE(2) or SE(3), float64) as the float32 arrays in space that rerun draws."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix

Floats = NDArray[np.float32]

_WEAKEST = 25.0  # m⁻²: a standard deviation above 0.2 m, or none at all, is drawn as 0.2 m


def in_space(points: NDArray[np.floating]) -> Floats:
    """Points (N, 2 or 3) as (N, 3); a point in the plane lies at z = 0."""
    result = np.zeros((len(points), 3), np.float32)
    result[:, : points.shape[1]] = points
    return result


def positions(poses: Matrix) -> Floats:
    """Positions (N, 3) of poses (N, d+1, d+1)."""
    return in_space(poses[:, :-1, -1])


def segments(starts: Floats, ends: Floats) -> Floats:
    """Line strips (N, 2, 3) of two points each."""
    return np.stack([starts, ends], axis=1)


def transforms(poses: Matrix) -> rr.ComponentColumnList:
    """Transform columns of poses (N, d+1, d+1)."""
    quat_xyzw = lie.to_quaternion(lie.lift(poses)[:, :3, :3]).astype(np.float32)
    return rr.Transform3D.columns(translation=positions(poses), quaternion=quat_xyzw)


def ellipsoids(informations: Matrix, scale: float) -> rr.ComponentColumnList:
    """Ellipsoid columns of the position's covariance, axes ``scale`` standard deviations long.

    informations : (N, k, k) of twists in the lidar's frame, so that the translation block of the inverse is the
        covariance of the position along the lidar's axes. What is not determined is drawn at the cap.
    """
    k = informations.shape[-1]
    d = 2 if k == 3 else 3
    values, vectors = np.linalg.eigh(np.nan_to_num(informations, posinf=0.0, neginf=0.0))
    scaled = vectors[:, :d, :] / np.sqrt(np.maximum(values, 1e-9))[:, None, :]
    variances, axes = np.linalg.eigh(scaled @ np.swapaxes(scaled, -1, -2))
    half_sizes = in_space(scale * np.sqrt(np.minimum(variances, 1.0 / _WEAKEST)))
    if d == 2:
        half_sizes[:, 2] = 0.1 * half_sizes.min(axis=1, initial=np.inf, where=[True, True, False])
    rotation = np.tile(np.eye(3), (len(axes), 1, 1))
    rotation[:, :d, :d] = axes
    rotation[:, :, 0] *= np.linalg.det(rotation)[:, None]
    return rr.Ellipsoids3D.columns(
        half_sizes=half_sizes, quaternions=lie.to_quaternion(rotation).astype(np.float32)
    )


def at_most(points: NDArray[np.floating], limit: int) -> NDArray[np.floating]:
    """Every n-th point, so that at most ``limit`` remain."""
    return points[:: max(1, -(-len(points) // limit))]
