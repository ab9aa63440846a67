"""Brackets of scalar roots, one per point, narrowed by one evaluation of F and F′ at every point.

At an evaluated end of [a, b], F(a) < 0 or F(b) > 0. An end that is still a bound of the interval has
not been evaluated, and its value is NaN. Let x be the evaluated end with the smaller |F|, f = F(x),
s = F′(x), and o the other end with value f_o. The next trial point is

- if o has no value: Newton's step from x, lengthened after two steps and limited by o, so that a
  step beyond the bound evaluates the bound;
- otherwise the inverse quadratic interpolant of both values and the slope at x,
      x − (1 + ρ) f/s + ρ² (o − x),  ρ = f/(f_o − f),
  whose error is of order (error of x)² · (error of o);
  - if that did not narrow the bracket enough, the secant of G = F/√F′, for which G″ = 0 at the root:
    it is accurate for F = arctan far from its root, where Newton's method diverges fastest, and becomes
      Halley's method as the ends coincide;
  - if that failed too, the midpoint. So at least every third evaluation halves the bracket or divides
    |F| by ten, which bounds the number of evaluations.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

_CLOSED_SPACINGS, _MARGIN_SPACINGS = 8, 6
"""Width of a closed bracket, and distance of a trial point from both ends, in spacings of
floating-point numbers."""
_HALVING_RATIO = 0.55
"""One half, with a margin for the rounding of a midpoint."""
_FIRST_LENGTHENED_STEP = 3
"""From this one-sided step on, Newton steps are multiplied by 2, 4, …: for a convex F, Newton's
method approaches the root from one side only, possibly slowly."""


class Brackets(NamedTuple):
    """Ends a < b with F(a) < 0 < F(b) and their slopes; `slow`, the number of consecutive evaluations
    that narrowed the bracket too little."""

    a: jax.Array
    fa: jax.Array
    sa: jax.Array
    b: jax.Array
    fb: jax.Array
    sb: jax.Array
    slow: jax.Array


def begin(like: Any, lower: Any, upper: Any) -> Brackets:
    """Return the whole interval, whose ends have no values yet, for points shaped like `like`."""
    unknown = jnp.full_like(like, jnp.nan)
    a, b = (jnp.broadcast_to(end, like.shape).astype(like.dtype) for end in (lower, upper))
    slow = jnp.zeros(like.shape, jnp.int8)
    return Brackets(a, unknown, unknown, b, unknown, unknown, slow)


def narrow(p: Brackets, x: Any, f: Any, s: Any) -> Brackets:
    """Replace the end where F has the sign of f by x; if f is 0 or NaN, replace both ends."""
    above, below = f > 0, f < 0
    a, b = jnp.where(above, p.a, x), jnp.where(below, p.b, x)
    fa, fb = jnp.where(above, p.fa, f), jnp.where(below, p.fb, f)
    least = jnp.minimum(jnp.abs(p.fa), jnp.abs(p.fb))
    # Comparisons with NaN are false, so the count starts when both ends have a value.
    is_slow = (b - a > _HALVING_RATIO * (p.b - p.a)) & (jnp.abs(f) > 0.1 * least)
    slow = jnp.where(is_slow, p.slow + 1, 0).astype(jnp.int8)
    return Brackets(
        a, fa, jnp.where(above, p.sa, s), b, fb, jnp.where(below, p.sb, s), slow
    )  # fmt: skip


def trial(p: Brackets, count: Any) -> jax.Array:
    """Return the next trial point after `count` evaluations since the guess."""
    lower_end = _lower_is_better(p)
    x, f, s = best(p)
    o, fo, so = (jnp.where(lower_end, q, r) for q, r in ((p.b, p.a), (p.fb, p.fa), (p.sb, p.sa)))
    width = p.b - p.a
    margin = _MARGIN_SPACINGS * _spacing(x)
    newton = f / s

    ratio = f / (fo - f)
    quadratic = x - (1 + ratio) * newton + ratio * ratio * (o - x)
    far, near = jnp.abs(f) * jnp.sqrt(so), jnp.abs(fo) * jnp.sqrt(s)
    secant = x + (o - x) * (far / (far + near))

    def is_inside(r: jax.Array) -> jax.Array:
        return (r > p.a - margin) & (r < p.b + margin)

    middle = p.a + 0.5 * width
    between = jnp.where((p.slow < 2) & is_inside(secant), secant, middle)
    between = jnp.where((p.slow < 1) & is_inside(quadratic), quadratic, between)
    between = jnp.where(jnp.isfinite(fo), between, middle)
    inset = jnp.minimum(margin, 0.5 * width)
    between = jnp.clip(between, p.a + inset, p.b - inset)

    # From the flat side of an exponential, Newton's step overflows. On an infinite interval steps
    # therefore grow by at most a factor of eight.
    steps = jnp.asarray(count, x.dtype)
    reach = jnp.where(jnp.isfinite(width), width, (1 + jnp.abs(x)) * 8 ** (steps + 1))
    lengthening = jnp.where(
        steps + 1 < _FIRST_LENGTHENED_STEP, 1.0, 2.0 ** (steps + 2 - _FIRST_LENGTHENED_STEP)
    )
    step = jnp.where(s > 0, jnp.abs(newton) * lengthening, reach)
    step = jnp.clip(jnp.where(jnp.isfinite(step), step, reach), margin, jnp.maximum(reach, margin))
    beyond = jnp.clip(x + jnp.where(lower_end, step, -step), p.a, p.b)
    limit = _largest_magnitude(x)
    return jnp.where(jnp.isnan(fo), jnp.clip(beyond, -limit, limit), between)


def best(p: Brackets) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the evaluated end with the smaller |F|, with F and F′ there."""
    lower_end = _lower_is_better(p)
    return tuple(jnp.where(lower_end, q, r) for q, r in ((p.a, p.b), (p.fa, p.fb), (p.sa, p.sb)))  # pyright: ignore[reportReturnType]


