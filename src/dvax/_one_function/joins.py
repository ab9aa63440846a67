"""Arrays put together, part by part.

Where XLA draws it into a loop, an array of several parts asks at every entry which part that is of.
Here the parts are written one after the other into a blank one.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def is_joined(eqn: Any) -> bool:
    return eqn.primitive.name in ("concatenate", "stack")


def part_by_part(eqn: Any, parts: list[jax.Array], one: jax.Array) -> jax.Array:
    """The parts of a `concatenate` or a `stack`, joined."""
    if eqn.primitive.name == "concatenate":
        return joined(parts, eqn.params["dimension"], one)
    axis = eqn.params["axis"]
    return joined([jnp.expand_dims(part, axis) for part in parts], axis, one)


def joined(parts: list[jax.Array], axis: int, one: jax.Array) -> jax.Array:
    """The parts along an axis. The compiler sees through places that it knows, so `one` is a 1 that it
    does not."""
    shape = list(parts[0].shape)
    shape[axis] = sum(part.shape[axis] for part in parts)
    whole, begin = jnp.zeros(shape, parts[0].dtype), (one - 1.0).astype(jnp.int32)
    for part in parts:
        whole = lax.dynamic_update_slice_in_dim(whole, part, begin, axis)
        begin = begin + part.shape[axis]
    return whole
