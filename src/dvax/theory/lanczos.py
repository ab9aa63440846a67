"""An upper bound on the largest eigenvalue of a symmetric map given by its action alone.

Lanczos' method approaches the eigenvalue from below. With a start vector uniform on the sphere, the
error after k steps exceeds ε(λ₁ − λₙ) with a probability of at most

    1.648 √n e^{−(2k−1)√ε}

(Kuczyński and Woźniakowski, SIAM J. Matrix Anal. Appl. 13 (1992) 1094, Theorem 4.2). The
probability is set to 10⁻¹². This determines ε before the computation, and the bound is θ + ε(λ₁ − λₙ).
"""

from collections.abc import Callable

import numpy as np

FAILURE_PROBABILITY = 1e-12
"""The probability, over the random start vector, that a bound does not hold."""

_MAX_STEPS = 240


def largest_eigenvalue_bound(
    apply: Callable[[np.ndarray], np.ndarray], size: int, least: float | None = None
) -> float:
    """Return a bound λ ≥ λ₁ for the symmetric map `apply` on vectors of length `size`.

    `least` is a lower bound of the spectrum; without it, one is computed in the same way.
    """
    theta_low, theta_high, epsilon = _ritz(apply, size)
    if epsilon == 0.0:
        return theta_high
    if least is None:
        # λ₁ − θ ≤ ε(λ₁ − λₙ) and θ' − λₙ ≤ ε(λ₁ − λₙ) give λ₁ − λₙ ≤ (θ − θ')/(1 − 2ε).
        return theta_high + epsilon * (theta_high - theta_low) / (1.0 - 2.0 * epsilon)
    return (theta_high - epsilon * least) / (1.0 - epsilon)


def _ritz(apply: Callable[[np.ndarray], np.ndarray], size: int) -> tuple[float, float, float]:
    """Return the smallest and largest Ritz value, and ε, which is 0 if the Krylov space is
    invariant."""
    steps = min(_MAX_STEPS, size)
    rng = np.random.default_rng(20260101)
    basis = np.zeros((steps, size))
    v = rng.standard_normal(size)
    v /= np.linalg.norm(v)
    diagonal, off = [], []
    for k in range(steps):
        basis[k] = v
        w = apply(v)
        diagonal.append(float(v @ w))
        # Orthogonalise twice, since one pass leaves components of rounding size.
        for _ in range(2):
            w = w - basis[: k + 1].T @ (basis[: k + 1] @ w)
        length = float(np.linalg.norm(w))
        scale = max(map(abs, [*diagonal, *off]), default=0.0)
        if length <= 1e-14 * max(scale, 1e-300) or k == steps - 1:
            break
        off.append(length)
        v = w / length
    count = len(diagonal)
    T = np.diag(diagonal) + np.diag(off[: count - 1], 1) + np.diag(off[: count - 1], -1)
    ritz = np.linalg.eigvalsh(T)
    # An invariant Krylov space contains every eigenvector with a component in the start vector. With
    # probability one that is every eigenvector, so the Ritz values include the extreme eigenvalues.
    if count < steps or count == size:
        return float(ritz[0]), float(ritz[-1]), 0.0
    root = np.log(1.648 * np.sqrt(size) / FAILURE_PROBABILITY) / (2 * count - 1)
    return float(ritz[0]), float(ritz[-1]), float(root**2)
