"""Steps of the four optimizers, and the damping of Levenberg–Marquardt."""

import math

from scanchain.kernels.compiling import njit

GRADIENT_DESCENT, NEWTON, GAUSS_NEWTON, LEVENBERG_MARQUARDT = 0, 1, 2, 3


@njit(nogil=True)
def step(optimizer: int, H, b, damping: float, factor, x) -> bool:
    """True if the normal equations could be solved; the step ξ of one iteration is written to ``x`` (k,).

    Gradient descent    ξ = −(bᵀb / bᵀHb) b, the exact minimizer along the gradient (Cauchy's point)
    Newton              ξ = −H⁻¹b with the full Hessian; where that is indefinite the diagonal is raised
    Gauss–Newton        ξ = −(JᵀJ)⁻¹Jᵀr
    Levenberg–Marquardt ξ = −(JᵀJ + λ diag(JᵀJ))⁻¹Jᵀr (Marquardt 1963)
    factor : (k, k), room for the factorization
    """
    k = b.shape[0]
    if optimizer == GRADIENT_DESCENT:
        along = square = 0.0
        for i in range(k):
            square += b[i] * b[i]
            for j in range(k):
                along += b[i] * H[i, j] * b[j]
        for i in range(k):
            x[i] = -b[i] * square / along if along > 0.0 else 0.0
        return along > 0.0
    if optimizer != LEVENBERG_MARQUARDT:
        damping = 0.0
    solved = solve(H, b, damping, factor, x)
    while not solved and optimizer == NEWTON and damping < 1e6:
        damping = max(4.0 * damping, 1e-3)
        solved = solve(H, b, damping, factor, x)
    return solved


@njit(nogil=True)
def solve(H, b, damping: float, factor, x) -> bool:
    """Write −(H + damping · diag(H))⁻¹ b to ``x`` by Cholesky; False where that is not positive definite."""
    if not factorize(H, damping, factor):
        return False
    substitute(factor, b, x)
    return True


@njit(nogil=True)
def factorize(H, damping: float, factor) -> bool:
    """Write L with L Lᵀ = H + damping · diag(H) to the lower half of ``factor``; False where there is none."""
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
def predicted_decrease(H, b, x) -> float:
    """Decrease of the quadratic model along the step, −bᵀx − ½ xᵀHx."""
    total = 0.0
    for i in range(b.shape[0]):
        row = b[i]
        for j in range(b.shape[0]):
            row += 0.5 * H[i, j] * x[j]
        total -= x[i] * row
    return total


@njit(nogil=True)
def relax(damping: float, gain: float) -> float:
    """The damping after an accepted step of gain ratio ρ: λ · max(⅓, 1 − (2ρ − 1)³) (Nielsen 1999)."""
    return damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
