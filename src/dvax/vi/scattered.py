"""Vectors of scattered entries, by which products probe an operator that has no matrix."""

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree


def scattered(like: Tree, seed: int) -> Tree:
    """Return entries in [−1, 1) from a hash of their index: no shift of one vector is like another."""

    def entries(k: int, leaf: jax.Array) -> jax.Array:
        index = jnp.arange(leaf.size, dtype=jnp.uint32) + jnp.uint32(leaf.size * k)
        hashed = (index + jnp.uint32(seed * 0x9E3779B9 % 2**32)) * jnp.uint32(0x85EBCA6B)
        hashed = (hashed ^ (hashed >> 15)) * jnp.uint32(0xC2B2AE35)
        hashed = hashed ^ (hashed >> 13)
        return (hashed.astype(leaf.dtype) / 2.0**31 - 1.0).reshape(leaf.shape)

    leaves, structure = jtu.tree_flatten(like)
    return jtu.tree_unflatten(structure, [entries(k, leaf) for k, leaf in enumerate(leaves)])
