"""Smooth functions φ of one variable over an interval: the ranges of φ and φ′, bounds on |φ′| and |φ″|.

One entry of `SMOOTH` makes a primitive known to every domain that reads programs: to the linear
enclosure and to rounding by its bounds, to slopes by its ranges, and to the structure as pointwise.
Where φ is not smooth or not defined in the interval its bounds are infinite; where it is not defined
the range of its values is NaN, and that of its slopes means nothing.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import erf, erfc

Bounds = Callable[[jax.Array, jax.Array], tuple[Any, Any]]
"""From the ends of an interval to (sup|φ′|, sup|φ″|) over it."""

Range = Callable[[Any, Any], tuple[Any, Any]]
"""From the ends of an interval (NumPy) to the least and the largest value over it."""


class Smooth(NamedTuple):
    """What is known of φ: the `bounds` of its derivatives, and the ranges of its `values` and `slopes`
    (None where they are not known)."""

    bounds: Bounds
    values: Range | None = None
    slopes: Range | None = None


# Bounds, in JAX: they are computed in every step of a run, by one evaluation each.


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


def power_bounds(low: jax.Array, high: jax.Array, c: Any) -> tuple[Any, Any]:
    """Bound the derivatives of x^c with a fixed c, where it is a number: for x ≥ 0, or whole c."""
    # A bound below zero is loose, or c is whole and the size of x counts.
    low, high = jnp.maximum(low, 0.0), _size(low, high)

    def most(p: Any, factor: Any) -> jax.Array:
        worst = jnp.abs(factor) * jnp.maximum(low**p, high**p)
        return jnp.where(factor == 0.0, 0.0, jnp.where(jnp.isnan(worst), jnp.inf, worst))

    return most(c - 1.0, c), most(c - 2.0, c * (c - 1.0))


def exponential_bounds(low: jax.Array, high: jax.Array, base: Any) -> tuple[Any, Any]:
    """Bound the derivatives of base^x with a fixed base."""
    rate = jnp.log(base)
    most = jnp.maximum(base**low, base**high)
    slope, bend = jnp.abs(rate) * most, rate**2 * most
    good = jnp.isfinite(rate)
    return jnp.where(good, slope, jnp.inf), jnp.where(good, bend, jnp.inf)


def _exp(low: jax.Array, high: jax.Array) -> tuple[Any, Any]:
    return jnp.exp(high), jnp.exp(high)


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


# Ranges, in NumPy.


def _range(phi: Callable[[Any], Any], *turns: float) -> Range:
    """The range of a φ that is monotone between its turning points."""

    def over(low: Any, high: Any) -> tuple[Any, Any]:
        places = [low, high, *(np.clip(turn, low, high) for turn in turns)]
        values = [phi(place) for place in places]
        return np.minimum.reduce(values), np.maximum.reduce(values)

    return over


def _sine_range(shift: float) -> Range:
    """The range of sin(v + shift)."""

    def over(low: Any, high: Any) -> tuple[Any, Any]:
        a, b = low + shift, high + shift
        wide = ~((b - a) < 2 * np.pi)
        top = np.floor((b - np.pi / 2) / (2 * np.pi)) >= np.ceil((a - np.pi / 2) / (2 * np.pi))
        floor = np.floor((b + np.pi / 2) / (2 * np.pi)) >= np.ceil((a + np.pi / 2) / (2 * np.pi))
        ends = np.sin(a), np.sin(b)
        return (
            np.where(wide | floor, -1.0, np.minimum(*ends)),
            np.where(wide | top, 1.0, np.maximum(*ends)),
        )

    return over


def _sech(v: Any) -> Any:
    # 1 − tanh² would cancel to 0 where the slope is small and not 0.
    return 1.0 / np.cosh(np.minimum(np.abs(v), 350.0))


def _gauss(v: Any) -> Any:
    return 2.0 / np.sqrt(np.pi) * np.exp(-(v**2))


def integer_power(n: int) -> Smooth:
    """xⁿ; for n < 0 without bounds on an interval that holds zero."""

    def bounds(low: jax.Array, high: jax.Array) -> tuple[Any, Any]:
        if n < 0:
            nearest = _nearest(low, high)
            return -n / nearest ** (1 - n), n * (n - 1) / nearest ** (2 - n)
        size = _size(low, high)
        return n * size ** max(n - 1, 0), n * (n - 1) * size ** max(n - 2, 0)

    def over(factor: int, m: int) -> Range:
        """The range of factor · x^m."""
        if m >= 0:
            return _range(lambda v: factor * v**m, 0.0)
        outward = _range(lambda v: factor / v**-m)

        def clear(low: Any, high: Any) -> tuple[Any, Any]:
            some = (low > 0) | (high < 0)
            return outward(np.where(some, low, np.nan), np.where(some, high, np.nan))

        return clear

    return Smooth(bounds, over(1, n), over(n, n - 1) if n else _range(np.zeros_like))


def positive_power(p: float) -> Smooth:
    """x^p for p > 0 and x ≥ 0, its ranges alone."""
    real = lambda v: np.where(v < 0.0, np.nan, v)  # noqa: E731
    return Smooth(
        lambda low, high: power_bounds(low, high, p),
        _range(lambda v: real(v) ** p),
        _range(lambda v: p * real(v) ** (p - 1)),
    )


SMOOTH: dict[str, Smooth] = {
    "exp": Smooth(_exp, _range(np.exp), _range(np.exp)),
    "expm1": Smooth(_exp, _range(np.expm1), _range(np.exp)),
    "exp2": Smooth(
        lambda low, high: (math.log(2) * 2.0**high, math.log(2) ** 2 * 2.0**high),
        _range(np.exp2), _range(lambda v: np.log(2) * np.exp2(v)),
    ),
    "log": Smooth(
        _above(0.0, lambda d: 1.0 / d, lambda d: 1.0 / d**2),
        _range(np.log), _range(lambda v: 1 / v),
    ),
    "log1p": Smooth(
        _above(-1.0, lambda d: 1.0 / d, lambda d: 1.0 / d**2),
        _range(np.log1p), _range(lambda v: 1 / (1 + v)),
    ),
    "sqrt": Smooth(
        _above(0.0, lambda d: 0.5 / jnp.sqrt(d), lambda d: 0.25 / d**1.5),
        _range(np.sqrt), _range(lambda v: 0.5 / np.sqrt(v)),
    ),
    "rsqrt": Smooth(
        _above(0.0, lambda d: 0.5 / d**1.5, lambda d: 0.75 / d**2.5),
        _range(lambda v: 1 / np.sqrt(v)), _range(lambda v: -0.5 / v**1.5),
    ),
    "cbrt": Smooth(
        lambda low, high: (
            _nearest(low, high) ** (-2 / 3) / 3, 2 / 9 * _nearest(low, high) ** (-5 / 3),
        ),
        _range(np.cbrt), _range(lambda v: 1 / (3 * np.cbrt(v) ** 2), 0.0),
    ),
    "sin": Smooth(_everywhere(1.0, 1.0), _sine_range(0.0), _sine_range(np.pi / 2)),
    "cos": Smooth(_everywhere(1.0, 1.0), _sine_range(np.pi / 2), _sine_range(np.pi)),
    "tan": Smooth(_tan),
    "asin": Smooth(
        _within_one(lambda m, left: left**-0.5, lambda m, left: m * left**-1.5),
        _range(np.arcsin), _range(lambda v: 1 / np.sqrt(1 - v**2), 0.0),
    ),
    "acos": Smooth(
        _within_one(lambda m, left: left**-0.5, lambda m, left: m * left**-1.5),
        _range(np.arccos), _range(lambda v: -1 / np.sqrt(1 - v**2), 0.0),
    ),
    "atan": Smooth(
        _saturating(
            lambda m: 1.0 / (1.0 + m**2), lambda m: 2.0 * m / (1.0 + m**2) ** 2, 3**-0.5
        ),
        _range(np.arctan), _range(lambda v: 1 / (1 + v**2), 0.0),
    ),
    "sinh": Smooth(_sinh, _range(np.sinh), _range(np.cosh, 0.0)),
    "cosh": Smooth(
        lambda low, high: _sinh(low, high)[::-1], _range(np.cosh, 0.0), _range(np.sinh)
    ),
    "tanh": Smooth(
        _saturating(_sech2, lambda m: 2.0 * jnp.tanh(m) * _sech2(m), math.atanh(3**-0.5)),
        _range(np.tanh), _range(lambda v: _sech(v) ** 2, 0.0),
    ),
    "asinh": Smooth(
        _saturating(lambda m: (1.0 + m**2) ** -0.5, lambda m: m * (1.0 + m**2) ** -1.5, 2**-0.5),
        _range(np.arcsinh), _range(lambda v: 1 / np.sqrt(1 + v**2), 0.0),
    ),
    "acosh": Smooth(
        _above(
            1.0, lambda d: (d * (2.0 + d)) ** -0.5, lambda d: (1.0 + d) * (d * (2.0 + d)) ** -1.5
        ),
        _range(np.arccosh), _range(lambda v: 1 / (np.sqrt(v - 1) * np.sqrt(v + 1))),
    ),
    "atanh": Smooth(
        _within_one(lambda m, left: 1.0 / left, lambda m, left: 2.0 * m / left**2),
        _range(np.arctanh), _range(lambda v: 1 / (1 - v**2), 0.0),
    ),
    "logistic": Smooth(
        _saturating(
            lambda m: 0.25 * _sech2(0.5 * m), lambda m: 0.25 * jnp.tanh(0.5 * m) * _sech2(0.5 * m),
            2.0 * math.atanh(3**-0.5),
        ),
        _range(lambda v: np.exp(-np.logaddexp(0.0, -v))),
        _range(lambda v: 0.25 * _sech(0.5 * v) ** 2, 0.0),
    ),
    "erf": Smooth(_ERF, _range(erf), _range(_gauss, 0.0)),
    "erfc": Smooth(_ERF, _range(erfc), _range(lambda v: -_gauss(v), 0.0)),
    "square": integer_power(2),
}  # fmt: skip
"""By the names of JAX's primitives."""


def smooth(eqn: Any) -> Smooth | None:
    """Return the smooth function that an operation applies to its one argument, if it does."""
    name = eqn.primitive.name
    return integer_power(eqn.params["y"]) if name == "integer_pow" else SMOOTH.get(name)


SMOOTH_NAMES = SMOOTH.keys() | {"integer_pow"}
