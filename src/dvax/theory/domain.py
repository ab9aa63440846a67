"""The validity of constants: an interval of time, one value of `args`, and bounds on x and u."""

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
    """The set of times, parameters, states and responses for which constants hold.

    They hold for t0 ≤ t ≤ t1 (−∞ and ∞ if f, h and K do not depend on t) and one value of `args`.
    `x` and `u` are entrywise bounds (low, high); None means any x, and any u in P⁻¹K(t).
    """

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
        # Copies: an array of NumPy may be changed afterwards, and would still equal itself.
        values, self.frame = _numbers_and_rest(args)
        self.values = tuple(np.array(v) if isinstance(v, np.ndarray) else v for v in values)

    @property
    def is_unbounded(self) -> bool:
        """True if x and u are unrestricted."""
        return self.x is None and self.u is None

    def covers(self, t0: Any, t1: Any) -> bool:
        """Return whether a run from t0 to t1 lies in the interval of time; False for traced times."""
        if not _tree.is_concrete(t0, t1):
            return False
        margin = 1e-12 * max(abs(self.t0), abs(self.t1))
        return self.t0 - margin <= float(t0) and float(t1) <= self.t1 + margin

    def has_args(self, args: Any) -> bool:
        """Return whether `args` equals that of the constants; False for traced values."""
        values, frame = _numbers_and_rest(args)
        if frame != self.frame or not _tree.is_concrete(values, self.values):
            return False
        return all(np.array_equal(a, b) for a, b in zip(values, self.values, strict=True))

    def contains(
        self,
        x: tuple[Tree, Tree],
        u: tuple[Tree, Tree],
        x_error: jax.Array,
        u_error: jax.Array,
        spaces: tuple[AbstractSpace, ...],
    ) -> jax.Array:
        """Return, for each saved time, whether the exact x and u lie in the domain up to that time.

        `x` and `u` are bounds (low, high) on the computed values, and `x_error` and `u_error` are
        bounds on the norms of their errors.
        """
        inside = jnp.ones(x_error.shape, bool)
        for values, error, ends, space in zip((x, u), (x_error, u_error), (self.x, self.u), spaces):
            if ends is not None:
                inside = inside & _inside(*values, error, ends, space)
        return jnp.cumsum(~inside) == 0


def _numbers_and_rest(args: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return the numbers in args, and its structure with the other leaves."""
    leaves, structure = jtu.tree_flatten(args)
    numbers = tuple(leaf for leaf in leaves if eqx.is_array_like(leaf))
    others = tuple(None if eqx.is_array_like(leaf) else leaf for leaf in leaves)
    return numbers, (structure, others)


def _inside(
    lows: Tree, highs: Tree, bound: jax.Array, ends: tuple[Tree, Tree], space: AbstractSpace
) -> jax.Array:
    """Return whether all values in [lows, highs] with errors of norm ≤ `bound` lie between `ends`."""
    all_inside = jnp.ones(bound.shape, bool)
    weights = jtu.tree_map(
        lambda leaf, w: np.broadcast_to(w, leaf.shape[1:]), lows, space.weights()
    )
    leaves = map(jtu.tree_leaves, (lows, highs, weights, *ends))
    for least, most, w, low, high in zip(*leaves, strict=True):
        reach = bound.reshape(-1, *(1,) * (least.ndim - 1)) / jnp.sqrt(w)[None]
        inside = (least - reach >= low[None]) & (most + reach <= high[None])
        all_inside = all_inside & jnp.all(inside.reshape(len(bound), -1), axis=1)
    return all_inside
