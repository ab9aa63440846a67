"""The diagonal of a space's inner product, as the projections need it."""

import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..spaces import AbstractSpace


def even(space: AbstractSpace) -> bool:
    """Whether one number weighs every entry alike: projections are then those of ℝⁿ."""
    leaves = jtu.tree_leaves(space.weights())
    return len(leaves) == 1 and jnp.ndim(leaves[0]) == 0


def inverse_weights(space: AbstractSpace, like: Tree) -> Tree:
    """1/w, entry by entry, shaped like the element `like`."""

    def one(leaf, w):
        # The plain number of a Euclidean space takes the type of the element; weights that are
        # data do not, so that a mixture of precisions is seen.
        w = jnp.asarray(w, jnp.result_type(leaf)) if jnp.ndim(w) == 0 else jnp.asarray(w)
        return jnp.broadcast_to(1.0 / w, jnp.shape(leaf))

    return jtu.tree_map(one, like, space.weights())
