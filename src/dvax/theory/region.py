"""The region for statements about f, h and F: a box of times, states, responses and parameters."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, input_error
from ..programs.slope import Slope, interval, is_slope


class Region(NamedTuple):
    """t0 ≤ t ≤ t1, and x, u and the parameter η between bounds, entry by entry, as trees of intervals.

    η is () if it is fixed. A box is convex, so a bound on a derivative over it is a Lipschitz modulus.
    """

    t: Slope
    x: Tree
    u: Tree
    eta: Tree = ()

    @property
    def leaves(self) -> list[Slope]:
        """The interval of every array."""
        return _slopes(self)

    @property
    def is_everywhere(self) -> bool:
        """True if x and u are unbounded, as in the paper."""
        return all(
            bool(np.isneginf(v.low).all() and np.isposinf(v.high).all())
            for v in _slopes((self.x, self.u))
        )

    def halves(self, whole: "Region") -> Iterator["Region"]:
        """Yield two halves, cut across the entry whose width relative to `whole` is largest."""
        leaves = _slopes(self)
        widest, position = 0.0, None
        for k, (v, w) in enumerate(zip(leaves, _slopes(whole), strict=True)):
            width, full = np.asarray(v.high - v.low), np.asarray(w.high - w.low)
            can_cut = np.isfinite(full) & (full > 0)
            relative = np.where(can_cut, width, 0.0) / np.where(can_cut, full, 1.0)
            if relative.size and relative.max() > widest:
                widest = float(relative.max())
                position = k, np.unravel_index(relative.argmax(), relative.shape)
        if position is None:
            return
        k, entry = position
        v = leaves[k]
        middle = 0.5 * (v.low[entry] + v.high[entry])
        for low, high in ((v.low[entry], middle), (middle, v.high[entry])):
            lows, highs = np.array(v.low), np.array(v.high)
            lows[entry], highs[entry] = low, high
            yield self._with(k, interval(lows, highs))

    def _with(self, k: int, leaf: Slope) -> "Region":
        leaves, structure = jtu.tree_flatten(tuple(self), is_leaf=is_slope)
        leaves[k] = leaf
        return Region(*structure.unflatten(leaves))


def _slopes(tree: Tree) -> list[Slope]:
    return jtu.tree_leaves(tuple(tree), is_leaf=is_slope)


def as_intervals(bounds: Any, like: Tree, name: str) -> Tree:
    """Return a tree of intervals shaped like `like`.

    `bounds` is a pair (low, high) of numbers or elements, or None for infinite bounds.

    **Raises:** `dvax.InputError`.
    """
    if bounds is None:
        bounds = (-np.inf, np.inf)
    if not (isinstance(bounds, tuple | list) and len(bounds) == 2):
        raise _error(name, bounds, "it must be a pair (low, high) of numbers or elements")
    ends = []
    for end in bounds:
        end = _tree.as_float(end, name)
        if _tree.shapes(end) == () and not isinstance(end, tuple):
            end = jtu.tree_map(lambda leaf, v=end: np.full(jnp.shape(leaf), float(v)), like)
        if not _tree.same_shape(end, like):
            raise _error(
                name, f"shape {_tree.shapes(end)}", f"elements have shape {_tree.shapes(like)}"
            )
        ends.append(end)
    out = jtu.tree_map(lambda a, b: interval(np.asarray(a), np.asarray(b)), *ends)
    if any(not (v.low <= v.high).all() for v in _slopes((out,))):
        raise _error(
            name,
            _tree.short(bounds),
            "low ≤ high must hold in every entry, otherwise the region is empty",
        )
    if any(np.isposinf(v.low).any() or np.isneginf(v.high).any() for v in _slopes((out,))):
        raise _error(
            name,
            _tree.short(bounds),
            "low < ∞ and high > −∞ must hold, otherwise the region is empty",
        )
    return out


def _error(name: str, value: Any, rule: str) -> InputError:
    return input_error(name, _tree.short(value), rule, "Give the bounds as (low, high)")
