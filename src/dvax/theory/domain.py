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
    """t0 ≤ t ≤ t1, and x and u between bounds (low, high), entry by entry: None where x may be
    anything, and u anything within P⁻¹K(t)."""

    t0: float
    t1: float
    x: tuple[Tree, Tree] | None
    u: tuple[Tree, Tree] | None

    @property
    def free(self) -> bool:
        return self.x is None and self.u is None

    def covers(self, t0: Any, t1: Any) -> bool:
        """Whether a run from t0 to t1 is within these times (traced times are nobody's to see)."""
        if not _tree.is_concrete(t0, t1):
            return False
        room = 1e-12 * max(abs(self.t0), abs(self.t1))
        return self.t0 - room <= float(t0) and float(t1) <= self.t1 + room

    def keeps(
        self,
        xs: Tree,
        us: Tree,
        of_x: jax.Array,
        of_u: jax.Array,
        spaces: tuple[AbstractSpace, ...],
    ) -> jax.Array:
        """For each saved time whether all states and responses within these bounds of xs and us, in
        norm, are inside; and whether they were at all the times before."""
        held = jnp.ones(of_x.shape, bool)
        for values, bound, ends, space in zip((xs, us), (of_x, of_u), (self.x, self.u), spaces):
            if ends is not None:
                held = held & _inside(values, bound, ends, space)
        return jnp.cumsum(~held) == 0


def _inside(
    values: Tree, bound: jax.Array, ends: tuple[Tree, Tree], space: AbstractSpace
) -> jax.Array:
    held = jnp.ones(bound.shape, bool)
    weights = jtu.tree_map(
        lambda leaf, w: np.broadcast_to(w, leaf.shape[1:]), values, space.weights()
    )
    for v, w, low, high in zip(*map(jtu.tree_leaves, (values, weights, *ends)), strict=True):
        reach = bound.reshape(-1, *(1,) * (v.ndim - 1)) / jnp.sqrt(w)[None]
        inside = (v - reach >= low[None]) & (v + reach <= high[None])
        held = held & jnp.all(inside.reshape(len(bound), -1), axis=1)
    return held
