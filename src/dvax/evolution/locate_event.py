"""Event location: the first sign change of switch functions in a step."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .._batch import any_lane

BRACKET = 1e-5
"""Final width of the bracket, as a share of the step."""

_MAX_ITERATIONS = 60

_UNROLLED = 4
"""Largest number of entries for which a reduction is unrolled."""


def locate_event(
    thetas: tuple[float, ...],
    values: list[jax.Array],
    at: Callable[[Any], jax.Array],
    wanted: Any = True,
) -> jax.Array:
    """Return the first θ at which one of several functions changes its sign, or ∞ if none does.

    `values` are the functions at `thetas`, and `at(θ)` evaluates them anywhere. If not `wanted`, the
    search is skipped and the result is ∞. The search is the Illinois variant of the method of false
    position, for the function that changes first: it halves the values at the retained end of the
    bracket. It bisects if a function is zero on an interval, or if two iterations do not halve the
    bracket.
    """
    signs = [v > 0 for v in values]
    changes = [_reduce(jnp.logical_or, jnp.any, sign != signs[0]) for sign in signs[1:]]
    has_event = functools.reduce(jnp.logical_or, changes) & wanted

    def search() -> jax.Array:
        nodes = [jnp.asarray(theta, values[0].dtype) for theta in thetas]
        *before, bracket = zip(nodes, values, nodes[1:], values[1:], strict=False)
        for change, ends in zip(reversed(changes[:-1]), reversed(before), strict=True):
            bracket = [jnp.where(change, p, q) for p, q in zip(ends, bracket, strict=True)]
        a, va, b, vb = bracket
        return _false_position(a, va, b, vb, signs[0], at)

    theta = lax.cond(any_lane(has_event), search, lambda: jnp.full_like(values[0][0], jnp.inf))
    return jnp.where(has_event, theta, jnp.inf)


def _false_position(
    a: Any, va: jax.Array, b: Any, vb: jax.Array, sign: jax.Array, at: Callable[[Any], jax.Array]
) -> jax.Array:
    """Return the right end of a bracket of the width `BRACKET`, at which the sign has changed."""

    def narrow(s: tuple) -> tuple:
        a, va, b, vb, before, slow, count = s
        flips = (va > 0) != (vb > 0)
        shares = jnp.where(flips, va / jnp.where(flips, va - vb, 1.0), 1.0)
        guess = _reduce(jnp.minimum, jnp.min, shares)
        # Shift the estimate beyond the root, on alternate sides: two good estimates close the bracket.
        inset = jnp.minimum(0.4 * BRACKET / (b - a), 0.25)
        share = jnp.clip(guess + jnp.where(before > 0, -inset, inset), inset, 1.0 - inset)
        bisects = (guess <= 0.0) | (guess >= 1.0) | (slow >= 2)
        theta = a + (b - a) * jnp.where(bisects, 0.5, share)
        v = at(theta)
        beyond = _reduce(jnp.logical_or, jnp.any, (v > 0) != sign)
        side = jnp.where(beyond, 1, -1)
        factor = jnp.where(side == before, 0.5, 1.0)
        width = b - a
        a, va, b, vb = (
            jnp.where(beyond, p, q)
            for p, q in ((a, theta), (factor * va, v), (theta, b), (v, factor * vb))
        )
        slow = jnp.where(b - a > 0.5 * width, slow + 1, 0)
        return a, va, b, vb, side, slow, count + 1

    def is_too_wide(s: tuple) -> Any:
        a, _, b, *_, count = s
        return (b - a > BRACKET) & (count < _MAX_ITERATIONS)

    zero = jnp.asarray(0)
    return lax.while_loop(is_too_wide, narrow, (a, va, b, vb, zero, zero, zero))[2]


def _reduce(join: Callable, reduction: Callable, v: jax.Array) -> jax.Array:
    """Reduce over all entries, unrolled for up to `_UNROLLED` of them: XLA calls a kernel for a
    reduction, which costs as much as a small step."""
    is_unrolled = 0 < v.size <= _UNROLLED
    return functools.reduce(join, list(v.ravel())) if is_unrolled else reduction(v)
