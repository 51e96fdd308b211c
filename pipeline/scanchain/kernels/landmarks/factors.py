"""Factors of landmark SLAM in the plane, whitened residuals and Jacobians, and dead reckoning; compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Array = NDArray[np.float64]
_Index = NDArray[np.int64]
_NOWHERE_M = 1e-9  # distance to the pose below which a landmark has no bearing


@njit()
def bearing_range(
    poses: _Array, landmarks: _Array, observed: _Index, measured: _Array, whitening: _Array, own: _Array,
    sensing: _Index, residuals: _Array, jacobians: _Array,
) -> None:  # fmt: skip
    """Fill W r and W J of every observation, residual (measured from predicted) and Jacobian, WᵀW = Σ⁻¹.

        δ = l − t,  q = ‖δ‖,  β = wrap(atan2(δ_y, δ_x) − θ − bearing) + bearing
        ∂(β, q)/∂t = [δ_y/q², −δ_x/q²; −δ_x/q, −δ_y/q],  ∂(β, q)/∂θ = [−1; 0],  ∂(β, q)/∂l = −∂(β, q)/∂t
        r = [β (1 + c₄) + c₃ + c₅ sin(β)/q − bearing, q (1 + c₀ − c₁ (1 − cos β)) + c₂ − c₅ cos(β) − range]

    with the systematic errors c of the sensor: of the ranges a scale, 1 if they are depths along the optical axis
    and 0 if they are distances, an offset; of the bearings an offset and a scale; the distance by which the sensor
    is ahead of the pose. A landmark at the position of the pose has no bearing; it is assumed in the measured
    direction, and only the range has a residual.

    poses : (K, 2) x, y, with heading 0, or (K, 3) x, y, θ; landmarks (L, 2); m, rad
    observed (N, 2) pose and landmark, measured (N, 2) bearing rad, range m, whitening (N, 2, 2) W
    own (C,), sensing (N, 6) : calibration, and where each observation has c in it; (N, 0) where c is zero
    residuals (N, 2), jacobians (N, 2, pose + 2 + 6) : filled, columns pose first
    """
    p, unknown = poses.shape[1], sensing.shape[1]
    c = np.zeros(6)
    J = np.zeros((2, p + 2 + unknown))
    for k in range(observed.shape[0]):
        pose, landmark, bearing_rad = poses[observed[k, 0]], landmarks[observed[k, 1]], measured[k, 0]
        heading = pose[2] if p == 3 else 0.0
        dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
        q = np.sqrt(dx * dx + dy * dy)
        if q > _NOWHERE_M:
            angle = np.arctan2(dy, dx) - heading - bearing_rad
            off_rad = angle - 2.0 * np.pi * np.floor((angle + np.pi) / (2.0 * np.pi))
            J[0, p], J[0, p + 1] = -dy / (q * q), dx / (q * q)
            J[1, p], J[1, p + 1] = dx / q, dy / q
        else:
            off_rad = J[0, p] = J[0, p + 1] = 0.0
            J[1, p], J[1, p + 1] = np.cos(heading + bearing_rad), np.sin(heading + bearing_rad)
        off_m = q - measured[k, 1]
        for a in range(2):
            J[a, 0], J[a, 1] = -J[a, p], -J[a, p + 1]
        if p == 3:
            J[0, 2] = -1.0 if q > _NOWHERE_M else 0.0
            J[1, 2] = 0.0
        if unknown and q > _NOWHERE_M:
            for a in range(unknown):
                c[a] = own[sensing[k, a]]
            angle = off_rad + bearing_rad
            sine, cosine = np.sin(angle), np.cos(angle)
            off_rad += c[4] * angle + c[3] + c[5] * sine / q
            off_m += q * (c[0] - c[1] * (1.0 - cosine)) + c[2] - c[5] * cosine
            along, across = c[0] - c[1] * (1.0 - cosine), (c[5] - c[1] * q) * sine
            turned, lifted = c[4] + c[5] * cosine / q, -c[5] * sine / (q * q)
            for a in range(p + 2):
                b, d = J[0, a], J[1, a]
                J[0, a] += turned * b + lifted * d
                J[1, a] += across * b + along * d
            J[0, p + 2 :] = 0.0, 0.0, 0.0, 1.0, angle, sine / q
            J[1, p + 2 :] = q, -q * (1.0 - cosine), 1.0, 0.0, 0.0, -cosine
        for a in range(2):
            residuals[k, a] = whitening[k, a, 0] * off_rad + whitening[k, a, 1] * off_m
            for b in range(p + 2 + unknown):
                jacobians[k, a, b] = whitening[k, a, 0] * J[0, b] + whitening[k, a, 1] * J[1, b]


@njit()
def odometry(
    poses: _Array, before: _Index, moved: _Array, whitening: _Array, residuals: _Array, jacobians: _Array
) -> None:
    """Fill W r and W J of every motion from a pose to the next, measured in the frame of the first.

        r = [Rᵀ(θ_i) (t_j − t_i) − t_z, wrap(θ_j − θ_i − θ_z)]
        ∂r/∂(t_i, θ_i) = [−Rᵀ, (∂Rᵀ/∂θ_i)(t_j − t_i); 0, −1],  ∂r/∂(t_j, θ_j) = [Rᵀ, 0; 0, 1]

    poses (K, 3), moved (M, 3) x, y, heading; m, rad; before (M,) pose that each motion starts from
    whitening (M, 3, 3) W; residuals (M, 3), jacobians (M, 3, 6) : filled
    """
    r, J = np.empty(3), np.zeros((3, 6))
    J[2, 2], J[2, 5] = -1.0, 1.0
    for k in range(moved.shape[0]):
        first, second = poses[before[k]], poses[before[k] + 1]
        c, s = np.cos(first[2]), np.sin(first[2])
        dx, dy = second[0] - first[0], second[1] - first[1]
        turn = second[2] - first[2] - moved[k, 2]
        r[0] = c * dx + s * dy - moved[k, 0]
        r[1] = -s * dx + c * dy - moved[k, 1]
        r[2] = turn - 2.0 * np.pi * np.floor((turn + np.pi) / (2.0 * np.pi))
        J[0, 3], J[0, 4], J[1, 3], J[1, 4] = c, s, -s, c
        J[0, 0], J[0, 1], J[1, 0], J[1, 1] = -c, -s, s, -c
        J[0, 2], J[1, 2] = -s * dx + c * dy, -c * dx - s * dy
        residuals[k] = 0.0
        jacobians[k] = 0.0
        for a in range(3):
            for b in range(3):
                residuals[k, a] += whitening[k, a, b] * r[b]
                for d in range(6):
                    jacobians[k, a, d] += whitening[k, a, b] * J[b, d]


@njit()
def lagged_products(first: _Index, second: _Index, lag: _Index, errors: _Array, sums: _Array) -> None:
    """Add the products of the errors of every pair to the sum of its lag.

    first, second, lag (P,) : indices of the errors, and of the sum; errors (N, k), sums (lags,)
    """
    for p in range(first.size):
        total = 0.0
        for a in range(errors.shape[1]):
            total += errors[first[p], a] * errors[second[p], a]
        sums[lag[p]] += total


@njit()
def integrate(times_s: _Array, velocities: _Array, nodes_s: _Array, motion: _Array, spread: _Array) -> None:
    """Chain the arcs that a robot drives at constant velocities, from every node's time to the next.

    A velocity holds until the next one comes. An arc of duration τ at (v, ω) moves by
        θ ← θ + ω τ,  t ← t + v τ sinc(ω τ / 2) (cos, sin)(θ + ω τ / 2)
    Noise that grows with distance or angle adds covariance: P ← F P Fᵀ + G d Gᵀ, F and G of the arc at its
    middle (Thrun, Burgard & Fox 2005, ch. 5), from four sources: forward, sideways and turning with d = |v| τ,
    turning with d = |ω| τ.

    times_s (M,) ascending, velocities (M, 2) v in m/s and ω in rad/s, nodes_s (K,) ascending
    motion (K − 1, 3) x, y, θ in the frame of the earlier node : filled
    spread (K − 1, 4, 3, 3) covariance of the motion from each source of unit density : filled; with shape
        (K − 1, 0, 3, 3) only the motion is computed
    """
    at = 0
    F = np.eye(3)
    for k in range(nodes_s.size - 1):
        x = y = heading = 0.0
        P = spread[k]
        P[:] = 0.0
        now = nodes_s[k]
        while now < nodes_s[k + 1]:
            while at + 1 < times_s.size and times_s[at + 1] <= now:
                at += 1
            until = nodes_s[k + 1]
            if times_s[at] > now:  # before the first velocity the robot is at standstill
                until, v, turn_rate = min(until, times_s[at]), 0.0, 0.0
            else:
                if at + 1 < times_s.size:
                    until = min(until, times_s[at + 1])
                v, turn_rate = velocities[at, 0], velocities[at, 1]
            lasting = until - now
            half = 0.5 * turn_rate * lasting
            chord = v * lasting * (np.sin(half) / half if abs(half) > 1e-8 else 1.0)
            c, s = np.cos(heading + half), np.sin(heading + half)
            x, y, heading = x + chord * c, y + chord * s, heading + 2.0 * half
            F[0, 2], F[1, 2] = -chord * s, chord * c
            for noise in range(P.shape[0]):
                driven = abs(v if noise < 3 else turn_rate) * lasting
                _spread(P[noise], F, noise, c, s, chord, driven)
            now = until
        motion[k, 0], motion[k, 1], motion[k, 2] = x, y, heading


@njit()
def _spread(P: _Array, F: _Array, noise: int, c: float, s: float, chord: float, driven: float) -> None:
    """Propagate a covariance along one arc and add that of its own noise."""
    for a in range(2):  # F P Fᵀ, F the identity but for its last column
        for b in range(3):
            P[a, b] += F[a, 2] * P[2, b]
    for a in range(3):
        for b in range(2):
            P[a, b] += F[b, 2] * P[a, 2]
    g = c, s, 0.0
    if noise == 1:
        g = -s, c, 0.0
    elif noise >= 2:
        g = -0.5 * chord * s, 0.5 * chord * c, 1.0
    for a in range(3):
        for b in range(3):
            P[a, b] += driven * g[min(a, b)] * g[max(a, b)]
