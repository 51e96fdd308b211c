"""Velocities of a wheeled robot integrated to motions, with the Jacobians by their noise; compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Array = NDArray[np.float64]


@njit()
def integrate(times_s: _Array, velocities: _Array, nodes_s: _Array, motion: _Array, spread: _Array) -> None:
    """Chain the arcs that a robot drives at constant velocities, from every node's time to the next.

    A velocity holds until the next one comes. An arc of duration τ at (v, ω) moves by
        θ ← θ + ω τ,  t ← t + v τ sinc(ω τ / 2) (cos, sin)(θ + ω τ / 2)
    Noise that grows with what is driven spreads the motion by P ← F P Fᵀ + G d Gᵀ, F and G of the arc at its
    middle (Thrun, Burgard & Fox 2005, ch. 5), from four sources: forward, sideways and turning with d = |v| τ,
    turning with d = |ω| τ.

    times_s (M,) ascending, velocities (M, 2) v in m/s and ω in rad/s, nodes_s (K,) ascending
    motion (K − 1, 3) x, y, θ in the frame of the earlier node : filled
    spread (K − 1, 4, 3, 3) covariance of the motion from each source of unit density : filled; given as
        (K − 1, 0, 3, 3) the motion alone is worked out
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
            if times_s[at] > now:  # before the first velocity the robot stands
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
    g0, g1, g2 = c, s, 0.0
    if noise == 1:
        g0, g1 = -s, c
    elif noise >= 2:
        g0, g1, g2 = -0.5 * chord * s, 0.5 * chord * c, 1.0
    P[0, 0] += driven * g0 * g0
    P[0, 1] += driven * g0 * g1
    P[1, 0] += driven * g0 * g1
    P[1, 1] += driven * g1 * g1
    P[0, 2] += driven * g0 * g2
    P[2, 0] += driven * g0 * g2
    P[1, 2] += driven * g1 * g2
    P[2, 1] += driven * g1 * g2
    P[2, 2] += driven * g2 * g2
