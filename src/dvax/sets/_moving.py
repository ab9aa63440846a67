"""Derivatives with respect to those inputs alone that have a tangent."""

from collections.abc import Callable

import jax
from jax.custom_derivatives import SymbolicZero


def jvp_of_moving(fn: Callable[..., jax.Array], primals: tuple, tangents: tuple) -> jax.Array:
    """Return the derivative of fn(*primals). Inputs whose tangent is a `SymbolicZero` are constants:
    the derivative of a projection in z alone is a projection."""
    moving = [k for k, v in enumerate(tangents) if not isinstance(v, SymbolicZero)]

    def of_moving(*values: jax.Array) -> jax.Array:
        inputs = list(primals)
        for k, value in zip(moving, values, strict=True):
            inputs[k] = value
        return fn(*inputs)

    return jax.jvp(of_moving, [primals[k] for k in moving], [tangents[k] for k in moving])[1]
