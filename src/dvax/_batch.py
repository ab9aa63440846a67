"""Conditions and counts shared by all lanes of a `jax.vmap`."""

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap


@custom_vmap
def any_lane(condition: jax.Array) -> jax.Array:
    """Return the condition; under `jax.vmap`, return whether it holds in any lane.

    `lax.cond` on a batched condition computes both branches. On this one it computes the branch only if
    a lane needs it; the caller must then select its result lane by lane.
    """
    return condition


@any_lane.def_vmap
def _(size: int, batched: list[bool], condition: jax.Array) -> tuple[jax.Array, bool]:
    return any_lane(jnp.any(condition, axis=0)), False


@custom_vmap
def largest_of_lanes(count: jax.Array) -> jax.Array:
    """Return the integer; under `jax.vmap`, return the largest one of all lanes.

    A loop with this number of iterations is one loop for all lanes.
    """
    return count


@largest_of_lanes.def_vmap
def _(size: int, batched: list[bool], count: jax.Array) -> tuple[jax.Array, bool]:
    return largest_of_lanes(jnp.max(count, axis=0)), False


@custom_vmap
def is_active(condition: jax.Array) -> jax.Array:
    """Return True; under `jax.vmap`, return the condition.

    A loop on `any_lane(condition)` continues while *any* lane needs it, and this function returns
    whether an iteration belongs to this lane. A loop on the batched condition would select between the
    old and the new values of its whole carry after every iteration; here, tables that are written row
    by row need no selection.
    """
    return jnp.ones_like(condition)


@is_active.def_vmap
def _(size: int, batched: list[bool], condition: jax.Array) -> tuple[jax.Array, bool]:
    return condition, True


def zeros_like_lanes(t: jax.Array) -> jax.Array:
    """Return zeros of the shape of t that are batched if t is; `jnp.zeros_like` is not batched.

    (A value with batched tangents must be batched itself.)
    """
    return jnp.where(t == t, 0.0, 0.0).astype(t.dtype)
