"""The weights of a space, entry by entry: in what they scale, norms are Euclidean."""

from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._tree import Tree
from ..spaces import AbstractSpace


def whole(space: AbstractSpace, like: Tree) -> Tree:
    """wᵢ, shaped like an element."""
    return jtu.tree_map(lambda leaf, w: jnp.broadcast_to(w, leaf.shape), like, space.weights())


def flat_roots(space: AbstractSpace, like: Tree) -> jax.Array:
    """√wᵢ of an element as one vector."""
    return jnp.sqrt(jax.flatten_util.ravel_pytree(whole(space, like))[0])


def roots(space: AbstractSpace, like: Tree) -> list[Any]:
    """√wᵢ of every leaf, flat, as NumPy arrays."""
    return [np.sqrt(np.asarray(w, float)).ravel() for w in jtu.tree_leaves(whole(space, like))]
