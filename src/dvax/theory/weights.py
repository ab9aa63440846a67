"""The weights of a space, entry by entry; after scaling by their roots, norms are Euclidean."""

from typing import Any

import jax.tree_util as jtu
import numpy as np

from .._tree import Tree
from ..spaces import AbstractSpace


def roots(space: AbstractSpace, like: Tree) -> list[Any]:
    """Return √wᵢ of every leaf as a flat NumPy array."""
    return [
        np.broadcast_to(np.sqrt(np.asarray(w, float)), leaf.shape).ravel()
        for leaf, w in zip(jtu.tree_leaves(like), jtu.tree_leaves(space.weights()), strict=True)
    ]
