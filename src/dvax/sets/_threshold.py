"""The threshold τ with Σᵢ (zᵢ − τ/wᵢ)₊ = total, for projections onto simplices and ℓ¹ balls.

The sum is a convex, decreasing, piecewise linear function of τ. Newton's method started left of the
root therefore increases monotonically and terminates after finitely many steps (Michelot 1986): at
most as many as there are entries, in practice four to seven. The textbook method sorts the entries;
a sort by XLA takes five times as long as all of these steps.
"""

import jax
import jax.numpy as jnp
from jax import lax


def entry_thresholds(
    z: jax.Array, total: jax.Array, inverse_w: jax.Array | None
) -> tuple[jax.Array, jax.Array]:
    """Return the thresholds along the last axis, repeated for every entry of z.

    With them `subtract_and_clip` is argmin Σᵢ wᵢ(pᵢ − zᵢ)² over p ≥ 0 with Σᵢ pᵢ = total. The weights
    are 1 if `inverse_w` is None. `total` has the shape of z without the last axis.
    """
    shift, level = shift_and_level(z, total, inverse_w, axis=-1)
    return jnp.broadcast_to(shift[..., None], z.shape), jnp.broadcast_to(level[..., None], z.shape)


def subtract(
    z: jax.Array, shift: jax.Array, level: jax.Array, inverse_w: jax.Array | None
) -> jax.Array:
    """Return z − (shift + level)/w, entry by entry."""
    p = z - (shift if inverse_w is None else inverse_w * shift)
    return p - (level if inverse_w is None else inverse_w * level)


def subtract_and_clip(
    z: jax.Array, shift: jax.Array, level: jax.Array, inverse_w: jax.Array | None
) -> jax.Array:
    """Return (z − (shift + level)/w)₊, entry by entry.

    An entry of exactly zero is active (the convention of AbstractSet), except the largest one: as the
    total increases from 0, that entry increases.
    """
    p = subtract(z, shift, level, inverse_w)
    # Clip the largest entry if p < 0 and the others if p ≤ 0. Both are false for NaN, which remains.
    clipped = jnp.where(_heights(z, inverse_w) == shift, p < 0, p <= 0)
    return jnp.where(clipped, 0.0, p)


def shift_and_level(
    z: jax.Array, total: jax.Array, inverse_w: jax.Array | None, axis: int
) -> tuple[jax.Array, jax.Array]:
    """Return (maxᵢ wᵢzᵢ, τ − maxᵢ wᵢzᵢ) along `axis`; entries of −∞ are ignored.

    The iteration determines only *which* entries are positive, and is not differentiated. On that
    face τ has an explicit formula, which is differentiated.
    """

    def spread(a: jax.Array) -> jax.Array:
        return jnp.broadcast_to(jnp.expand_dims(a, axis), z.shape)

    def scaled(tau: jax.Array, inverse_w: jax.Array | None) -> jax.Array:
        return spread(tau) if inverse_w is None else inverse_w * spread(tau)

    # τ is measured from the largest wᵢzᵢ. The relevant numbers then have the magnitude of the total,
    # not that of z, which avoids cancellation for a distant z; the shift changes neither p nor its
    # derivatives.
    fixed_w = None if inverse_w is None else lax.stop_gradient(inverse_w)
    heights = _heights(z, inverse_w)
    shift = jnp.max(heights, axis=axis)
    top = heights == spread(shift)  # positive for every total > 0
    s = z - scaled(shift, inverse_w)
    fixed_s, goal = lax.stop_gradient(s), lax.stop_gradient(total)

    def positive(level: jax.Array) -> jax.Array:
        # "Not ≤ 0" is true for NaN, so that NaN propagates. An entry of exactly zero is active: the
        # convention of AbstractSet.
        return ~(fixed_s - scaled(level, fixed_w) <= 0) | top

    def level_of(
        face: jax.Array, s: jax.Array, goal: jax.Array, inverse_w: jax.Array | None
    ) -> jax.Array:
        surplus = jnp.sum(jnp.where(face, s, 0.0), axis=axis) - goal
        weights = jnp.ones((), z.dtype) if inverse_w is None else inverse_w
        return surplus / jnp.sum(jnp.where(face, weights, 0.0), axis=axis)

    def newton_step(state: tuple) -> tuple:
        level = state[1]
        # The maximum prevents a decrease by roundoff at the root, which would prolong the loop.
        return level, jnp.maximum(level, level_of(positive(level), fixed_s, goal, fixed_w))

    # A single entry equals the total at wᵢ(zᵢ − total), which is a lower bound of τ.
    lowest = -goal
    if fixed_w is not None:
        lowest = lowest / jnp.max(jnp.where(top, fixed_w, 0.0), axis=axis)
    _, level = lax.while_loop(
        lambda state: jnp.any(state[1] > state[0]), newton_step, newton_step((lowest, lowest))
    )
    return shift, level_of(positive(level), s, total, inverse_w)


def _heights(z: jax.Array, inverse_w: jax.Array | None) -> jax.Array:
    fixed = lax.stop_gradient(z)
    return fixed if inverse_w is None else fixed / lax.stop_gradient(inverse_w)
