"""The number τ at which Σᵢ (zᵢ − τ/wᵢ)₊ reaches a given total: simplices and ℓ¹ balls.

The sum is a convex, decreasing, piecewise linear function of τ, so Newton's method started left of
the root climbs to it monotonically and is there after finitely many steps (Michelot 1986; at most
as many as there are entries, in practice four to seven). Sorting is the textbook's way; XLA's is
five times slower than all of these steps.
"""

import jax
import jax.numpy as jnp
from jax import lax


def thresholds(
    z: jax.Array, total: jax.Array, inverse_w: jax.Array | None
) -> tuple[jax.Array, jax.Array]:
    """`levels` along the last axis, once an entry: with them `cut` is argmin Σᵢ wᵢ(pᵢ − zᵢ)² over p ≥ 0
    with Σᵢ pᵢ = total, weights 1 where None. `total` has the shape of z without that axis."""
    shift, level = levels(z, total, inverse_w, axis=-1)
    return jnp.broadcast_to(shift[..., None], z.shape), jnp.broadcast_to(level[..., None], z.shape)


def above(
    z: jax.Array, shift: jax.Array, level: jax.Array, inverse_w: jax.Array | None
) -> jax.Array:
    """z − (shift + level)/w, entry by entry."""
    p = z - (shift if inverse_w is None else inverse_w * shift)
    return p - (level if inverse_w is None else inverse_w * level)


def cut(z: jax.Array, shift: jax.Array, level: jax.Array, inverse_w: jax.Array | None) -> jax.Array:
    """(z − (shift + level)/w)₊, entry by entry. An entry of exactly zero is held, which is the
    convention of AbstractSet, but for the largest: it grows from a total of 0."""
    p = above(z, shift, level, inverse_w)
    # "Below" is less than 0 for the largest, and at most 0 for the others; NaN is neither: it stays.
    below = jnp.where(_heights(z, inverse_w) == shift, p < 0, p <= 0)
    return jnp.where(below, 0.0, p)


def levels(
    z: jax.Array, total: jax.Array, inverse_w: jax.Array | None, axis: int
) -> tuple[jax.Array, jax.Array]:
    """(the largest wᵢzᵢ, τ less this) along `axis`; entries of −∞ take no part.

    Only *which* entries are positive is found by iteration, with derivatives cut; on that face τ is
    a formula, whose derivatives are those of τ.
    """

    def spread(a: jax.Array) -> jax.Array:
        return jnp.broadcast_to(jnp.expand_dims(a, axis), z.shape)

    def scaled(tau: jax.Array, inverse_w: jax.Array | None) -> jax.Array:
        return spread(tau) if inverse_w is None else inverse_w * spread(tau)

    # τ is counted from the largest wᵢzᵢ. All that matters then has the size of the total, not that
    # of z, and far-away points lose no digits; a shift changes neither p nor its derivatives.
    fixed_w = None if inverse_w is None else lax.stop_gradient(inverse_w)
    heights = _heights(z, inverse_w)
    shift = jnp.max(heights, axis=axis)
    top = heights == spread(shift)  # always positive, and the one to grow from a total of 0
    s = z - scaled(shift, inverse_w)
    fixed_s, goal = lax.stop_gradient(s), lax.stop_gradient(total)

    def positive(level: jax.Array) -> jax.Array:
        # "Not held" rather than "positive", so that NaN stays in and comes out. An entry of exactly
        # zero is held: the convention of AbstractSet.
        return ~(fixed_s - scaled(level, fixed_w) <= 0) | top

    def level_of(
        face: jax.Array, s: jax.Array, goal: jax.Array, inverse_w: jax.Array | None
    ) -> jax.Array:
        reach = jnp.sum(jnp.where(face, s, 0.0), axis=axis) - goal
        weights = jnp.ones((), z.dtype) if inverse_w is None else inverse_w
        return reach / jnp.sum(jnp.where(face, weights, 0.0), axis=axis)

    def climb(state: tuple) -> tuple:
        level = state[1]
        # Never back: rounding at the root of one simplex must not keep the others waiting.
        return level, jnp.maximum(level, level_of(positive(level), fixed_s, goal, fixed_w))

    # One entry alone would reach the total at wᵢ(zᵢ − total): a bound from the left.
    lowest = -goal
    if fixed_w is not None:
        lowest = lowest / jnp.max(jnp.where(top, fixed_w, 0.0), axis=axis)
    _, level = lax.while_loop(
        lambda state: jnp.any(state[1] > state[0]), climb, climb((lowest, lowest))
    )
    return shift, level_of(positive(level), s, total, inverse_w)


def _heights(z: jax.Array, inverse_w: jax.Array | None) -> jax.Array:
    fixed = lax.stop_gradient(z)
    return fixed if inverse_w is None else fixed / lax.stop_gradient(inverse_w)
