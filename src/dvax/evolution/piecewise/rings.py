"""Lightly damped oscillations of a mode, taken out of a step and added in closed form.

A stray inductance and a stray capacitance ring for many periods, of which no step should have to follow
each one. With F = [[A, B], [C, M]] in the unknowns (x, p) of a mode, E = diag(1, 0), F v = λEv and
(l, m)F = λ(l, 0), l·v = 1, the coordinate ξ = l·x solves ξ' = λξ + l·g + m·r, r being what the rows of
the law have on the right. Where λ is large its solution is

    ξ = ae^{λt} − Σⱼ λ^{−j−1} (l·g + m·r)⁽ʲ⁾,

so that x − 2 Re(ae^{λt}v) is smooth, and |2av| bounds what the oscillation does to every unknown.
"""

from typing import NamedTuple

import numpy as np

Array = np.ndarray

_ROUNDS = 4
_TERMS = 12


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
    by inverse iteration on the pencil itself, which no small entry of M makes inaccurate."""
    E = np.zeros(len(F))
    E[:n] = 1.0
    found: list[Ring] = []
    for guess in guesses:
        rate = complex(guess)
        right = left = np.ones(len(F), complex)
        for _ in range(_ROUNDS):
            shifted = F - np.diag(rate * (1.0 + 1e-10) * E)
            scale = 1.0 / np.abs(shifted).max(axis=1)
            try:
                right = np.linalg.solve(scale[:, None] * shifted, scale * (E * right))
                left = scale * np.linalg.solve((scale[:, None] * shifted).T, E * left)
            except np.linalg.LinAlgError:
                break
            size = np.abs(right[:n]).max(), np.abs(left[:n]).max()
            if not (np.isfinite(size).all() and min(size) > 0):
                break
            right, left = right / size[0], left / size[1]
            product = left[:n] @ right[:n]
            if abs(product) < 1e-6 * np.abs(left[:n]) @ np.abs(right[:n]):
                break  # nearly defective: the oscillation is followed step by step
            rate = complex(left @ F @ right / product)
            if not rate.imag > 0.0:
                break  # none of these
        else:
            left = left / (left[:n] @ right[:n])
            known = any(abs(rate - other.rate) < 1e-6 * abs(rate) for other in found)
            near = abs(rate - guess) < 0.1 * abs(guess) and rate.imag > 0 >= rate.real
            if near and not known:
                found.append(Ring(rate, right[:n], right[n:], left[:n], left[n:]))
    return found


def derivatives(coefficients: Array, place: float, length: float) -> Array:
    """Those of the polynomial at a place in [0, 1] of a piece of this length, a row each order."""
    rows = []
    for _ in range(min(_TERMS, len(coefficients))):
        rows.append(np.polynomial.chebyshev.chebval(2.0 * place - 1.0, coefficients))
        coefficients = 2.0 / length * np.polynomial.chebyshev.chebder(coefficients)
    return np.array(rows)
