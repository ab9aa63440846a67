"""Roots of decreasing functions of one number, with the derivative of the root itself."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

_MOST = 100


def implicit(fn: Callable, find: Callable[[], jax.Array]) -> jax.Array:
    """The root of `fn` that `find` returns, entry by entry, differentiated as a root: the
    iteration that finds it is not."""

    def slope_away(g: Callable, b: jax.Array) -> jax.Array:
        return b / g(jnp.ones_like(b))

    guess = lax.stop_gradient(find())
    return lax.custom_root(fn, guess, lambda _, at: at, slope_away)


def in_unit_interval(fn: Callable[[jax.Array], jax.Array], like: jax.Array) -> jax.Array:
    """The θ ∈ [0, 1] with fn(θ) = 0, for fn decreasing from ≥ 0 to ≤ 0, entry by entry.

    Newton's method, and bisection wherever a step would leave what is left of the interval.
    """

    def find() -> jax.Array:
        def advance(state: tuple) -> tuple:
            low, high, at, _, count = state
            value, slope = jax.jvp(fn, (at,), (jnp.ones_like(at),))
            low, high = jnp.where(value > 0, at, low), jnp.where(value < 0, at, high)
            newton = at - value / slope
            inside = (newton > low) & (newton < high)
            # On an end of the interval, or at the root, there is no step to take.
            after = jnp.where(value == 0, at, jnp.where(inside, newton, 0.5 * (low + high)))
            return low, high, after, after != at, count + 1

        def unsettled(state: tuple) -> jax.Array:
            return jnp.any(state[3]) & (state[4] < _MOST)

        zero, one = jnp.zeros_like(like), jnp.ones_like(like)
        start = (zero, one, 0.5 * one, jnp.ones(like.shape, bool), 0)
        return lax.while_loop(unsettled, advance, start)[2]

    return implicit(fn, find)
