"""The weights of a space's diagonal inner product, in the form that the projections use."""

import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..spaces import AbstractSpace


def has_uniform_weight(space: AbstractSpace) -> bool:
    """Return whether all entries have the same weight: projections are then Euclidean."""
    leaves = jtu.tree_leaves(space.weights())
    return len(leaves) == 1 and jnp.ndim(leaves[0]) == 0


def inverse_weights(space: AbstractSpace, like: Tree) -> Tree:
    """Return 1/w, entry by entry, shaped like the element `like`."""

    def one(leaf, w):
        # A scalar weight takes the type of the element. An array of weights keeps its own type, so
        # that mixed precision raises an error instead of a silent cast.
        w = jnp.asarray(w, jnp.result_type(leaf)) if jnp.ndim(w) == 0 else jnp.asarray(w)
        return jnp.broadcast_to(1.0 / w, jnp.shape(leaf))

    return jtu.tree_map(one, like, space.weights())


def full_weights(space: AbstractSpace, like: Tree) -> Tree:
    """Return wᵢ, shaped like an element."""
    return jtu.tree_map(lambda leaf, w: jnp.broadcast_to(w, leaf.shape), like, space.weights())


def flat_roots(space: AbstractSpace, like: Tree) -> jax.Array:
    """Return √wᵢ as one vector."""
    return jnp.sqrt(jax.flatten_util.ravel_pytree(full_weights(space, like))[0])
