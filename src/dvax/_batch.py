"""Conditions and counts that the lanes of a `jax.vmap` share."""

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap


@custom_vmap
def any_lane(condition: jax.Array) -> jax.Array:
    """Return the condition; under `jax.vmap`, whether it holds in any lane.

    `lax.cond` on a condition of each lane's own computes both branches; on this one it computes the
    branch only where some lane needs it. What the branch returns must then be selected lane by lane.
    """
    return condition


@any_lane.def_vmap
def _(size: int, batched: list[bool], condition: jax.Array) -> tuple[jax.Array, bool]:
    return any_lane(jnp.any(condition, axis=0)), False


@custom_vmap
def largest_of_lanes(count: jax.Array) -> jax.Array:
    """Return the integer; under `jax.vmap`, the largest one of all lanes: a loop with this number of
    iterations is one loop for all lanes."""
    return count


@largest_of_lanes.def_vmap
def _(size: int, batched: list[bool], count: jax.Array) -> tuple[jax.Array, bool]:
    return largest_of_lanes(jnp.max(count, axis=0)), False


@custom_vmap
def is_active(condition: jax.Array) -> jax.Array:
    """Return True; under `jax.vmap`, the condition: whether an iteration of a loop that runs while
    *any* lane needs it (`any_lane`) belongs to this lane.

    A loop on a condition of each lane's own selects between old and new values of its whole carry after
    every iteration. With this one, tables that are written row by row need no selection.
    """
    return jnp.ones_like(condition)


@is_active.def_vmap
def _(size: int, batched: list[bool], condition: jax.Array) -> tuple[jax.Array, bool]:
    return condition, True


def zeros_like_lanes(t: jax.Array) -> jax.Array:
    """Return zeros; under `jax.vmap`, one for each lane of t (`jnp.zeros_like` has none): a value with
    batched tangents has to be batched itself."""
    return jnp.where(t == t, 0.0, 0.0).astype(t.dtype)
