"""Where constants hold: times and states."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace


class Domain(NamedTuple):
    """t0 ≤ t ≤ t1 and low ≤ x ≤ high, entry by entry; `free` says that x, and u within P⁻¹K(t), may
    be anything."""

    t0: float
    t1: float
    low: Tree
    high: Tree
    free: bool

    def covers(self, t0: Any, t1: Any) -> bool:
        """Whether a run from t0 to t1 is within these times (traced times are nobody's to see)."""
        if not _tree.is_concrete(t0, t1):
            return False
        room = 1e-12 * max(abs(self.t0), abs(self.t1))
        return self.t0 - room <= float(t0) and float(t1) <= self.t1 + room

    def keeps(self, xs: Tree, bound: jax.Array, space: AbstractSpace) -> jax.Array:
        """For each time whether all states within `bound` of xs, in norm, are within low and high; and
        whether they were at all the times before."""
        held = jnp.ones(bound.shape, bool)
        weights = jtu.tree_map(
            lambda leaf, w: np.broadcast_to(w, leaf.shape[1:]), xs, space.weights()
        )
        for x, w, low, high in zip(
            *map(jtu.tree_leaves, (xs, weights, self.low, self.high)), strict=True
        ):
            reach = bound.reshape(-1, *(1,) * (x.ndim - 1)) / jnp.sqrt(w)[None]
            inside = (x - reach >= low[None]) & (x + reach <= high[None])
            held = held & jnp.all(inside.reshape(len(bound), -1), axis=1)
        return jnp.cumsum(~held) == 0
