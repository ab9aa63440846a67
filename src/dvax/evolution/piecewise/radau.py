"""Radau IIA collocation of high order, and rigorous signs of the polynomials that it computes.

On a step of length h the state is a polynomial of degree s through its values at θ = 0 and at the s
right Radau points, the last of which is θ = 1; it satisfies the equations at these points. The method
is L-stable and stiffly accurate of order 2s − 1 (Hairer and Wanner 1996, Section IV.5), and for the
differential-algebraic form, in which it is used here, the limit of infinite stiffness is a regular one.

The residual of a linear equation in polynomials of degree s that vanishes at the Radau points is a
multiple of ρ(θ) = Π(θ − cᵢ), and |ρ| is largest at θ = 0: one evaluation there bounds it on the step.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.special

Array = np.ndarray

STAGES = 20
"""Stages: e^{−8θ} and cos 4θ are then resolved to 10⁻¹²."""


def _weights(nodes: Array) -> Array:
    """Barycentric weights."""
    apart = nodes[:, None] - nodes[None, :]
    np.fill_diagonal(apart, 1.0)
    # Four times as far apart, so that products neither overflow nor underflow.
    return 1.0 / np.prod(4.0 * apart, axis=1)


def interpolation(nodes: Array, at: Array) -> Array:
    """The matrix from values at the nodes to values of their polynomial `at` other points."""
    return _barycentric(nodes, _weights(nodes), np.asarray(at))


def _barycentric(nodes: Array, weights: Array, at: Array) -> Array:
    apart = at[:, None] - nodes
    exact = apart == 0.0
    if not exact.any():
        terms = weights / apart
        return terms / terms.sum(axis=1, keepdims=True)
    terms = weights / np.where(exact, 1.0, apart)
    rows = terms / terms.sum(axis=1, keepdims=True)
    return np.where(exact.any(axis=1)[:, None], exact.astype(float), rows)


def _differentiation(nodes: Array) -> Array:
    """The matrix from values at the nodes to derivatives there."""
    w = _weights(nodes)
    apart = nodes[:, None] - nodes[None, :]
    np.fill_diagonal(apart, 1.0)
    D = w[None, :] / w[:, None] / apart
    np.fill_diagonal(D, 0.0)
    # Derivatives of a constant are zero to the last digit.
    np.fill_diagonal(D, -D.sum(axis=1))
    return D


def _lobatto(count: int) -> Array:
    """Chebyshev–Lobatto points of [0, 1]."""
    return 0.5 - 0.5 * np.cos(np.pi * np.arange(count + 1) / count)


POINTS = np.append(0.5 + 0.5 * scipy.special.roots_jacobi(STAGES - 1, 1, 0)[0], 1.0)
"""The collocation points c in (0, 1]."""

NODES = np.concatenate([[0.0], POINTS])
"""0 and the collocation points: a state is known there."""

D = _differentiation(NODES)
"""dx/dθ at the nodes from x at the nodes."""

_DENSITY = 8
_OF_NODES, _OF_POINTS = _weights(NODES), _weights(POINTS)


def state_at(x: Array, thetas: Array) -> Array:
    """States at these θ, a row each, from those at the nodes."""
    return _barycentric(NODES, _OF_NODES, thetas) @ x


def multiplier_at(y: Array, thetas: Array) -> Array:
    """Multipliers at these θ, a row each, from those at the collocation points."""
    return _barycentric(POINTS, _OF_POINTS, thetas) @ y


GRID = _lobatto(_DENSITY * STAGES)
"""Where polynomials are sampled for their signs."""

FROM_NODES = interpolation(NODES, GRID)
"""x on the grid from x at the nodes."""

FROM_POINTS = interpolation(POINTS, GRID)
"""The multipliers on the grid from their values at the collocation points."""

START = interpolation(POINTS, np.zeros(1))[0]
"""The multipliers at θ = 0, from their values at the collocation points."""

_MARGIN = 1.0 / np.cos(0.5 * np.pi / _DENSITY) - 1.0
"""|p| ≤ (1 + this) max over the grid, for degrees up to STAGES (Ehlich and Zeller 1964)."""

_EXTREMES = _lobatto(STAGES)
COEFFICIENTS = np.linalg.inv(np.polynomial.chebyshev.chebvander(2 * _EXTREMES - 1, STAGES))
TAIL_OF_STATE = (COEFFICIENTS @ interpolation(NODES, _EXTREMES))[-2:]
"""The last two Chebyshev coefficients of a state, from its values at the nodes."""

TAIL_OF_MULTIPLIER = (COEFFICIENTS @ interpolation(POINTS, _EXTREMES))[-3:-1]
"""The last two of a multiplier, from its values at the collocation points."""

_RHO = np.abs(np.prod(np.linspace(0, 1, 4001)[:, None] - POINTS, axis=1))
MEAN_RESIDUAL = float(_RHO.mean() / _RHO[0])
"""∫ |ρ| dθ / |ρ(0)|."""


def lowest(values: Array) -> Any:
    """A lower bound of polynomials on [0, 1], a column each, from their values on the grid."""
    low, high = values.min(axis=0), values.max(axis=0)
    return low - 0.5 * _MARGIN * (high - low)


def first_negative(values: Array, slack: float, until: float = 1.0) -> float | None:
    """The first θ in [0, until] where a polynomial passes from above to below zero and goes on below
    −`slack`; None where it stays above −2 `slack`. `values` are those on the grid.

    An interval is left when bounds on the polynomial or on its slope decide it, and halved otherwise.
    """
    coefficients = COEFFICIENTS @ values[::_DENSITY]
    slopes = 2.0 * np.polynomial.chebyshev.chebder(coefficients)

    def value(theta: float) -> float:
        return float(np.polynomial.chebyshev.chebval(2.0 * theta - 1.0, coefficients))

    if value(0.0) < -slack:
        return 0.0
    waiting = [(0.0, until)]
    while waiting:
        a, b = waiting.pop()
        points = 2.0 * (a + (b - a) * GRID) - 1.0
        inside = np.polynomial.chebyshev.chebval(points, coefficients)
        if lowest(inside) >= -slack:
            continue
        slope = np.polynomial.chebyshev.chebval(points, slopes)
        fall = slack / (b - a)
        if inside[0] >= -slack and inside[-1] >= -slack and lowest(slope) >= -fall:
            continue
        shortest = b - a <= 4.0 * np.finfo(float).eps
        if inside[-1] < -slack and (shortest or lowest(-slope) >= -fall):
            return _bisected(value, a, b)
        if not shortest:
            middle = 0.5 * (a + b)
            waiting += [(middle, b), (a, middle)]
    return None


def _bisected(value: Callable[[float], float], a: float, b: float) -> float:
    """The last floating point number before a sign change; a where the value is not positive there."""
    if value(a) <= 0.0:
        return a
    while True:
        middle = 0.5 * (a + b)
        if middle in (a, b):
            return a
        a, b = (middle, b) if value(middle) > 0.0 else (a, middle)
