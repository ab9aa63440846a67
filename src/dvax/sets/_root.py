"""Roots of decreasing scalar functions, differentiated by the differentiable_root function theorem."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

_MAX_ITERATIONS = 100


def differentiable_root(fn: Callable, find: Callable[[], jax.Array]) -> jax.Array:
    """Return the root of `fn` that `find` computes, entry by entry.

    The derivative follows from the differentiable_root function theorem; the iteration of `find` is not
    differentiated.
    """

    def divide_by_slope(g: Callable, b: jax.Array) -> jax.Array:
        return b / g(jnp.ones_like(b))

    guess = lax.stop_gradient(find())
    return lax.custom_root(fn, guess, lambda _, at: at, divide_by_slope)


def root_in_unit_interval(fn: Callable[[jax.Array], jax.Array], like: jax.Array) -> jax.Array:
    """Return θ ∈ [0, 1] with fn(θ) = 0, entry by entry, for fn decreasing from ≥ 0 to ≤ 0.

    Newton's method, safeguarded by bisection where a step would leave the bracketing interval.
    """

    def find() -> jax.Array:
        def advance(state: tuple) -> tuple:
            low, high, at, _, count = state
            value, slope = jax.jvp(fn, (at,), (jnp.ones_like(at),))
            low, high = jnp.where(value > 0, at, low), jnp.where(value < 0, at, high)
            newton = at - value / slope
            inside = (newton > low) & (newton < high)
            # The iterate is unchanged at the root and once the bracket is two adjacent numbers.
            after = jnp.where(value == 0, at, jnp.where(inside, newton, 0.5 * (low + high)))
            return low, high, after, after != at, count + 1

        def unconverged(state: tuple) -> jax.Array:
            return jnp.any(state[3]) & (state[4] < _MAX_ITERATIONS)

        zero, one = jnp.zeros_like(like), jnp.ones_like(like)
        start = (zero, one, 0.5 * one, jnp.ones(like.shape, bool), 0)
        return lax.while_loop(unconverged, advance, start)[2]

    return differentiable_root(fn, find)
