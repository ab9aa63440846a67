"""Radau IIA collocation of high order, and rigorous signs of the polynomials that it computes.

On a step of length h the state is a polynomial of degree s through its values at θ = 0 and at the s
right Radau points, the last of which is θ = 1; it satisfies the equations at these points. The method
is L-stable and stiffly accurate of order 2s − 1 (Hairer and Wanner 1996, Section IV.5), and for the
differential-algebraic form, in which it is used here, the limit of infinite stiffness is a regular one.

The residual of a linear equation in polynomials of degree s that vanishes at the Radau points is a
multiple of ρ(θ) = Π(θ − cᵢ), and |ρ| is largest at θ = 0: one evaluation there bounds it on the step.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

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


class Wave(NamedTuple):
    """θ ↦ 2 Re ce^{μθ}, with Re μ ≤ 0: `rate` is μ, `amplitude` c."""

    rate: complex
    amplitude: complex


class _Sum:
    """A polynomial, by its values on the grid, and waves."""

    def __init__(self, values: Array, waves: Sequence[Wave]):
        self.value = COEFFICIENTS @ values[::_DENSITY]
        self.slope = 2.0 * np.polynomial.chebyshev.chebder(self.value)
        bend = 2.0 * np.polynomial.chebyshev.chebder(self.slope)
        on_grid = np.polynomial.chebyshev.chebval(2.0 * GRID - 1.0, bend)
        self.bend = (1.0 + _MARGIN) * float(np.abs(on_grid).max())
        self.rates = np.array([wave.rate for wave in waves])[:, None]
        self.amplitudes = 2.0 * np.array([wave.amplitude for wave in waves])[:, None]

    def __call__(self, theta: Any) -> Any:
        waves = self.amplitudes * np.exp(self.rates * theta)
        found = np.polynomial.chebyshev.chebval(2.0 * theta - 1.0, self.value)
        return found + waves.real.sum(axis=0)

    def bounds(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Lower bounds on the intervals [a, b], and whether the sum is monotone there: by the slopes in
        the middle and bounds of the second derivatives, and for waves by their amplitudes as well."""
        middle, half = 0.5 * (a + b), 0.5 * (b - a)
        waves = self.amplitudes * np.exp(self.rates * middle)
        size = np.abs(self.amplitudes) * np.exp(np.real(self.rates) * a)
        value = np.polynomial.chebyshev.chebval(2.0 * middle - 1.0, self.value)
        slope = np.polynomial.chebyshev.chebval(2.0 * middle - 1.0, self.slope)
        both = slope + (self.rates * waves).real.sum(axis=0)
        bend = self.bend + (np.abs(self.rates) ** 2 * size).sum(axis=0)
        centred = value + waves.real.sum(axis=0) - (np.abs(both) + 0.5 * bend * half) * half
        apart = value - (np.abs(slope) + 0.5 * self.bend * half) * half - size.sum(axis=0)
        return np.maximum(centred, apart), np.abs(both) >= bend * half


def first_negative(
    values: Array, slack: float, until: float = 1.0, waves: Sequence[Wave] = ()
) -> tuple[float, bool]:
    """Return (θ, True), the first θ in [0, until] where a polynomial with `waves` beside it passes from
    above to below zero and goes on below −`slack`; (θ, False) where it stays above −`slack` up to θ.

    That θ is `until` unless the search takes more than `_MOST_INTERVALS`. `values` are those of the
    polynomial on the grid. An interval is left where bounds on the function decide it, and halved
    otherwise.
    """
    function = _Sum(values, waves)
    if function(0.0) < -slack:
        return 0.0, True
    a, b, negative = np.zeros(1), np.full(1, until), False
    while len(a):
        low, monotone = function.bounds(a, b)
        at_a, at_b = function(a), function(b)
        below = np.flatnonzero(at_b < -slack)
        if len(below):
            # What comes after the first value below −slack does not matter.
            last = below[0] + 1
            a, b, low, monotone = a[:last], b[:last], low[:last], monotone[:last]
            at_a, at_b = at_a[:last], at_b[:last]
            until, negative = float(b[-1]), True
        open_ = (low < -slack) & ~(monotone & (at_a >= -slack) & (at_b >= -slack))
        a, b, monotone = a[open_], b[open_], monotone[open_]
        if not len(a):
            break
        shortest = b[0] - a[0] <= 4.0 * np.finfo(float).eps
        if negative and len(a) == 1 and b[0] == until and (shortest or monotone[0]):
            start = float(a[0])
            if function(start) <= 0.0:
                # Within the slack it has been negative for longer.
                before = GRID[start > GRID]
                above = np.flatnonzero(function(before) > 0.0)
                start = float(before[above[-1]]) if len(above) else 0.0
            return _bisected(function, start, until), True
        wide = b - a > 4.0 * np.finfo(float).eps
        wide |= negative & (b == until)
        a, b = a[wide], b[wide]
        middle = 0.5 * (a + b)
        a, b = np.stack([a, middle], axis=1).ravel(), np.stack([middle, b], axis=1).ravel()
        if len(a) > _MOST_INTERVALS:
            until, negative = float(a[_MOST_INTERVALS // 2]), False
            a, b = a[: _MOST_INTERVALS // 2], b[: _MOST_INTERVALS // 2]
    return until, negative


_MOST_INTERVALS = 1 << 17


def _bisected(value: Callable[[float], float], a: float, b: float) -> float:
    """The last floating point number before a sign change; a where the value is not positive there."""
    if value(a) <= 0.0:
        return a
    while True:
        middle = 0.5 * (a + b)
        if middle in (a, b):
            return a
        a, b = (middle, b) if value(middle) > 0.0 else (a, middle)


def mean_residual(used: float) -> float:
    """A bound on the mean of |ρ| up to θ = `used`, relative to |ρ(0)|."""
    return min(1.0, MEAN_RESIDUAL / used) if used > 0.0 else 1.0
