"""The weights of a space, entry by entry; after scaling by their roots, norms are Euclidean."""

from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._tree import Tree
from ..spaces import AbstractSpace


def full_weights(space: AbstractSpace, like: Tree) -> Tree:
    """Return wᵢ, shaped like an element."""
    return jtu.tree_map(lambda leaf, w: jnp.broadcast_to(w, leaf.shape), like, space.weights())


def flat_roots(space: AbstractSpace, like: Tree) -> jax.Array:
    """Return √wᵢ as one vector."""
    return jnp.sqrt(jax.flatten_util.ravel_pytree(full_weights(space, like))[0])


def roots(space: AbstractSpace, like: Tree) -> list[Any]:
    """Return √wᵢ of every leaf as a flat NumPy array."""
    return [
        np.broadcast_to(np.sqrt(np.asarray(w, float)), leaf.shape).ravel()
        for leaf, w in zip(jtu.tree_leaves(like), jtu.tree_leaves(space.weights()), strict=True)
    ]
