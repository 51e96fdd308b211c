"""Small symmetric matrices: eigenvectors, Cholesky factors, inverses, congruences."""

import math

import numpy as np

from scanchain.kernels.compiling import njit


@njit(inline="always")
def normal_2d(cxx: float, cxy: float, cyy: float):
    """Eigenvalues (small, large) of [[cxx, cxy], [cxy, cyy]] and the unit eigenvector of the small one."""
    half_trace = 0.5 * (cxx + cyy)
    half_difference = 0.5 * (cxx - cyy)
    root = math.sqrt(half_difference * half_difference + cxy * cxy)
    angle = 0.5 * math.atan2(cxy, half_difference)
    return half_trace - root, half_trace + root, -math.sin(angle), math.cos(angle)


@njit()
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


@njit()
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


@njit(nogil=True)
def eigensystem(A, values, vectors):
    """Eigenvalues, ascending, of a small symmetric matrix A (k, k) and its unit eigenvectors, a column each.

    Cyclic Jacobi rotations until off-diagonal entries vanish (Golub & Van Loan, ch. 8.5). Overwrites A.
    """
    k = A.shape[0]
    for i in range(k):
        for j in range(k):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):  # of rotations; a few suffice
        beside = 0.0
        for p in range(k - 1):
            for q in range(p + 1, k):
                if abs(A[p, q]) > 1e-16 * math.sqrt(abs(A[p, p] * A[q, q])):
                    beside = 1.0
                    _rotate_pair(A, vectors, p, q)
        if beside == 0.0:
            break
    for i in range(k):
        values[i] = A[i, i]
    _sort_columns(values, vectors)


@njit(inline="always")
def _rotate_pair(A, V, p: int, q: int):
    """Turn axes p and q so that A[p, q] becomes zero: t = tan of the angle, the smaller root of t² + 2τt = 1."""
    tau = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
    t = math.copysign(1.0, tau) / (abs(tau) + math.sqrt(1.0 + tau * tau))
    c = 1.0 / math.sqrt(1.0 + t * t)
    s = t * c
    for i in range(A.shape[0]):
        A[i, p], A[i, q] = c * A[i, p] - s * A[i, q], s * A[i, p] + c * A[i, q]
        V[i, p], V[i, q] = c * V[i, p] - s * V[i, q], s * V[i, p] + c * V[i, q]
    for i in range(A.shape[0]):
        A[p, i], A[q, i] = c * A[p, i] - s * A[q, i], s * A[p, i] + c * A[q, i]


@njit(inline="always")
def _sort_columns(values, vectors):
    """Sort eigenvalues ascending, together with their vectors."""
    for i in range(1, values.shape[0]):
        j = i
        while j > 0 and values[j] < values[j - 1]:
            values[j], values[j - 1] = values[j - 1], values[j]
            for row in range(vectors.shape[0]):
                vectors[row, j], vectors[row, j - 1] = vectors[row, j - 1], vectors[row, j]
            j -= 1


@njit(nogil=True)
def factorize(H, damping: float, factor) -> bool:
    """Write L with L Lᵀ = H + damping · diag(H) to the lower half of ``factor``; False if indefinite."""
    k = H.shape[0]
    for i in range(k):
        for j in range(i + 1):
            total = H[i, j] + (damping * abs(H[i, i]) if i == j else 0.0)
            for m in range(j):
                total -= factor[i, m] * factor[j, m]
            if i != j:
                factor[i, j] = total / factor[j, j]
            elif total <= 1e-12 * abs(H[i, i]) or not math.isfinite(total):
                return False
            else:
                factor[i, i] = math.sqrt(total)
    return True


@njit(nogil=True)
def substitute(factor, b, x):
    """Write −(L Lᵀ)⁻¹ b to ``x``."""
    k = b.shape[0]
    for i in range(k):
        total = -b[i]
        for m in range(i):
            total -= factor[i, m] * x[m]
        x[i] = total / factor[i, i]
    for i in range(k - 1, -1, -1):
        total = x[i]
        for m in range(i + 1, k):
            total -= factor[m, i] * x[m]
        x[i] = total / factor[i, i]


@njit(nogil=True)
def definite_inverse(matrix):
    """Inverse of a positive definite matrix (k, k); zeros where it is not."""
    k = matrix.shape[0]
    out, factor, b, x = np.zeros((k, k)), np.zeros((k, k)), np.zeros(k), np.empty(k)
    if factorize(matrix, 0.0, factor):
        for j in range(k):
            b[j] = -1.0
            substitute(factor, b, x)
            b[j] = 0.0
            for i in range(k):
                out[i, j] = x[i]
    return out


@njit(nogil=True)
def congruent(A, H):
    """AᵀHA of two (k, k)."""
    k = H.shape[0]
    HA, out = np.zeros((k, k)), np.zeros((k, k))
    for i in range(k):
        for m in range(k):
            for j in range(k):
                HA[i, j] += H[i, m] * A[m, j]
    for m in range(k):
        for i in range(k):
            for j in range(k):
                out[i, j] += A[m, i] * HA[m, j]
    return out
