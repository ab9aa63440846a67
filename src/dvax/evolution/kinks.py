"""Kinks of the response: where inside a step one lies, and how steps are made to end there.

A kink of f̃ inside a step spoils a method's order, and nothing is gained by making such a step shorter
bit by bit. So a step that was refused is taken anew up to shortly before the kink, which is smooth; a
short step crosses it; and the length that was planned goes on behind. How short, is found out: the
first guess for the kink, from the step that was refused, is right to O(h²) or so, and where the
crossing is refused too, it gives a far better one. Two or three rounds serve any tolerance.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..vi.batch import any_of_batch

_CLOSE = 1e-5
"""Of a step: two guesses in a row so near each other settle where its kink is."""

_MOST = 20
"""Guesses for one kink within a step, and refused steps aimed at one kink."""

_FIRST = 0.02
"""How far before a kink a step is made to end that was guessed from one step alone, in its lengths."""


def first_change(
    thetas: tuple[float, ...], values: list[jax.Array], at: Callable[[Any], jax.Array]
) -> jax.Array:
    """The first θ at which one of the functions changes its sign, ∞ where none does.

    `values` are those at `thetas`, `at(θ)` gives them anywhere. By the method of false position for
    the function that changes first, as Illinois does it: an end that stays has its values halved.
    """
    signs = [v > 0 for v in values]
    changed = [jnp.any(sign != signs[0]) for sign in signs[1:]]
    some = changed[-1] if len(changed) == 1 else jnp.any(jnp.stack(changed))

    def search() -> jax.Array:
        j = jnp.argmax(jnp.stack(changed))
        nodes, table = jnp.asarray(thetas, values[0].dtype), jnp.stack(values)
        return _false_position(nodes[j], table[j], nodes[j + 1], table[j + 1], signs[0], at)

    found = lax.cond(any_of_batch(some), search, lambda: jnp.full_like(values[0][0], jnp.inf))
    return jnp.where(some, found, jnp.inf)


def _false_position(
    a: Any, va: jax.Array, b: Any, vb: jax.Array, sign: jax.Array, at: Callable[[Any], jax.Array]
) -> jax.Array:
    def narrow(s: tuple) -> tuple:
        a, va, b, vb, _, last, before, count = s
        flips = (va > 0) != (vb > 0)
        shares = jnp.where(flips, va / jnp.where(flips, va - vb, 1.0), 1.0)
        theta = a + (b - a) * jnp.min(shares)
        v = at(theta)
        beyond = jnp.any((v > 0) != sign)
        side = jnp.where(beyond, 1, -1)
        again = jnp.where(side == before, 0.5, 1.0)
        a, va, b, vb = (
            jnp.where(beyond, p, q)
            for p, q in ((a, theta), (again * va, v), (theta, b), (v, again * vb))
        )
        return a, va, b, vb, last, theta, side, count + 1

    def unsettled(s: tuple) -> Any:
        a, _, b, _, before, last, _, count = s
        settled = (jnp.abs(last - before) <= _CLOSE) | (b - a <= _CLOSE)
        return ~settled & (count < _MOST)

    nowhere = jnp.full_like(b, -1.0)
    start = a, va, b, vb, nowhere, b, jnp.asarray(0), jnp.asarray(0)
    return lax.while_loop(unsettled, narrow, start)[5]


class Aim(NamedTuple):
    """The kink ahead (∞: none is known) and how well it is known: steps end `margin` before it and
    behind it. `span` is the length of the step that showed it, `tries` how many were refused."""

    kink: Any
    margin: Any
    span: Any
    tries: Any


def nothing_ahead(like: jax.Array) -> jax.Array:
    """An `Aim` as one array, which is how it is carried: a loop is the faster the less it carries."""
    return jnp.stack([jnp.full_like(like, jnp.inf), *(jnp.zeros_like(like),) * 3])


def aim(old: jax.Array, kink: Any, h: Any, floor: Any, refused: Any) -> tuple[jax.Array, Any]:
    """What is known after a step of length h that had a `kink` inside and was or was not refused, and
    whether the next one is aimed anew."""
    was = Aim(*old)
    anew = refused & (kink < jnp.inf) & (was.tries < _MOST)
    # Off by as much as the last guess, times the ratio of lengths: the error is quadratic in them.
    known = was.kink < jnp.inf
    off = 4.0 * jnp.abs(kink - jnp.where(known, was.kink, kink)) * h / jnp.maximum(was.span, h)
    margin = jnp.where(known, jnp.minimum(off, _FIRST * h), _FIRST * h)
    new = Aim(kink, jnp.maximum(margin, 4.0 * floor), h, was.tries + 1)
    return jnp.where(anew, jnp.stack(new), old), anew


def passed(old: jax.Array, t: Any) -> jax.Array:
    """What is known at t."""
    return jnp.where(t > Aim(*old).kink, nothing_ahead(Aim(*old).kink), old)


def until(aim: jax.Array, t: Any) -> Any:
    """Where a step from t ends at the latest: before the kink, or behind it from close by."""
    kink, margin, *_ = aim
    return jnp.where(t < kink - 2.0 * margin, kink - margin, kink + margin)