def root(p: Brackets) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Return `best`, moved to the bound if the bracket closed there without a sign change, and whether
    it did.

    A comparison of x with the bound would be no test: XLA computes a bound that depends on t again
    where it is used, possibly with other roundings.
    """
    x, f, s = best(p)
    closed = _is_closed(p)
    at_upper = closed & jnp.isnan(p.fb) & (f < 0)
    at_lower = closed & jnp.isnan(p.fa) & (f > 0)
    x = jnp.where(at_upper, p.b, jnp.where(at_lower, p.a, x))
    return x, f, s, at_upper | at_lower


def is_open(p: Brackets) -> jax.Array:
    """Return at which points the iteration must continue."""
    return ~_is_closed(p) & ~has_no_sign_change(p)


def _is_closed(p: Brackets) -> jax.Array:
    return p.b - p.a <= _CLOSED_SPACINGS * _spacing(best(p)[0])


def has_no_sign_change(p: Brackets) -> jax.Array:
    """Return at which points F keeps its sign up to the largest magnitude of an infinite interval."""
    x = best(p)[0]
    return jnp.isinf(p.b - p.a) & (jnp.abs(x) >= _largest_magnitude(x))


def _lower_is_better(p: Brackets) -> jax.Array:
    return (jnp.abs(p.fa) < jnp.abs(p.fb)) | jnp.isnan(p.fb)


def _spacing(x: jax.Array) -> jax.Array:
    """Return the spacing of floating-point numbers at x, and at 0 the square of that at 1."""
    eps = jnp.finfo(x.dtype).eps
    return eps * (jnp.abs(x) + eps)


def _largest_magnitude(x: jax.Array) -> Any:
    """Return the largest |x| at which F is evaluated."""
    return jnp.finfo(x.dtype).max ** 0.3
