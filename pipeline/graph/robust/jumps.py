"""Jumps: single motions of odometry that are wrong altogether, as loop edges show them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.robust.left_out import LeftOut

FEWEST = 3  # number of loop edges that a jump must explain beyond its likelihood
SIGMAS = (1.0, 0.2)  # m and rad, standard deviations of a jump
_PROBABILITY = 1e-4  # of a jump over an edge
_MOST = 100  # largest number of edges that are looked at more closely
_ROUNDS = 3  # of the least squares over the loop edges that a jump explains

Vector = NDArray[np.float64]


def loosened(information: Matrix) -> Matrix:
    """Information (..., k, k) of motions with the covariance of a jump added to theirs, (Ω⁻¹ + Σ)⁻¹."""
    prior = _prior(information.shape[-1])
    return np.asarray(prior @ np.linalg.solve(information + prior, information), np.float64)


def price_of(information: Matrix, price: float, nominal: float) -> NDArray[np.float64]:
    """Cost of a jump in χ², three loop edges left out and −2 log of its likelihood, 2 log(1/p) + log |1 + Σ Ω|.

    The likelihood is scaled as the price of a loop edge is.

    information : (..., k, k) of the motions; the better they are measured, the less likely one is wrong
    price, nominal : of a loop edge left out, and what it is where the noise model is right
    """
    prior = _prior(information.shape[-1])
    log_ratio = np.linalg.slogdet(np.eye(len(prior)) + np.linalg.solve(prior, information))[1]
    return FEWEST * price + (price / nominal) * (log_ratio - 2.0 * np.log(_PROBABILITY))


def _prior(k: int) -> Matrix:
    return np.diag(lie.by_component(k, *SIGMAS) ** -2.0)


def next_jump(
    left_out: LeftOut, jumps: tuple[int, ...], price: float, nominal: float
) -> tuple[float, int, Vector]:
    """The fall of the cost by one more jump, to first order, its edge among those of odometry, and its twist (k,).

    A twist t on an edge's motion changes the cost by tᵀA t − 2 bᵀt, prior included, and by what each loop edge
    left out then costs less than its price: min(price, (e + V t)ᵀC⁻¹(e + V t)). Each of them gives a candidate.
    Edges are tried in the order of a bound, for which each loop edge has a twist of its own at its share of that
    change.
    """
    problem, odometry = left_out.problem, left_out.odometry
    information, k = problem.information[odometry], problem.freedom
    whole = np.tile(np.eye(k), (len(odometry), 1, 1))
    e = left_out.errors[left_out.edges]
    M = np.asarray(left_out.stride * np.linalg.inv(left_out.covariances), np.float64)
    costs, price = price_of(information, price, nominal), left_out.stride * price
    A = information - information @ left_out.predicted @ information + _prior(k)
    b = (information @ left_out.errors[odometry][..., None])[..., 0]
    hoped = np.zeros(len(odometry))
    for error, weight, shift in zip(e, M, left_out.shifts(whole), strict=True):
        g = b / len(e) - np.swapaxes(shift, 1, 2) @ (weight @ error)
        H = A / len(e) + np.swapaxes(shift, 1, 2) @ weight @ shift
        left = error @ weight @ error - (g * np.linalg.solve(H, g[..., None])[..., 0]).sum(axis=1)
        hoped += np.clip(price - left, 0.0, price)
    hoped -= costs
    hoped[list(jumps)] = -np.inf
    tried = np.argsort(-hoped, kind="stable")[:_MOST]
    shifts = np.stack([shift[tried] for shift in left_out.shifts(whole)], axis=1)
    falls = [_largest_fall(A[o], b[o], e, M, V, price) for o, V in zip(tried, shifts, strict=True)]
    gains = np.array([fall for fall, _ in falls]) - costs[tried]
    best = int(np.argmax(gains))
    return float(gains[best]), int(tried[best]), falls[best][1]


def _largest_fall(A: Matrix, b: Vector, e: Matrix, M: Matrix, V: Matrix, price: float) -> tuple[float, Vector]:
    """Largest fall of the cost by a twist (k,) on one edge, and the twist.

    A (k, k), b (k,) : of the edge; e, M, V : (L, ...) of the loop edges
    """
    VM = np.swapaxes(V, 1, 2) @ M
    VMV, VMe = VM @ V, (VM @ e[..., None])[..., 0]
    chosen, largest, best = np.eye(len(e)), 0.0, np.zeros(len(b))
    for _ in range(_ROUNDS):
        t = np.linalg.solve(A + np.einsum("cl,lab->cab", chosen, VMV), (b - chosen @ VMe)[..., None])[..., 0]
        left = e + np.einsum("lab,cb->cla", V, t)
        saved = price - np.einsum("cla,lab,clb->cl", left, M, left)
        falls = 2.0 * t @ b - np.einsum("ca,ab,cb->c", t, A, t) + np.maximum(saved, 0.0).sum(axis=1)
        if falls.max() > largest:
            largest, best = float(falls.max()), t[int(np.argmax(falls))]
        chosen = (saved > 0.0).astype(np.float64)
    return largest, best
