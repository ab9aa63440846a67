"""Radau IIA collocation of high order, and rigorous sign tests of the computed polynomials.

On a step of length h the state is a polynomial of degree s. It interpolates the values at θ = 0 and at
the s right Radau points, the last of which is θ = 1, and satisfies the equations at these points. The
method is L-stable and stiffly accurate of order 2s − 1 (Hairer and Wanner 1996, Section IV.5). It is
used here in its differential-algebraic form, in which the limit of infinite stiffness is regular.

The residual of a linear equation is a polynomial of degree s that vanishes at the Radau points, hence
a multiple of ρ(θ) = Π(θ − cᵢ). As |ρ| is largest at θ = 0, one evaluation there bounds the residual on
the step.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import legendre

Array = np.ndarray

STAGES = 20
"""Number of stages; polynomials of this degree resolve e^{−8θ} and cos 4θ on [0, 1] to 10⁻¹²."""


def _weights(nodes: Array) -> Array:
    """Return the barycentric weights."""
    differences = nodes[:, None] - nodes[None, :]
    np.fill_diagonal(differences, 1.0)
    # Scale by the capacity of the interval, 1/4, so that products neither overflow nor underflow.
    return 1.0 / np.prod(4.0 * differences, axis=1)


def interpolation(nodes: Array, points: Array) -> Array:
    """Return the matrix that maps values at the nodes to values of the interpolant at `points`."""
    return _barycentric(nodes, _weights(nodes), np.asarray(points))


def _barycentric(nodes: Array, weights: Array, points: Array) -> Array:
    differences = points[:, None] - nodes
    is_node = differences == 0.0
    if not is_node.any():
        terms = weights / differences
        return terms / terms.sum(axis=1, keepdims=True)
    terms = weights / np.where(is_node, 1.0, differences)
    rows = terms / terms.sum(axis=1, keepdims=True)
    return np.where(is_node.any(axis=1)[:, None], is_node.astype(float), rows)


def _differentiation(nodes: Array) -> Array:
    """Return the matrix that maps values at the nodes to derivatives at the nodes."""
    w = _weights(nodes)
    differences = nodes[:, None] - nodes[None, :]
    np.fill_diagonal(differences, 1.0)
    D = w[None, :] / w[:, None] / differences
    np.fill_diagonal(D, 0.0)
    # Negative row sums make the derivative of a constant exactly zero.
    np.fill_diagonal(D, -D.sum(axis=1))
    return D


def _lobatto(count: int) -> Array:
    """Return the Chebyshev–Lobatto points of [0, 1]."""
    return 0.5 - 0.5 * np.cos(np.pi * np.arange(count + 1) / count)


def _radau(stages: int) -> Array:
    """Return the right Radau points of [0, 1], where the Legendre polynomials P_{s−1} and P_s of
    [−1, 1] are equal."""
    difference = np.append(np.zeros(stages - 1), [1.0, -1.0])
    # Complex numbers without imaginary parts, from NumPy 2.5 on. The last root is 1.
    roots = np.sort(legendre.legroots(difference).real)[:-1]
    derivative = legendre.legder(difference)
    # A step of Newton's method takes the roundoff of the eigenvalues away.
    roots -= legendre.legval(roots, difference) / legendre.legval(roots, derivative)
    return np.append(0.5 + 0.5 * roots, 1.0)


POINTS = _radau(STAGES)
"""The collocation points c in (0, 1]."""

NODES = np.concatenate([[0.0], POINTS])
"""0 and the collocation points: the nodes of the state polynomial."""

D = _differentiation(NODES)
"""The differentiation matrix: dx/dθ at the nodes from x at the nodes."""

_GRID_DENSITY = 8
_NODE_WEIGHTS, _POINT_WEIGHTS = _weights(NODES), _weights(POINTS)


def state_at(x: Array, thetas: Array) -> Array:
    """Return the state polynomial at `thetas`, one row each, from its values at the nodes."""
    return _barycentric(NODES, _NODE_WEIGHTS, thetas) @ x


def multiplier_at(y: Array, thetas: Array) -> Array:
    """Return the multiplier polynomial at `thetas`, one row each, from its values at the points."""
    return _barycentric(POINTS, _POINT_WEIGHTS, thetas) @ y


GRID = _lobatto(_GRID_DENSITY * STAGES)
"""The points at which the sign tests sample polynomials."""

NODES_TO_GRID = interpolation(NODES, GRID)
"""Maps a state from the nodes to the grid."""

POINTS_TO_GRID = interpolation(POINTS, GRID)
"""Maps a multiplier from the collocation points to the grid."""

POINTS_TO_START = interpolation(POINTS, np.zeros(1))[0]
"""Maps a multiplier from the collocation points to θ = 0."""

_MARGIN = 1.0 / np.cos(0.5 * np.pi / _GRID_DENSITY) - 1.0
"""max |p| on [0, 1] ≤ (1 + _MARGIN) max |p| on the grid, up to degree STAGES (Ehlich and Zeller
1964)."""

EXTREMES = _lobatto(STAGES)
"""The points at which Chebyshev coefficients are computed."""

COEFFICIENTS = np.linalg.inv(np.polynomial.chebyshev.chebvander(2 * EXTREMES - 1, STAGES))
"""Maps values at `EXTREMES` to Chebyshev coefficients."""

TAIL_OF_STATE = (COEFFICIENTS @ interpolation(NODES, EXTREMES))[-2:]
"""Maps a state at the nodes to its last two Chebyshev coefficients."""

TAIL_OF_MULTIPLIER = (COEFFICIENTS @ interpolation(POINTS, EXTREMES))[-3:-1]
"""Maps a multiplier at the collocation points to its last two Chebyshev coefficients."""

_RHO = np.abs(np.prod(np.linspace(0, 1, 4001)[:, None] - POINTS, axis=1))
MEAN_RESIDUAL = float(_RHO.mean() / _RHO[0])
"""∫ |ρ| dθ / |ρ(0)|."""


def lowest(values: Array) -> Any:
    """Return a lower bound of polynomials on [0, 1], one column each, from their values on the grid."""
    low, high = values.min(axis=0), values.max(axis=0)
    return low - 0.5 * _MARGIN * (high - low)


class Wave(NamedTuple):
    """The function θ ↦ 2 Re ce^{μθ} with `rate` μ, Re μ ≤ 0, and `amplitude` c."""

    rate: complex
    amplitude: complex


class Sum:
    """The sum of a polynomial, given by its values on the grid, and of waves."""

    def __init__(self, values: Array, waves: Sequence[Wave]):
        self.value = COEFFICIENTS @ values[::_GRID_DENSITY]
        self.slope = 2.0 * np.polynomial.chebyshev.chebder(self.value)
        second = 2.0 * np.polynomial.chebyshev.chebder(self.slope)
        on_grid = np.polynomial.chebyshev.chebval(2.0 * GRID - 1.0, second)
        self.curvature = (1.0 + _MARGIN) * float(np.abs(on_grid).max())
        self.rates = np.array([wave.rate for wave in waves])[:, None]
        self.amplitudes = 2.0 * np.array([wave.amplitude for wave in waves])[:, None]

    def __call__(self, theta: Any) -> Any:
        waves = self.amplitudes * np.exp(self.rates * theta)
        polynomial = np.polynomial.chebyshev.chebval(2.0 * theta - 1.0, self.value)
        return polynomial + waves.real.sum(axis=0)

    def bounds(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Return lower bounds on the intervals [a, b], and whether the sum is monotone on each.

        A Taylor expansion at the midpoint with a bound on the second derivative gives one lower bound.
        The polynomial's expansion minus the amplitudes of the waves gives another one.
        """
        middle, half = 0.5 * (a + b), 0.5 * (b - a)
        waves = self.amplitudes * np.exp(self.rates * middle)
        size = np.abs(self.amplitudes) * np.exp(np.real(self.rates) * a)
        value = np.polynomial.chebyshev.chebval(2.0 * middle - 1.0, self.value)
        slope = np.polynomial.chebyshev.chebval(2.0 * middle - 1.0, self.slope)
        total_slope = slope + (self.rates * waves).real.sum(axis=0)
        curvature = self.curvature + (np.abs(self.rates) ** 2 * size).sum(axis=0)
        expansion = (
            value + waves.real.sum(axis=0) - (np.abs(total_slope) + 0.5 * curvature * half) * half
        )
        separate = value - (np.abs(slope) + 0.5 * self.curvature * half) * half - size.sum(axis=0)
        return np.maximum(expansion, separate), np.abs(total_slope) >= curvature * half


