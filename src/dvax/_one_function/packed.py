"""Arrays of several types as one array of floating numbers."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_LONGEST = 10**6
"""Entries of all that is packed."""


def can_pack(leaves: list[Any]) -> bool:
    return all(map(is_number, leaves)) and 0 < sum(leaf.size for leaf in leaves) <= _LONGEST


def is_number(leaf: Any) -> bool:
    return leaf.dtype == bool or jnp.issubdtype(leaf.dtype, jnp.number)


def packed(leaves: list[Any]) -> jax.Array:
    """All of them as one."""
    return jnp.concatenate([_as_floating(leaf).ravel() for leaf in leaves])


def in_a_row(numbers: list[np.ndarray]) -> np.ndarray:
    """The same of single numbers, by NumPy: the compiler has them as one constant."""
    return np.concatenate([np.zeros(0, jnp.result_type(float)), *map(_one_as_floating, numbers)])


def unpacked(vector: jax.Array, like: list[Any]) -> list[jax.Array]:
    """The arrays again, of the shapes and types of `like`."""
    leaves, start = [], 0
    for one in like:
        count = places(one)
        leaves.append(_as_it_was(vector[start : start + count], one.shape, one.dtype))
        start += count
    return leaves


def places(leaf: Any) -> int:
    """Floating numbers that it takes."""
    return math.prod(leaf.shape) * (2 if jnp.issubdtype(leaf.dtype, jnp.complexfloating) else 1)


def _as_floating(leaf: Any) -> jax.Array:
    leaf, wide = jnp.asarray(leaf), jnp.result_type(float)
    if jnp.iscomplexobj(leaf):
        return jnp.stack([jnp.real(leaf), jnp.imag(leaf)]).astype(wide)
    if jnp.issubdtype(leaf.dtype, jnp.floating):
        return leaf.astype(wide)
    return jax.lax.bitcast_convert_type(leaf.astype(jnp.result_type(int)), wide)


def _one_as_floating(number: Any) -> np.ndarray:
    wide = jnp.result_type(float)
    if np.iscomplexobj(number):
        return np.array([number.real, number.imag], wide)
    if jnp.issubdtype(number.dtype, jnp.floating):
        return number.astype(wide).reshape(1)
    return number.astype(jnp.result_type(int)).reshape(1).view(wide)


def _as_it_was(part: jax.Array, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    if jnp.issubdtype(dtype, jnp.complexfloating):
        return jax.lax.complex(*part.reshape(2, *shape)).astype(dtype)
    if jnp.issubdtype(dtype, jnp.floating):
        return part.reshape(shape).astype(dtype)
    whole = jax.lax.bitcast_convert_type(part, jnp.result_type(int))
    return whole.reshape(shape).astype(dtype)
