"""Eigenvectors of small symmetric matrices, in closed form, without allocation."""

import math

from numba import njit


@njit(cache=True)
def normal_2d(cxx: float, cxy: float, cyy: float):
    """Eigenvalues (small, large) of [[cxx, cxy], [cxy, cyy]] and the unit eigenvector of the small one."""
    half_trace = 0.5 * (cxx + cyy)
    half_difference = 0.5 * (cxx - cyy)
    root = math.sqrt(half_difference * half_difference + cxy * cxy)
    angle = 0.5 * math.atan2(cxy, half_difference)
    return half_trace - root, half_trace + root, -math.sin(angle), math.cos(angle)


@njit(cache=True)
def eigenvalues_3d(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float):
    """Eigenvalues of a symmetric 3×3 matrix, ascending, by the trigonometric formula (Smith 1961)."""
    off = xy * xy + xz * xz + yz * yz
    mean = (xx + yy + zz) / 3.0
    ax, ay, az = xx - mean, yy - mean, zz - mean
    p2 = ax * ax + ay * ay + az * az + 2.0 * off
    if p2 <= 1e-300:
        return mean, mean, mean
    p = math.sqrt(p2 / 6.0)
    determinant = ax * (ay * az - yz * yz) - xy * (xy * az - yz * xz) + xz * (xy * yz - ay * xz)
    r = min(1.0, max(-1.0, 0.5 * determinant / (p * p * p)))
    phi = math.acos(r) / 3.0
    large = mean + 2.0 * p * math.cos(phi)
    small = mean + 2.0 * p * math.cos(phi + 2.0943951023931953)
    return small, 3.0 * mean - small - large, large


@njit(cache=True)
def eigenvector_3d(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, eigenvalue: float):
    """Unit eigenvector of a simple eigenvalue: the longest cross product of two rows of A − λI.

    Returns (0, 0, 0) where the eigenvalue is not simple, so that no direction is singled out.
    """
    ax, ay, az = xx - eigenvalue, yy - eigenvalue, zz - eigenvalue
    best, vx, vy, vz = 0.0, 0.0, 0.0, 0.0
    for row in range(3):
        if row == 0:
            cx, cy, cz = xy * yz - xz * ay, xz * xy - ax * yz, ax * ay - xy * xy
        elif row == 1:
            cx, cy, cz = xy * az - xz * yz, xz * xz - ax * az, ax * yz - xy * xz
        else:
            cx, cy, cz = ay * az - yz * yz, yz * xz - xy * az, xy * yz - ay * xz
        length = cx * cx + cy * cy + cz * cz
        if length > best:
            best, vx, vy, vz = length, cx, cy, cz
    if best <= 1e-300:
        return 0.0, 0.0, 0.0
    scale = 1.0 / math.sqrt(best)
    return vx * scale, vy * scale, vz * scale