def first_negative(
    values: Array, slack: float, until: float = 1.0, waves: Sequence[Wave] = ()
) -> tuple[float, bool]:
    """Return the first θ in [0, until] at which a function becomes negative, and whether there is one.

    The function is the sum of a polynomial, given by its `values` on the grid, and of `waves`. The
    result is (θ, True) if it decreases through zero at θ and then below −`slack`. It is (θ, False) if
    the function stays above −`slack` up to θ; this θ is `until`, unless the search needs more than
    `_MAX_INTERVALS` intervals.

    Branch and bound: discard an interval if the bounds decide its sign, bisect it otherwise.
    """
    function = Sum(values, waves)
    if function(0.0) < -slack:
        return 0.0, True
    a, b, negative = np.zeros(1), np.full(1, until), False
    while len(a):
        low, monotone = function.bounds(a, b)
        at_a, at_b = function(a), function(b)
        below = np.flatnonzero(at_b < -slack)
        if len(below):
            # Discard the intervals after the first value below −slack.
            last = below[0] + 1
            a, b, low, monotone = a[:last], b[:last], low[:last], monotone[:last]
            at_a, at_b = at_a[:last], at_b[:last]
            until, negative = float(b[-1]), True
        undecided = (low < -slack) & ~(monotone & (at_a >= -slack) & (at_b >= -slack))
        a, b, monotone = a[undecided], b[undecided], monotone[undecided]
        if not len(a):
            break
        shortest = b[0] - a[0] <= 4.0 * np.finfo(float).eps
        if negative and len(a) == 1 and b[0] == until and (shortest or monotone[0]):
            start = float(a[0])
            if function(start) <= 0.0:
                # The function was negative before, within the slack: start from its last positive
                # sample.
                before = GRID[start > GRID]
                above = np.flatnonzero(function(before) > 0.0)
                start = float(before[above[-1]]) if len(above) else 0.0
            return _bisect(function, start, until), True
        divisible = b - a > 4.0 * np.finfo(float).eps
        divisible |= negative & (b == until)
        a, b = a[divisible], b[divisible]
        middle = 0.5 * (a + b)
        a, b = np.stack([a, middle], axis=1).ravel(), np.stack([middle, b], axis=1).ravel()
        if len(a) > _MAX_INTERVALS:
            until, negative = float(a[_MAX_INTERVALS // 2]), False
            a, b = a[: _MAX_INTERVALS // 2], b[: _MAX_INTERVALS // 2]
    return until, negative


_MAX_INTERVALS = 1 << 17


def _bisect(value: Callable[[float], float], a: float, b: float) -> float:
    """Return the last floating-point number before a sign change, or a if value(a) ≤ 0."""
    if value(a) <= 0.0:
        return a
    while True:
        middle = 0.5 * (a + b)
        if middle in (a, b):
            return a
        a, b = (middle, b) if value(middle) > 0.0 else (a, middle)
