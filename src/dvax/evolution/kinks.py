"""Kinks of the response: where inside a step one lies, and how steps are made to end there.

A kink of f̃ inside a step spoils a method's order, and nothing is gained by making such a step shorter
bit by bit. So a step that was refused is taken anew up to shortly before the kink, which is smooth; a
short step crosses it; and the length that was planned goes on behind. How short, is found out: the
first guess for the kink, from the step that was refused, is right to O(h²) or so, and where the
crossing is refused too, it gives a far better one, and so on.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._batch import any_of_batch

_CLOSE = 1e-5
"""Of a step: so narrow a bracket settles where its kink is."""

_MOST = 60
"""Guesses for one kink within a step."""

_AIMS = 8
"""Steps in a row that are aimed at kinks without getting on: then they are shortened as any others."""

_FEW = 4
"""Entries that are joined as they stand."""

_FIRST = 0.02
"""How far before a kink a step is made to end that was guessed from one step alone, in its lengths."""


def first_change(
    thetas: tuple[float, ...],
    values: list[jax.Array],
    at: Callable[[Any], jax.Array],
    asked: Any = True,
) -> jax.Array:
    """The first θ at which one of the functions changes its sign, ∞ where none does, or nobody `asked`.

    `values` are those at `thetas`, `at(θ)` gives them anywhere. By the method of false position for
    the function that changes first, as Illinois does it: an end that stays has its values halved.
    Where a function rests on zero, or two guesses in a row have not halved the bracket, the middle is
    the next one.
    """
    signs = [v > 0 for v in values]
    changed = [_of_all(jnp.logical_or, jnp.any, sign != signs[0]) for sign in signs[1:]]
    some = functools.reduce(jnp.logical_or, changed) & asked

    def search() -> jax.Array:
        nodes = [jnp.asarray(theta, values[0].dtype) for theta in thetas]
        *before, bracket = zip(nodes, values, nodes[1:], values[1:], strict=False)
        for change, ends in zip(reversed(changed[:-1]), reversed(before), strict=True):
            bracket = [jnp.where(change, p, q) for p, q in zip(ends, bracket, strict=True)]
        a, va, b, vb = bracket
        return _false_position(a, va, b, vb, signs[0], at)

    found = lax.cond(any_of_batch(some), search, lambda: jnp.full_like(values[0][0], jnp.inf))
    return jnp.where(some, found, jnp.inf)


def _false_position(
    a: Any, va: jax.Array, b: Any, vb: jax.Array, sign: jax.Array, at: Callable[[Any], jax.Array]
) -> jax.Array:
    """The end of a bracket, no wider than `_CLOSE`, on the side where the sign has changed."""

    def narrow(s: tuple) -> tuple:
        a, va, b, vb, before, slow, count = s
        flips = (va > 0) != (vb > 0)
        shares = jnp.where(flips, va / jnp.where(flips, va - vb, 1.0), 1.0)
        guess = _of_all(jnp.minimum, jnp.min, shares)
        # A little past it, to either side in turn: two good guesses close the bracket.
        inset = jnp.minimum(0.4 * _CLOSE / (b - a), 0.25)
        share = jnp.clip(guess + jnp.where(before > 0, -inset, inset), inset, 1.0 - inset)
        blind = (guess <= 0.0) | (guess >= 1.0) | (slow >= 2)
        theta = a + (b - a) * jnp.where(blind, 0.5, share)
        v = at(theta)
        beyond = _of_all(jnp.logical_or, jnp.any, (v > 0) != sign)
        side = jnp.where(beyond, 1, -1)
        again = jnp.where(side == before, 0.5, 1.0)
        width = b - a
        a, va, b, vb = (
            jnp.where(beyond, p, q)
            for p, q in ((a, theta), (again * va, v), (theta, b), (v, again * vb))
        )
        slow = jnp.where(b - a > 0.5 * width, slow + 1, 0)
        return a, va, b, vb, side, slow, count + 1

    def unsettled(s: tuple) -> Any:
        a, _, b, *_, count = s
        return (b - a > _CLOSE) & (count < _MOST)

    nothing = jnp.asarray(0)
    return lax.while_loop(unsettled, narrow, (a, va, b, vb, nothing, nothing, nothing))[2]


def _of_all(join: Callable, joined: Callable, v: jax.Array) -> jax.Array:
    """All entries joined. What XLA joins them by is a function, and memory for its arguments and result
    is taken and returned at every call of a program, which costs as much as a small step: so few
    entries are joined as they stand."""
    return functools.reduce(join, list(v.ravel())) if 0 < v.size <= _FEW else joined(v)


class Aim(NamedTuple):
    """The kink ahead (∞: none is known) and how well it is known: steps end `margin` before it and
    behind it. `span` is the length of the step that showed it; `tries`, how many steps in a row were
    aimed at kinks, refused or not, without one of a tenth of the first one's length being kept."""

    kink: Any
    margin: Any
    span: Any
    tries: Any


def nothing_ahead(like: jax.Array) -> jax.Array:
    """An `Aim` as one array, which is how it is carried: a loop is the faster the less it carries."""
    return jnp.stack([jnp.full_like(like, jnp.inf), *(jnp.zeros_like(like),) * 3])


def aim(
    old: jax.Array, kink: Any, h: Any, planned: Any, floor: Any, refused: Any
) -> tuple[jax.Array, Any]:
    """What is known after a step of length h, of those that were `planned`, that had a `kink` inside
    and was or was not refused, and whether the next one is aimed anew."""
    was = Aim(*old)
    anew = refused & (kink < jnp.inf) & (was.tries < _AIMS)
    # A guess is off by some h², so by (h/span)² of what the last one was off by; that is left to be
    # one power less, and fourfold. The guess itself is no closer than its bracket.
    known = was.kink < jnp.inf
    off = 4.0 * jnp.abs(kink - jnp.where(known, was.kink, kink)) * h / jnp.maximum(was.span, h)
    margin = jnp.where(known, jnp.minimum(off, _FIRST * h), _FIRST * h)
    margin = jnp.maximum(margin, jnp.maximum(2.0 * _CLOSE * h, 4.0 * floor))
    new = Aim(kink, margin, h, was.tries + 1.0)
    # A step that is kept and not short begins the count anew.
    fresh = ~refused & (h >= 0.1 * planned)
    kept = was._replace(tries=jnp.where(fresh, 0.0, was.tries))
    return jnp.where(anew, jnp.stack(new), jnp.stack(kept)), anew


def passed(old: jax.Array, t: Any) -> jax.Array:
    """What is known at t."""
    was = Aim(*old)
    nothing = Aim(*nothing_ahead(was.kink))._replace(tries=was.tries)
    return jnp.where(t > was.kink, jnp.stack(nothing), old)


def until(aim: jax.Array, t: Any, stop: Any) -> Any:
    """Where a step from t ends at the latest: before the kink, behind it from close by, or at the next
    `stop`, where little would be left up to there."""
    kink, margin, *_ = aim
    end = jnp.where(t < kink - 2.0 * margin, kink - margin, kink + margin)
    return jnp.where(end < stop - margin, end, stop)
