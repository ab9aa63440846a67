"""The largest eigenvalue of a symmetric map that is known by its action alone, from above.

Lanczos' method approaches it from below. With a start drawn evenly from the sphere, k steps miss the
largest eigenvalue λ₁ by more than ε(λ₁ − λₙ) with a probability of at most

    1.648 √n e^{−(2k−1)√ε}

(Kuczyński and Woźniakowski, SIAM J. Matrix Anal. Appl. 13 (1992) 1094, Theorem 4.2). So with the
probability set to 10⁻¹², ε is known before anything is computed, and the bound is θ + ε(λ₁ − λₙ).
"""

from collections.abc import Callable

import numpy as np

CHANCE = 1e-12
"""The probability that a bound does not hold, over the random start."""

_STEPS = 240


def greatest(
    apply: Callable[[np.ndarray], np.ndarray], size: int, least: float | None = None
) -> float:
    """A bound λ ≥ λ₁ of the symmetric map `apply` on vectors of this size.

    `least` is a bound from below on its spectrum; without it, one is computed in the same way.
    """
    theta_low, theta_high, epsilon = _ritz(apply, size)
    if epsilon == 0.0:
        return theta_high
    if least is None:
        # λ₁ − θ ≤ ε(λ₁ − λₙ) and θ' − λₙ ≤ ε(λ₁ − λₙ) give λ₁ − λₙ ≤ (θ − θ')/(1 − 2ε).
        return theta_high + epsilon * (theta_high - theta_low) / (1.0 - 2.0 * epsilon)
    return (theta_high - epsilon * least) / (1.0 - epsilon)


def _ritz(apply: Callable[[np.ndarray], np.ndarray], size: int) -> tuple[float, float, float]:
    """The ends of the Ritz values, and ε; 0 where the Krylov space is the whole space."""
    steps = min(_STEPS, size)
    rng = np.random.default_rng(20260101)
    basis = np.zeros((steps, size))
    v = rng.standard_normal(size)
    v /= np.linalg.norm(v)
    diagonal, off = [], []
    for k in range(steps):
        basis[k] = v
        w = apply(v)
        diagonal.append(float(v @ w))
        # Twice, so that rounding does not bring back what was found before.
        for _ in range(2):
            w = w - basis[: k + 1].T @ (basis[: k + 1] @ w)
        length = float(np.linalg.norm(w))
        scale = max(map(abs, [*diagonal, *off]), default=0.0)
        if length <= 1e-14 * max(scale, 1e-300) or k == steps - 1:
            break
        off.append(length)
        v = w / length
    taken = len(diagonal)
    T = np.diag(diagonal) + np.diag(off[: taken - 1], 1) + np.diag(off[: taken - 1], -1)
    ritz = np.linalg.eigvalsh(T)
    # A space that is left no more holds every eigenvector that the start has a part of, and by chance
    # it has a part of all: what it found are eigenvalues, the ends among them.
    if taken < steps or taken == size:
        return float(ritz[0]), float(ritz[-1]), 0.0
    root = np.log(1.648 * np.sqrt(size) / CHANCE) / (2 * taken - 1)
    return float(ritz[0]), float(ritz[-1]), float(root**2)
