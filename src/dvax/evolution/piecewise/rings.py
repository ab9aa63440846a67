"""Lightly damped oscillations of a mode, taken out of a step and added in closed form.

A stray inductance and a stray capacitance ring for many periods, of which no step should have to follow
each one. With F = [[A, B], [C, M]] in the unknowns (x, p) of a mode, E = diag(1, 0), F v = λEv and
(l, m)F = λ(l, 0), l·v = 1, the coordinate ξ = l·x solves ξ' = λξ + l·g + m·r, r being what the rows of
the law have on the right. Where λ is large its solution is

    ξ = ae^{λt} − Σⱼ λ^{−j−1} (l·g + m·r)⁽ʲ⁾,

so that x − 2 Re(ae^{λt}v) is smooth, and |2av| bounds what the oscillation does to every unknown.
"""

from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray

_ROUNDS = 4
_TERMS = 12
_CLOSE = 1e-2
"""Rates this close to each other, relative to their size, are found together."""

_DEFECTIVE = 1e6
"""Condition numbers above which a cluster has no eigenvectors of its own."""


class Ring(NamedTuple):
    """λ with Im λ > 0, (x, p) of its right and (l, m) of its left eigenvector."""

    rate: complex
    x: Array
    p: Array
    left: Array
    law: Array

    def amplitude(self, x0: Array, derivatives: Array) -> complex:
        """a, from x at the start and the `derivatives` of (g, r) there, a row each order."""
        forced = derivatives @ np.concatenate([self.left, self.law])
        total, power, last = 0j, 1.0 / self.rate, np.inf
        for value in forced:
            term = power * value
            if abs(term) > last:
                break
            total, power, last = total - term, power / self.rate, abs(term)
        return complex(self.left @ x0 - total)


def rings(F: Array, n: int, guesses: Array) -> list[Ring]:
    """Those of the pencil (F, E) whose eigenvalues are near the `guesses` with positive imaginary part;
    by inverse iteration on the pencil itself, which no small entry of M makes inaccurate. Guesses that
    are close to each other, as symmetric circuits have them, are iterated as one block."""
    return [ring for near in _clusters(guesses) for ring in _cluster_rings(F, n, near)]


def _clusters(guesses: Array) -> list[Array]:
    """Chains of guesses, each close to the next."""
    found: list[list[complex]] = []
    for guess in sorted(map(complex, guesses), key=abs):
        near = (c for c in found if any(abs(guess - other) < _CLOSE * abs(guess) for other in c))
        cluster = next(near, None)
        if cluster is None:
            found.append([guess])
        else:
            cluster.append(guess)
    return [np.array(cluster) for cluster in found]


def _cluster_rings(F: Array, n: int, guesses: Array) -> list[Ring]:
    """All of a cluster, or none: then these oscillations are followed step by step."""
    count, middle = len(guesses), complex(np.mean(guesses))
    # Columns that no symmetry of the circuit makes alike.
    right = np.cos(np.outer(1.0 + np.arange(len(F)), np.arange(count))) + 0j
    left = right
    rates: Any = np.full(count, middle)
    try:
        for _ in range(_ROUNDS):
            right, left = _inverse_iteration(F, n, complex(rates.mean()), right, left)
            rates, right, left = _eigenvectors(F, n, _basis(right, n), _basis(left, n))
        # The small problem knows vectors of rates that are near each other to few digits.
        for _ in range(_ROUNDS if count > 1 else 0):
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
        Ring(complex(rate), x[:n], x[n:], y[:n], y[n:])
        for rate, x, y in zip(rates, right.T, left.T, strict=True)
    ]


def _inverse_iteration(
    F: Array, n: int, rate: complex, right: Array, left: Array
) -> tuple[Array, Array]:
    """One step of inverse iteration from both sides, near a rate."""
    if not rate.imag > 0.0:
        raise np.linalg.LinAlgError
    E = np.zeros((len(F), 1))
    E[:n] = 1.0
    shifted = F - np.diag(rate * (1.0 + 1e-10) * E[:, 0])
    scale = 1.0 / np.abs(shifted).max(axis=1, keepdims=True)
    right = np.linalg.solve(scale * shifted, scale * (E * right))
    return right, scale * np.linalg.solve((scale * shifted).T, E * left)


def _eigenvectors(F: Array, n: int, right: Array, left: Array) -> tuple[Array, Array, Array]:
    """Rates, and right and left vectors for each in the spaces of these, with left · right = 1."""
    product = left[:n].T @ right[:n]
    rates, mixed = np.linalg.eig(np.linalg.solve(product, left.T @ F @ right))
    if max(np.linalg.cond(product), np.linalg.cond(mixed)) > _DEFECTIVE:
        raise np.linalg.LinAlgError
    return rates, right @ mixed, np.linalg.solve(product @ mixed, left.T).T


def _basis(block: Array, n: int) -> Array:
    """The same space, with columns that differ in their states."""
    size = np.abs(block[:n]).max(axis=1, keepdims=True)
    _, r = np.linalg.qr(block[:n] / np.where(size > 0.0, size, 1.0))
    return np.linalg.solve(r.T, block.T).T


def derivatives(coefficients: Array, place: float, length: float) -> Array:
    """Those of the polynomial at a place in [0, 1] of a piece of this length, a row each order."""
    rows = []
    for _ in range(min(_TERMS, len(coefficients))):
        rows.append(np.polynomial.chebyshev.chebval(2.0 * place - 1.0, coefficients))
        coefficients = 2.0 / length * np.polynomial.chebyshev.chebder(coefficients)
    return np.array(rows)
