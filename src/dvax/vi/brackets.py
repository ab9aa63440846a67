"""Brackets of scalar roots, one a point, narrowed by one evaluation of F and F′ at every point.

An end of [a, b] that F was evaluated at has F(a) < 0 or F(b) > 0; an end that is still the interval's
own has no value yet (NaN). From the better end x, with f = F(x), s = F′(x) and the other end (o, f_o):

- no value at o: Newton's step, stretched after a while, as far as o, where the bound is then tried;
- else the inverse quadratic through both values and the slope at x,
      x − (1 + ρ) f/s + ρ² (o − x),  ρ = f/(f_o − f),
  whose error is of the order of that of x squared times that of o;
- where that did not help, the secant of G = F/√F′, of which G″ = 0 at the root: it is exact for
  what Newton's method leaves fastest, F = arctan far from its middle, and Halley's method in the
  limit of equal ends;
- where that did not help either, the middle: every third evaluation halves the bracket or divides
  |F| by ten at the least, so that the number of evaluations is bounded.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

_CLOSED, _APART = 8, 6
"""A bracket so many spacings wide is closed; a new point keeps so many away from either end."""
_HALVED = 0.55
"""Half, with room for the rounding of a middle."""
_STRETCHED = 3
"""From the second to last of so many one-sided steps on, each is twice as long as Newton's, or
more: a convex F is approached from one side alone, however slowly."""


class Brackets(NamedTuple):
    """F(a) < 0 < F(b) with slopes; `slow`, how often in a row the bracket was hardly narrowed."""

    a: jax.Array
    fa: jax.Array
    sa: jax.Array
    b: jax.Array
    fb: jax.Array
    sb: jax.Array
    slow: jax.Array


def begin(x: Any, f: Any, s: Any, lower: Any, upper: Any) -> Brackets:
    """The guess x ∈ [lower, upper] as one end; nothing is known of the other."""
    unknown = jnp.full_like(x, jnp.nan)
    lower, upper = jnp.broadcast_to(lower, x.shape), jnp.broadcast_to(upper, x.shape)
    start = Brackets(
        lower.astype(x.dtype), unknown, unknown, upper.astype(x.dtype), unknown, unknown,
        jnp.zeros(x.shape, jnp.int8),
    )  # fmt: skip
    return narrow(start, x, f, s)


def narrow(p: Brackets, x: Any, f: Any, s: Any) -> Brackets:
    """x replaces the end of its sign; where F is 0 (or NaN) there, it is both ends."""
    above, below = f > 0, f < 0
    a, b = jnp.where(above, p.a, x), jnp.where(below, p.b, x)
    fa, fb = jnp.where(above, p.fa, f), jnp.where(below, p.fb, f)
    least = jnp.minimum(jnp.abs(p.fa), jnp.abs(p.fb))
    # Comparisons with an unknown value are false; the count starts with the second sign.
    fair = (b - a > _HALVED * (p.b - p.a)) & (jnp.abs(f) > 0.1 * least)
    slow = jnp.where(fair, p.slow + 1, 0).astype(jnp.int8)
    return Brackets(
        a, fa, jnp.where(above, p.sa, s), b, fb, jnp.where(below, p.sb, s), slow
    )  # fmt: skip


def trial(p: Brackets, count: Any) -> jax.Array:
    """Where to evaluate F next; `count` evaluations were made since the guess."""
    lower_end = _lower_is_better(p)
    x, f, s = best(p)
    o, fo, so = (jnp.where(lower_end, q, r) for q, r in ((p.b, p.a), (p.fb, p.fa), (p.sb, p.sa)))
    width = p.b - p.a
    gap = _APART * _spacing(x)
    newton = f / s

    ratio = f / (fo - f)
    quadratic = x - (1 + ratio) * newton + ratio * ratio * (o - x)
    far, near = jnp.abs(f) * jnp.sqrt(so), jnp.abs(fo) * jnp.sqrt(s)
    secant = x + (o - x) * (far / (far + near))
    inside = lambda r: (r > p.a - gap) & (r < p.b + gap)  # noqa: E731
    middle = p.a + 0.5 * width
    between = jnp.where((p.slow < 2) & inside(secant), secant, middle)
    between = jnp.where((p.slow < 1) & inside(quadratic), quadratic, between)
    between = jnp.where(jnp.isfinite(fo), between, middle)
    keep = jnp.minimum(gap, 0.5 * width)
    between = jnp.clip(between, p.a + keep, p.b - keep)

    # Exponential growth overflows on a Newton step from its flat side: an infinite interval is
    # entered by steps that grow eightfold at most.
    steps = jnp.asarray(count, x.dtype)
    reach = jnp.where(jnp.isfinite(width), width, (1 + jnp.abs(x)) * 8 ** (steps + 1))
    stretch = jnp.where(steps + 1 < _STRETCHED, 1.0, 2.0 ** (steps + 2 - _STRETCHED))
    step = jnp.where(s > 0, jnp.abs(newton) * stretch, reach)
    step = jnp.clip(jnp.where(jnp.isfinite(step), step, reach), gap, jnp.maximum(reach, gap))
    beyond = jnp.clip(x + jnp.where(lower_end, step, -step), p.a, p.b)
    horizon = _horizon(x)
    return jnp.where(jnp.isnan(fo), jnp.clip(beyond, -horizon, horizon), between)


def best(p: Brackets) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The end with the lesser |F|, of those that were evaluated, with F and F′ there."""
    lower_end = _lower_is_better(p)
    return tuple(jnp.where(lower_end, q, r) for q, r in ((p.a, p.b), (p.fa, p.fb), (p.sa, p.sb)))  # pyright: ignore[reportReturnType]


def answer(p: Brackets) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`best`, and where a bracket closed at a bound without a change of sign, that bound."""
    x, f, s = best(p)
    closed = _is_closed(p)
    x = jnp.where(closed & jnp.isnan(p.fb) & (f < 0), p.b, x)
    x = jnp.where(closed & jnp.isnan(p.fa) & (f > 0), p.a, x)
    return x, f, s


def is_open(p: Brackets) -> jax.Array:
    """Whether there is something left to do at each point."""
    return ~_is_closed(p) & ~is_lost(p)


def _is_closed(p: Brackets) -> jax.Array:
    return p.b - p.a <= _CLOSED * _spacing(best(p)[0])


def is_lost(p: Brackets) -> jax.Array:
    """No change of sign as far as numbers go, on an interval without an end."""
    x = best(p)[0]
    return jnp.isinf(p.b - p.a) & (jnp.abs(x) >= _horizon(x))


def _lower_is_better(p: Brackets) -> jax.Array:
    return (jnp.abs(p.fa) < jnp.abs(p.fb)) | jnp.isnan(p.fb)


def _spacing(x: jax.Array) -> jax.Array:
    """Of floating-point numbers at x; at 0 the square of that at 1, which is fine enough."""
    eps = jnp.finfo(x.dtype).eps
    return eps * (jnp.abs(x) + eps)


def _horizon(x: jax.Array) -> Any:
    return jnp.finfo(x.dtype).max ** 0.3
