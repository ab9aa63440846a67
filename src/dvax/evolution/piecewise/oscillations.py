"""Lightly damped oscillations of a mode, subtracted from a step and added in closed form.

A stray inductance and a stray capacitance oscillate for many periods. Steps that resolve each period
would be expensive. Let F = [[A, B], [C, M]] in the unknowns (x, p) of a mode and E = diag(1, 0), with
F v = λEv, (l, m)F = λ(l, 0) and l·v = 1. Then ξ = l·x solves ξ' = λξ + l·g + m·r, where r is the
right-hand side of the law. For large |λ| its solution is

    ξ = ae^{λt} − Σⱼ λ^{−j−1} (l·g + m·r)⁽ʲ⁾.

Hence x − 2 Re(ae^{λt}v) is smooth, and |2av| bounds the oscillation of every unknown.
"""

from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray

_ITERATIONS = 4
_TERMS = 12
_CLUSTER_WIDTH = 1e-2
"""Largest relative distance of two eigenvalues that belong to one cluster."""

_MAX_CONDITION = 1e6
"""Condition number above which the eigenvectors of a cluster are too inaccurate."""


class Oscillation(NamedTuple):
    """An eigenvalue `rate` = λ with Im λ > 0, its right eigenvector (`x`, `p`) and its left eigenvector
    (`left`, `law`) = (l, m)."""

    rate: complex
    x: Array
    p: Array
    left: Array
    law: Array

    def amplitude(self, x0: Array, derivatives: Array) -> complex:
        """Return a, from x and the `derivatives` of (g, r) at the start, one row per order."""
        forced = derivatives @ np.concatenate([self.left, self.law])
        total, power, last = 0j, 1.0 / self.rate, np.inf
        for value in forced:
            term = power * value
            if abs(term) > last:
                break
            total, power, last = total - term, power / self.rate, abs(term)
        return complex(self.left @ x0 - total)


def find_oscillations(F: Array, n: int, guesses: Array) -> list[Oscillation]:
    """Return the oscillations of the pencil (F, E) with eigenvalues near `guesses`.

    Inverse iteration on the pencil itself stays accurate when M has small entries. Guesses that are
    close to each other, as in symmetric circuits, are iterated as one block.
    """
    return [
        oscillation
        for near in _clusters(guesses)
        for oscillation in _cluster_oscillations(F, n, near)
    ]


def _clusters(guesses: Array) -> list[Array]:
    """Return the clusters of guesses: chains in which each guess is close to the next."""
    clusters: list[list[complex]] = []
    for guess in sorted(map(complex, guesses), key=abs):
        near = (
            c
            for c in clusters
            if any(abs(guess - other) < _CLUSTER_WIDTH * abs(guess) for other in c)
        )
        cluster = next(near, None)
        if cluster is None:
            clusters.append([guess])
        else:
            cluster.append(guess)
    return [np.array(cluster) for cluster in clusters]


def _cluster_oscillations(F: Array, n: int, guesses: Array) -> list[Oscillation]:
    """Return all oscillations of a cluster, or an empty list if the iteration fails.

    Steps then resolve these oscillations.
    """
    count, middle = len(guesses), complex(np.mean(guesses))
    # Start from columns that remain independent under any symmetry of the circuit.
    right = np.cos(np.outer(1.0 + np.arange(len(F)), np.arange(count))) + 0j
    left = right
    rates: Any = np.full(count, middle)
    try:
        for _ in range(_ITERATIONS):
            right, left = _inverse_iteration(F, n, complex(rates.mean()), right, left)
            rates, right, left = _eigenvectors(F, n, _basis(right, n), _basis(left, n))
        # The projected problem determines the eigenvectors of close eigenvalues to few digits only.
        for _ in range(_ITERATIONS if count > 1 else 0):
            pairs = [
                _inverse_iteration(F, n, complex(rate), right[:, k : k + 1], left[:, k : k + 1])
                for k, rate in enumerate(rates)
            ]
            right, left = (np.hstack(side) for side in zip(*pairs, strict=True))
            right, left = right / np.abs(right[:n]).max(axis=0), left / np.abs(left[:n]).max(axis=0)
            product = left[:n].T @ right[:n]
            left = np.linalg.solve(product, left.T).T
            rates = np.einsum("ik,ij,jk->k", left, F, right)
    except np.linalg.LinAlgError:
        return []
    near = np.abs(rates - middle) < 0.1 * abs(middle)
    if not (near & (rates.imag > 0.0) & (rates.real <= 0.0)).all():
        return []
    return [
        Oscillation(complex(rate), x[:n], x[n:], y[:n], y[n:])
        for rate, x, y in zip(rates, right.T, left.T, strict=True)
    ]


def _inverse_iteration(
    F: Array, n: int, rate: complex, right: Array, left: Array
) -> tuple[Array, Array]:
    """Return right and left vectors after one step of inverse iteration with shift `rate`."""
    if not rate.imag > 0.0:
        raise np.linalg.LinAlgError
    E = np.zeros((len(F), 1))
    E[:n] = 1.0
    shifted = F - np.diag(rate * (1.0 + 1e-10) * E[:, 0])
    scale = 1.0 / np.abs(shifted).max(axis=1, keepdims=True)
    right = np.linalg.solve(scale * shifted, scale * (E * right))
    return right, scale * np.linalg.solve((scale * shifted).T, E * left)


def _eigenvectors(F: Array, n: int, right: Array, left: Array) -> tuple[Array, Array, Array]:
    """Return eigenvalues with their right and left vectors, from bases of the two invariant subspaces,
    normalised by left · right = 1."""
    product = left[:n].T @ right[:n]
    rates, mixed = np.linalg.eig(np.linalg.solve(product, left.T @ F @ right))
    if max(np.linalg.cond(product), np.linalg.cond(mixed)) > _MAX_CONDITION:
        raise np.linalg.LinAlgError
    return rates, right @ mixed, np.linalg.solve(product @ mixed, left.T).T


def _basis(block: Array, n: int) -> Array:
    """Return a basis of the same space whose state parts are orthogonal after row scaling."""
    size = np.abs(block[:n]).max(axis=1, keepdims=True)
    _, r = np.linalg.qr(block[:n] / np.where(size > 0.0, size, 1.0))
    return np.linalg.solve(r.T, block.T).T


def derivatives(coefficients: Array, position: float, length: float) -> Array:
    """Return the derivatives of a polynomial at a position in [0, 1] of a piece, one row per order."""
    rows = []
    for _ in range(min(_TERMS, len(coefficients))):
        rows.append(np.polynomial.chebyshev.chebval(2.0 * position - 1.0, coefficients))
        coefficients = 2.0 / length * np.polynomial.chebyshev.chebder(coefficients)
    return np.array(rows)
