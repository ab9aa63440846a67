"""Smooth functions φ of one variable over an interval: the ranges of φ and φ′, bounds on |φ′| and |φ″|.

An entry of `SMOOTH` adds a primitive to every domain: linear enclosures and rounding use its bounds,
slopes use its ranges, and the structure treats it as pointwise.

For most functions |φ′| and |φ″| increase up to one peak and decrease after it, as functions of x, or of
|x| if φ is even or odd. Their maximum over an interval is at the point closest to the peak.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Ends = tuple[Any, Any]
Bounds = Callable[[jax.Array, jax.Array], Ends]
Range = Callable[[Any, Any], Ends]
Formula = Callable[[Any, Any], Any]
"""A function of the array module (NumPy or jax.numpy) and of x."""


class Smooth(NamedTuple):
    """Functions of an interval [low, high] that bound φ and its derivatives there.

    - `bounds`: returns (sup|φ′|, sup|φ″|), in JAX, infinite where φ is not smooth or not defined;
    - `values`, `slopes`: return the smallest and the largest value of φ and of φ′, in NumPy; `values`
      returns NaN where φ is not defined. None if there is no rule.
    """

    bounds: Bounds
    values: Range | None = None
    slopes: Range | None = None


_EVERYWHERE = (-math.inf, math.inf)


def _erf(v: Any) -> Any:
    from scipy.special import erf  # a slow import that only this function and the next one need

    return erf(v)


def _erfc(v: Any) -> Any:
    from scipy.special import erfc

    return erfc(v)


def _size(low: jax.Array, high: jax.Array) -> jax.Array:
    return jnp.maximum(jnp.abs(low), jnp.abs(high))


def _nearest(low: jax.Array, high: jax.Array) -> jax.Array:
    """Return the distance of the interval from zero."""
    return jnp.where(low > 0, low, jnp.where(high < 0, -high, 0.0))


def _range(phi: Callable[[Any], Any], *extrema: Any) -> Range:
    """Return the range of φ, which is monotone between its `extrema`, as a function of an interval."""

    def range_over(low: Any, high: Any) -> Ends:
        values = [phi(x) for x in (low, high, *(np.clip(v, low, high) for v in extrema))]
        return np.minimum.reduce(values), np.maximum.reduce(values)

    return range_over


def _peaked(
    phi: Callable[[Any], Any],
    slope: Formula,
    curvature: Formula,
    peaks: tuple[float, float],
    symmetric: bool = False,
    domain: tuple[float, float] = _EVERYWHERE,
) -> Smooth:
    """Return the bounds of φ, from φ′, φ″ (up to its sign) and the `peaks` of |φ′| and |φ″|.

    If `symmetric`, |φ′| and |φ″| are even and the peaks are those for x ≥ 0. Extrema of φ and φ′, if
    there are any, are at 0.
    """

    def bounds(low: jax.Array, high: jax.Array) -> Ends:
        ends = low, high
        if symmetric:
            ends = _nearest(low, high), _size(low, high)
        first, second = (jnp.clip(peak, *ends) for peak in peaks)
        suprema = jnp.abs(slope(jnp, first)), jnp.abs(curvature(jnp, second))
        if domain == _EVERYWHERE:
            return suprema
        inside = (low >= domain[0]) & (high <= domain[1])
        return jnp.where(inside, suprema[0], jnp.inf), jnp.where(inside, suprema[1], jnp.inf)

    return Smooth(bounds, _range(phi, 0.0), _range(lambda v: slope(np, v), 0.0))


def integer_power(n: int) -> Smooth:
    """Return the bounds of xⁿ; for n < 0 they are infinite on an interval that contains zero."""

    def bounds(low: jax.Array, high: jax.Array) -> Ends:
        if n < 0:
            nearest = _nearest(low, high)
            return -n / nearest ** (1 - n), n * (n - 1) / nearest ** (2 - n)
        size = _size(low, high)
        return n * size ** max(n - 1, 0), n * (n - 1) * size ** max(n - 2, 0)

    def slope(v: Any) -> Any:
        return n * v ** (n - 1) if n > 0 else n / v ** (1 - n)

    def without_zero(over: Range) -> Range:
        """Return the range over intervals without zero, and NaN over others."""

        def range_over(low: Any, high: Any) -> Ends:
            is_valid = (low > 0) | (high < 0)
            return over(np.where(is_valid, low, np.nan), np.where(is_valid, high, np.nan))

        return range_over

    if n < 0:
        values = without_zero(_range(lambda v: 1.0 / v**-n))
        return Smooth(bounds, values, without_zero(_range(slope)))
    return Smooth(bounds, _range(lambda v: v**n, 0.0), _range(slope if n else np.zeros_like, 0.0))


def positive_power(p: float) -> Smooth:
    """Return the bounds of x^p for p > 0 and x ≥ 0."""
    real = lambda v: np.where(v < 0.0, np.nan, v)  # noqa: E731
    return Smooth(
        lambda low, high: power_bounds(low, high, p),
        _range(lambda v: real(v) ** p),
        _range(lambda v: p * real(v) ** (p - 1)),
    )


def power_bounds(low: jax.Array, high: jax.Array, c: Any) -> Ends:
    """Bound the derivatives of x^c for a constant c where x^c is defined: for x ≥ 0, or for integer
    c."""
    # If low < 0, either the enclosure of x ≥ 0 is loose, or c is an integer and |x| determines the
    # bounds.
    low, high = jnp.maximum(low, 0.0), _size(low, high)

    def bound(p: Any, factor: Any) -> jax.Array:
        largest = jnp.abs(factor) * jnp.maximum(low**p, high**p)
        return jnp.where(factor == 0.0, 0.0, jnp.where(jnp.isnan(largest), jnp.inf, largest))

    return bound(c - 1.0, c), bound(c - 2.0, c * (c - 1.0))


def exponential_bounds(low: jax.Array, high: jax.Array, base: Any) -> Ends:
    """Bound the derivatives of base^x for a constant base."""
    rate = jnp.log(base)
    largest = jnp.maximum(base**low, base**high)
    slope, curvature = jnp.abs(rate) * largest, rate**2 * largest
    is_finite = jnp.isfinite(rate)
    return jnp.where(is_finite, slope, jnp.inf), jnp.where(is_finite, curvature, jnp.inf)


def _tangent_bounds(low: jax.Array, high: jax.Array) -> Ends:
    branch = lambda v: jnp.floor(v / math.pi + 0.5)  # noqa: E731
    # Enlarge the interval, so that rounding cannot hide a pole near its ends.
    slack = 1e-6 * (1.0 + _size(low, high))
    has_no_pole = branch(low - slack) == branch(high + slack)
    largest = _size(jnp.tan(low), jnp.tan(high))
    slope = 1.0 + largest**2
    curvature = 2.0 * largest * slope
    return jnp.where(has_no_pole, slope, jnp.inf), jnp.where(has_no_pole, curvature, jnp.inf)


def _wave(shift: float) -> Smooth:
    """Return the bounds of sin(x + shift)."""

    def over(shift: float) -> Range:
        def range_over(low: Any, high: Any) -> Ends:
            a, b = (low + shift) / (2 * np.pi), (high + shift) / (2 * np.pi)
            wide = ~(b - a < 1.0)
            top, bottom = (np.floor(b - q) >= np.ceil(a - q) for q in (0.25, -0.25))
            ends = np.sin(low + shift), np.sin(high + shift)
            return (
                np.where(wide | bottom, -1.0, np.minimum(*ends)),
                np.where(wide | top, 1.0, np.maximum(*ends)),
            )

        return range_over

    ones = lambda low, high: (jnp.ones_like(low), jnp.ones_like(low))  # noqa: E731
    return Smooth(ones, over(shift), over(shift + np.pi / 2))


def _exp(xp: Any, v: Any) -> Any:
    return xp.exp(v)


def _sech2(xp: Any, v: Any) -> Any:
    # 1 − tanh² would cancel to 0 for large |v|, where the slope is small but not 0.
    return 1.0 / xp.cosh(xp.minimum(xp.abs(v), 350.0)) ** 2


def _gauss(xp: Any, v: Any) -> Any:
    return 2.0 / math.sqrt(math.pi) * xp.exp(-(v**2))


_OUTWARD = (math.inf, math.inf)
"""Peaks of functions whose |φ′| and |φ″| increase up to the end of the domain."""

SMOOTH: dict[str, Smooth] = {
    "exp": _peaked(np.exp, _exp, _exp, _OUTWARD),
    "expm1": _peaked(np.expm1, _exp, _exp, _OUTWARD),
    "exp2": _peaked(
        np.exp2, lambda xp, v: math.log(2) * 2.0**v, lambda xp, v: math.log(2) ** 2 * 2.0**v,
        _OUTWARD,
    ),
    "log": _peaked(
        np.log, lambda xp, v: 1.0 / v, lambda xp, v: 1.0 / v**2, (0.0, 0.0), domain=(0.0, math.inf)
    ),
    "log1p": _peaked(
        np.log1p, lambda xp, v: 1.0 / (1.0 + v), lambda xp, v: 1.0 / (1.0 + v) ** 2, (-1.0, -1.0),
        domain=(-1.0, math.inf),
    ),
    "sqrt": _peaked(
        np.sqrt, lambda xp, v: 0.5 / xp.sqrt(v), lambda xp, v: 0.25 / v**1.5, (0.0, 0.0),
        domain=(0.0, math.inf),
    ),
    "rsqrt": _peaked(
        lambda v: 1.0 / np.sqrt(v), lambda xp, v: -0.5 / v**1.5, lambda xp, v: 0.75 / v**2.5,
        (0.0, 0.0), domain=(0.0, math.inf),
    ),
    "cbrt": _peaked(
        np.cbrt, lambda xp, v: xp.abs(v) ** (-2 / 3) / 3, lambda xp, v: 2 / 9 * xp.abs(v) ** (-5 / 3),
        (0.0, 0.0), symmetric=True,
    ),
    "sin": _wave(0.0),
    "cos": _wave(np.pi / 2),
    "tan": Smooth(_tangent_bounds),
    "asin": _peaked(
        np.arcsin, lambda xp, v: ((1.0 - v) * (1.0 + v)) ** -0.5,
        lambda xp, v: v * ((1.0 - v) * (1.0 + v)) ** -1.5,
        _OUTWARD, symmetric=True, domain=(-1.0, 1.0),
    ),
    "acos": _peaked(
        np.arccos, lambda xp, v: -(((1.0 - v) * (1.0 + v)) ** -0.5),
        lambda xp, v: v * ((1.0 - v) * (1.0 + v)) ** -1.5,
        _OUTWARD, symmetric=True, domain=(-1.0, 1.0),
    ),
    "atan": _peaked(
        np.arctan, lambda xp, v: 1.0 / (1.0 + v**2), lambda xp, v: 2.0 * v / (1.0 + v**2) ** 2,
        (0.0, 3**-0.5), symmetric=True,
    ),
    "sinh": _peaked(
        np.sinh, lambda xp, v: xp.cosh(v), lambda xp, v: xp.sinh(v), _OUTWARD, symmetric=True
    ),
    "cosh": _peaked(
        np.cosh, lambda xp, v: xp.sinh(v), lambda xp, v: xp.cosh(v), _OUTWARD, symmetric=True
    ),
    "tanh": _peaked(
        np.tanh, _sech2, lambda xp, v: 2.0 * xp.tanh(v) * _sech2(xp, v),
        (0.0, math.atanh(3**-0.5)), symmetric=True,
    ),
    "asinh": _peaked(
        np.arcsinh, lambda xp, v: (1.0 + v**2) ** -0.5, lambda xp, v: v * (1.0 + v**2) ** -1.5,
        (0.0, 2**-0.5), symmetric=True,
    ),
    "acosh": _peaked(
        np.arccosh, lambda xp, v: ((v - 1.0) * (v + 1.0)) ** -0.5,
        lambda xp, v: v * ((v - 1.0) * (v + 1.0)) ** -1.5, (1.0, 1.0), domain=(1.0, math.inf),
    ),
    "atanh": _peaked(
        np.arctanh, lambda xp, v: 1.0 / ((1.0 - v) * (1.0 + v)),
        lambda xp, v: 2.0 * v / ((1.0 - v) * (1.0 + v)) ** 2,
        _OUTWARD, symmetric=True, domain=(-1.0, 1.0),
    ),
    "logistic": _peaked(
        lambda v: np.exp(-np.logaddexp(0.0, -v)), lambda xp, v: 0.25 * _sech2(xp, 0.5 * v),
        lambda xp, v: 0.25 * xp.tanh(0.5 * v) * _sech2(xp, 0.5 * v),
        (0.0, 2.0 * math.atanh(3**-0.5)), symmetric=True,
    ),
    "erf": _peaked(
        _erf, _gauss, lambda xp, v: 2.0 * v * _gauss(xp, v), (0.0, 2**-0.5), symmetric=True
    ),
    "erfc": _peaked(
        _erfc, lambda xp, v: -_gauss(xp, v), lambda xp, v: 2.0 * v * _gauss(xp, v), (0.0, 2**-0.5),
        symmetric=True,
    ),
    "square": integer_power(2),
}  # fmt: skip
"""The smooth functions by the names of JAX primitives."""

SMOOTH_NAMES = SMOOTH.keys() | {"integer_pow"}


def smooth(eqn: Any) -> Smooth | None:
    """Return the smooth function of one argument that an operation computes, or None."""
    name = eqn.primitive.name
    return integer_power(eqn.params["y"]) if name == "integer_pow" else SMOOTH.get(name)
