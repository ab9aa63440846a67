"""Where a statement about f, h and F is meant to hold: a box of times, states and responses."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..programs.slope import Slope, interval, is_slope


class Region(NamedTuple):
    """t0 ≤ t ≤ t1, and x, u and the parameter η between bounds, entry by entry: trees of intervals
    each. η is () where it does not vary.

    A box is convex, so what bounds a derivative on it bounds a Lipschitz modulus.
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
    def everywhere(self) -> bool:
        """Whether x and u are free, as the paper has them."""
        return all(
            bool(np.isneginf(v.low).all() and np.isposinf(v.high).all())
            for v in _slopes((self.x, self.u))
        )

    @property
    def bounded(self) -> bool:
        return all(
            bool(np.isfinite(v.low).all() and np.isfinite(v.high).all()) for v in _slopes(self)
        )

    def halves(self, whole: "Region") -> Iterator["Region"]:
        """Cut across the direction in which this piece of `whole` is relatively widest."""
        leaves = _slopes(self)
        best, place = 0.0, None
        for k, (v, w) in enumerate(zip(leaves, _slopes(whole), strict=True)):
            width, full = np.asarray(v.high - v.low), np.asarray(w.high - w.low)
            cuttable = np.isfinite(full) & (full > 0)
            share = np.where(cuttable, width, 0.0) / np.where(cuttable, full, 1.0)
            if share.size and share.max() > best:
                best, place = float(share.max()), (k, np.unravel_index(share.argmax(), share.shape))
        if place is None:
            return
        k, entry = place
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


def between(bounds: Any, like: Tree, name: str) -> Tree:
    """A tree of intervals shaped like `like`, from (low, high): numbers, or elements; or None.

    **Raises:** `dvax.InputError`.
    """
    if bounds is None:
        bounds = (-np.inf, np.inf)
    if not (isinstance(bounds, tuple | list) and len(bounds) == 2):
        raise _wrong(name, bounds, "it must be a pair (low, high) of numbers or elements")
    ends = []
    for end in bounds:
        end = _tree.as_float(end, name)
        if _tree.shapes(end) == () and not isinstance(end, tuple):
            end = jtu.tree_map(lambda leaf, v=end: np.full(jnp.shape(leaf), float(v)), like)
        if not _tree.same_shape(end, like):
            raise _wrong(
                name, f"shape {_tree.shapes(end)}", f"elements have shape {_tree.shapes(like)}"
            )
        ends.append(end)
    out = jtu.tree_map(lambda a, b: interval(np.asarray(a), np.asarray(b)), *ends)
    if any(not (v.low <= v.high).all() for v in _slopes((out,))):
        raise _wrong(name, _tree.short(bounds), "low ≤ high in every entry, or the region is empty")
    if any(np.isposinf(v.low).any() or np.isneginf(v.high).any() for v in _slopes((out,))):
        raise _wrong(name, _tree.short(bounds), "low < ∞ and high > −∞, or the region has no point")
    return out


def _wrong(name: str, given: Any, rule: str) -> InputError:
    return InputError(
        InputProblem(name, _tree.short(given), rule, "Give the bounds as (low, high)")
    )
