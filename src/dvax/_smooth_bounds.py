"""sup|φ′| and sup|φ″| of the smooth functions of one variable over an interval [low, high].

They are what chord arithmetic needs of a smooth φ (`chords`). Where φ is not smooth or not defined in
the interval the bounds are infinite.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

Bounds = Callable[[jax.Array, jax.Array], tuple[Any, Any]]


def _everywhere(slope: float, bend: float) -> Bounds:
    return lambda low, high: (jnp.full_like(low, slope), jnp.full_like(low, bend))


def _size(low: jax.Array, high: jax.Array) -> jax.Array:
    return jnp.maximum(jnp.abs(low), jnp.abs(high))


def _nearest(low: jax.Array, high: jax.Array) -> jax.Array:
    """The distance of the interval from zero."""
    return jnp.where(low > 0, low, jnp.where(high < 0, -high, 0.0))


def _saturating(slope: Callable, bend: Callable, peak: float) -> Bounds:
    """For φ whose |φ′| falls with |x|, and whose |φ″| rises up to |x| = `peak` and falls from there."""

    def bounds(low: jax.Array, high: jax.Array) -> tuple[Any, Any]:
        near = _nearest(low, high)
        return slope(near), bend(jnp.clip(peak, near, _size(low, high)))

    return bounds


def _above(least: float, slope: Callable, bend: Callable) -> Bounds:
    """For φ on (least, ∞) with |φ′| and |φ″| falling in x − least."""

    def bounds(low: jax.Array, high: jax.Array) -> tuple[Any, Any]:
        apart = jnp.maximum(low - least, 0.0)
        return slope(apart), bend(apart)

    return bounds


def _within_one(slope: Callable, bend: Callable) -> Bounds:
    """For φ on (−1, 1) with |φ′| and |φ″| growing in |x|, as functions of that and of 1 − x²."""

    def bounds(low: jax.Array, high: jax.Array) -> tuple[Any, Any]:
        m = jnp.minimum(_size(low, high), 1.0)
        left = (1.0 - m) * (1.0 + m)
        return slope(m, left), jnp.where(left > 0.0, bend(m, left), jnp.inf)

    return bounds


def _tan(low: jax.Array, high: jax.Array) -> tuple[Any, Any]:
    branch = lambda v: jnp.floor(v / math.pi + 0.5)  # noqa: E731
    # A pole that rounding may have moved into the interval counts as in it.
    slack = 1e-6 * (1.0 + _size(low, high))
    one = branch(low - slack) == branch(high + slack)
    largest = _size(jnp.tan(low), jnp.tan(high))
    slope = 1.0 + largest**2
    return jnp.where(one, slope, jnp.inf), jnp.where(one, 2.0 * largest * slope, jnp.inf)


def power(low: jax.Array, high: jax.Array, c: Any) -> tuple[Any, Any]:
    """Of x^c with any fixed c, where it is a number: for x ≥ 0, or for whole c."""
    # A bound below zero is loose, or c is whole and the size of x counts.
    low, high = jnp.maximum(low, 0.0), _size(low, high)

    def most(p: Any, factor: Any) -> jax.Array:
        worst = jnp.abs(factor) * jnp.maximum(low**p, high**p)
        return jnp.where(factor == 0.0, 0.0, jnp.where(jnp.isnan(worst), jnp.inf, worst))

    return most(c - 1.0, c), most(c - 2.0, c * (c - 1.0))


def exponential(low: jax.Array, high: jax.Array, base: Any) -> tuple[Any, Any]:
    """Of base^x with any fixed base."""
    rate = jnp.log(base)
    most = jnp.maximum(base**low, base**high)
    slope, bend = jnp.abs(rate) * most, rate**2 * most
    good = jnp.isfinite(rate)
    return jnp.where(good, slope, jnp.inf), jnp.where(good, bend, jnp.inf)


_E = lambda low, high: (jnp.exp(high), jnp.exp(high))  # noqa: E731


def _sinh(low: jax.Array, high: jax.Array) -> tuple[Any, Any]:
    m = _size(low, high)
    return jnp.cosh(m), jnp.sinh(m)


def _sech2(m: jax.Array) -> jax.Array:
    return 1.0 / jnp.cosh(jnp.minimum(m, 350.0)) ** 2


_ERF = _saturating(
    lambda m: 2.0 / math.sqrt(math.pi) * jnp.exp(-(m**2)),
    lambda m: 4.0 / math.sqrt(math.pi) * m * jnp.exp(-(m**2)),
    2**-0.5,
)

BOUNDS: dict[str, Bounds] = {
    "exp": _E,
    "expm1": _E,
    "exp2": lambda low, high: (math.log(2) * 2.0**high, math.log(2) ** 2 * 2.0**high),
    "log": _above(0.0, lambda d: 1.0 / d, lambda d: 1.0 / d**2),
    "log1p": _above(-1.0, lambda d: 1.0 / d, lambda d: 1.0 / d**2),
    "sqrt": _above(0.0, lambda d: 0.5 / jnp.sqrt(d), lambda d: 0.25 / d**1.5),
    "rsqrt": _above(0.0, lambda d: 0.5 / d**1.5, lambda d: 0.75 / d**2.5),
    "cbrt": lambda low, high: (
        _nearest(low, high) ** (-2 / 3) / 3, 2 / 9 * _nearest(low, high) ** (-5 / 3),
    ),
    "sin": _everywhere(1.0, 1.0),
    "cos": _everywhere(1.0, 1.0),
    "tan": _tan,
    "asin": _within_one(lambda m, left: left**-0.5, lambda m, left: m * left**-1.5),
    "acos": _within_one(lambda m, left: left**-0.5, lambda m, left: m * left**-1.5),
    "atan": _saturating(
        lambda m: 1.0 / (1.0 + m**2), lambda m: 2.0 * m / (1.0 + m**2) ** 2, 3**-0.5
    ),
    "sinh": _sinh,
    "cosh": lambda low, high: _sinh(low, high)[::-1],
    "tanh": _saturating(_sech2, lambda m: 2.0 * jnp.tanh(m) * _sech2(m), math.atanh(3**-0.5)),
    "asinh": _saturating(
        lambda m: (1.0 + m**2) ** -0.5, lambda m: m * (1.0 + m**2) ** -1.5, 2**-0.5
    ),
    "acosh": _above(
        1.0, lambda d: (d * (2.0 + d)) ** -0.5, lambda d: (1.0 + d) * (d * (2.0 + d)) ** -1.5
    ),
    "atanh": _within_one(lambda m, left: 1.0 / left, lambda m, left: 2.0 * m / left**2),
    "logistic": _saturating(
        lambda m: 0.25 * _sech2(0.5 * m), lambda m: 0.25 * jnp.tanh(0.5 * m) * _sech2(0.5 * m),
        2.0 * math.atanh(3**-0.5),
    ),
    "erf": _ERF,
    "erfc": _ERF,
}  # fmt: skip
"""By the names of JAX's primitives."""
