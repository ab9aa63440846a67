"""Where constants hold: at what parameter, for what times and states."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace


class Domain(eqx.Module):
    """t0 ≤ t ≤ t1, one `args`, and x and u between bounds (low, high), entry by entry: None where x
    may be anything, and u anything within P⁻¹K(t)."""

    t0: float
    t1: float
    x: tuple[Tree, Tree] | None
    u: tuple[Tree, Tree] | None
    values: tuple[Any, ...]
    frame: tuple[Any, ...] = eqx.field(static=True)

    def __init__(
        self,
        t0: float,
        t1: float,
        x: tuple[Tree, Tree] | None,
        u: tuple[Tree, Tree] | None,
        args: Any,
    ):
        self.t0, self.t1, self.x, self.u = t0, t1, x, u
        self.values, self.frame = _taken_apart(args)

    @property
    def free(self) -> bool:
        return self.x is None and self.u is None

    def covers(self, t0: Any, t1: Any) -> bool:
        """Whether a run from t0 to t1 is within these times (traced times are nobody's to see)."""
        if not _tree.is_concrete(t0, t1):
            return False
        room = 1e-12 * max(abs(self.t0), abs(self.t1))
        return self.t0 - room <= float(t0) and float(t1) <= self.t1 + room

    def is_of(self, args: Any) -> bool:
        """Whether these are the `args` of the constants (traced ones are nobody's to see)."""
        values, frame = _taken_apart(args)
        if frame != self.frame or not _tree.is_concrete(values, self.values):
            return False
        return all(np.array_equal(a, b) for a, b in zip(values, self.values, strict=True))

    def keeps(
        self,
        x: tuple[Tree, Tree],
        u: tuple[Tree, Tree],
        of_x: jax.Array,
        of_u: jax.Array,
        spaces: tuple[AbstractSpace, ...],
    ) -> jax.Array:
        """For each saved time whether all states and responses within these bounds of what lies between
        x = (low, high), and u, in norm, are inside; and whether they were at all the times before."""
        held = jnp.ones(of_x.shape, bool)
        for values, bound, ends, space in zip((x, u), (of_x, of_u), (self.x, self.u), spaces):
            if ends is not None:
                held = held & _inside(*values, bound, ends, space)
        return jnp.cumsum(~held) == 0


def _taken_apart(args: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """The numbers in args, and all the rest of it."""
    leaves, structure = jtu.tree_flatten(args)
    numbers = tuple(leaf for leaf in leaves if eqx.is_array_like(leaf))
    others = tuple(None if eqx.is_array_like(leaf) else leaf for leaf in leaves)
    return numbers, (structure, others)


def _inside(
    lows: Tree, highs: Tree, bound: jax.Array, ends: tuple[Tree, Tree], space: AbstractSpace
) -> jax.Array:
    held = jnp.ones(bound.shape, bool)
    weights = jtu.tree_map(
        lambda leaf, w: np.broadcast_to(w, leaf.shape[1:]), lows, space.weights()
    )
    leaves = map(jtu.tree_leaves, (lows, highs, weights, *ends))
    for least, most, w, low, high in zip(*leaves, strict=True):
        reach = bound.reshape(-1, *(1,) * (least.ndim - 1)) / jnp.sqrt(w)[None]
        inside = (least - reach >= low[None]) & (most + reach <= high[None])
        held = held & jnp.all(inside.reshape(len(bound), -1), axis=1)
    return held
