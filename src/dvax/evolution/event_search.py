"""The search for the next event in a step, on its dense output.

The search walks along the step from interval to interval. An interval [a, b] is resolved if the cubic
through the values and slopes of g at its ends predicts value and slope at a point inside; otherwise it
is shortened. In a resolved interval g reaches zero in two ways:

- it changes its sign, or arrives at zero;
- it has an extremum near zero: the slopes at the ends lead towards zero and back, and the tangents at
  the ends meet beyond zero, or within `touch` of it.

Intervals with one of the two are divided until they are short. An extremum within `touch` of zero is
one event, at the extremum: an error of that size would make it two zeros or none. Leaving zero is no
event, so that a function that is zero on an interval has one event there. In an interval in which a
function stays within its `noise` it keeps its sign and has no event: one that decays to zero has none
at its rounding errors.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree

DIVISION = 0.4721
"""Where an interval is divided: no simple fraction, so that periods of g rarely match."""

RESTART = 1e-3
"""Length of the first interval behind an event, relative to that before: values are small there, and
another zero close by would not be noticed in a longer interval."""

_FINEST = 1e-5
"""Length below which an interval without an event is not divided: a bound on the work in a step."""

_VALUE_ERROR, _SLOPE_ERROR = 0.1, 0.5
"""Largest errors of the prediction of value and slope times length, relative to the values."""


class Walk(NamedTuple):
    """The interval [a, b] in units of the step, with the values v and slopes d at its ends, the length
    `reach` of the next interval, whether the values at b are `known`, which functions are `above` their
    noise in the interval, and the results: whether an event was `found`, which is in [a, b], or the
    walk `ended`: at the end of the step, or at a value vb that is not finite."""

    a: Any
    va: jax.Array
    da: jax.Array
    b: Any
    vb: jax.Array
    db: jax.Array
    reach: Any
    known: Any
    above: jax.Array
    found: Any
    ended: Any

    @staticmethod
    def at(a: Any, v: jax.Array, d: jax.Array, reach: Any, shortest: Any) -> "Walk":
        """Return the walk that starts at a."""
        no, reach = jnp.asarray(False), jnp.maximum(reach, shortest)
        b, above = jnp.minimum(a + reach, 1.0), jnp.zeros(v.shape, bool)
        return Walk(a, v, d, b, v, d, reach, no, above, no, a >= 1.0)

    def onward(self, shortest: Any) -> "Walk":
        """Return the walk behind an event that was found."""
        return Walk.at(self.b, self.vb, self.db, RESTART * self.reach, shortest)


def next_event(
    walk: Walk,
    at: Callable[[Any], tuple[jax.Array, jax.Array]],
    directions: jax.Array,
    touch: jax.Array,
    noise: jax.Array,
    shortest: Any,
) -> Walk:
    """Continue the walk to the next event, or to the end of the step.

    `at(θ)` returns values and slopes; `shortest` is the length of the interval in which an event is
    located, and of the first one behind it.
    """

    def advance(s: Walk) -> Walk:
        m = jnp.where(s.known, s.a + DIVISION * (s.b - s.a), s.b)
        v, d = at(m)
        above = jnp.where(s.known, s.above, jnp.abs(s.va) > noise) | (jnp.abs(v) > noise)
        v, s = jnp.where(above, v, jnp.sign(s.va) * jnp.abs(v)), s._replace(above=above)
        divided = _divide(s, m, v, d, directions, touch, shortest)
        extended = s._replace(vb=v, db=d, known=jnp.asarray(True))
        # A value that is not finite has no sign, and no interval around it would be resolved.
        failed = s._replace(vb=v, ended=jnp.asarray(True))
        new = _tree.where(s.known, divided, extended)
        return _tree.where(jnp.all(jnp.isfinite(v)), new, failed)

    return lax.while_loop(lambda s: ~(s.found | s.ended), advance, walk)


def arrives(v: jax.Array, w: jax.Array, directions: jax.Array) -> jax.Array:
    """Return for which functions zero is reached between two points with the values v and w."""
    return (v != 0) & (jnp.sign(v) * jnp.sign(w) <= 0) & _counts(v, directions)


def _counts(v: jax.Array, directions: jax.Array) -> jax.Array:
    return (directions == 0) | (directions == -jnp.sign(v).astype(directions.dtype))


def touches(
    v: jax.Array, d: jax.Array, w: jax.Array, e: jax.Array, h: Any, directions: Any, touch: Any
) -> jax.Array:
    """Return which functions have values v, w and slopes d, e at the ends of an interval of length h
    that lead to an extremum near zero."""
    sign = jnp.sign(v)
    inward = (sign == jnp.sign(w)) & (sign * d < 0) & (sign * e > 0) & _counts(v, directions)
    # Where the tangents meet, at a distance s of the left end: v + ds = w − e(h − s).
    difference = jnp.where(inward, e - d, 1.0)
    s = (v - w + e * h) / difference
    return inward & (sign * (v + d * s) <= touch)


def _divide(
    walk: Walk, m: Any, v: jax.Array, d: jax.Array, directions: Any, touch: Any, shortest: Any
) -> Walk:
    """Return the walk after the values v and d at m inside its interval."""
    a, va, da, b, vb, db, reach, _, above, *_ = walk
    h = b - a
    happens = lambda p, v, d, q, w, e: (  # noqa: E731
        above & (arrives(v, w, directions) | touches(v, d, w, e, q - p, directions, touch))
    )
    # The cubic of Hermite: va + s(da h + s(c₂ + c₃ s)), s = (m − a)/h.
    s, rise = (m - a) / h, vb - va
    c2, c3 = 3 * rise - (2 * da + db) * h, -2 * rise + (da + db) * h
    value = va + s * (da * h + s * (c2 + c3 * s))
    slope = da * h + s * (2 * c2 + 3 * c3 * s)
    size = jnp.abs(va) + jnp.abs(vb)
    is_short = h <= shortest
    resolved = jnp.abs(v - value) <= _VALUE_ERROR * size + touch
    resolved &= jnp.abs(d * h - slope) <= _SLOPE_ERROR * size + touch
    resolved = jnp.all(resolved) | (h <= _FINEST)
    # At an extremum within `touch` of zero the sign of g is not known, and no zero.
    extremum = touches(va, da, vb, db, h, directions, touch)
    v = jnp.where(extremum & (jnp.abs(v) <= touch), jnp.sign(va) * jnp.abs(v), v)
    v = jnp.where(extremum & (v == 0), jnp.sign(va) * jnp.finfo(v.dtype).tiny, v)
    inside = jnp.any(happens(a, va, da, b, vb, db))
    left = jnp.any(happens(a, va, da, m, v, d))
    right = jnp.any(happens(m, v, d, b, vb, db))
    found = is_short & inside
    to_left = ~found & (~resolved | left)
    to_right = ~found & ~to_left & right
    onward = ~(found | to_left | to_right)
    begin = jnp.where(onward, b, jnp.where(to_right, m, a))
    choose = lambda on, at_m, old: jnp.where(onward, on, jnp.where(to_right, at_m, old))  # noqa: E731
    reach = jnp.where(resolved, reach, DIVISION * h)
    reach = jnp.where(onward, jnp.maximum(reach, 2.0 * h), reach)
    return Walk(
        a=begin,
        va=choose(vb, v, va),
        da=choose(db, d, da),
        b=jnp.where(onward, jnp.minimum(b + reach, 1.0), jnp.where(to_left, m, b)),
        vb=jnp.where(to_left, v, vb),
        db=jnp.where(to_left, d, db),
        reach=reach,
        known=~onward,
        above=above,
        found=found,
        ended=onward & (b >= 1.0),
    )
