"""Functions of one value, tightened by cutting the interval of this value into pieces.

Interval arithmetic forgets that x²/(1 + x²) contains one x twice. A *chain* is a composition of
elementwise operations on a single value v, its *root*: q = g(v), entry by entry. On a piece of the
interval of v, what is added to the ranges of g and g′ is proportional to the length of the piece. So
they are bounded on many pieces, and ∂q = g′(v) ∂v with the hull of these bounds.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..interpreter import is_real
from ..smooth import SMOOTH_NAMES
from .values import Part, Slope, Values, is_slope, mapped, scaled, sharper

CURVED = SMOOTH_NAMES | {"mul", "div", "max", "min", "clamp", "abs", "pow"}
"""The operations of a chain that are not affine."""

OPERATIONS = CURVED | {"add", "add_any", "sub", "neg"}
"""The operations of a chain."""

_UNIFORM = 256
"""Number of pieces of equal length."""

_SHARES = 2.0 ** (-np.arange(1, 321) / 8.0)
"""Distances from the ends of an interval, and from zero, at which it is cut as well, as shares of its
length: a function may change within 1e-6 of a long interval."""

_MAX_NUMBERS = 400_000
"""Largest number of pieces times entries."""


class Chains:
    """The chains of one enclosure. `operate(eqn, operands)` returns the result of an operation."""

    def __init__(self, operate: Callable[[Any, list[Any]], Slope | None]):
        self._operate = operate
        self._roots: dict[int, tuple[Slope, Slope, int]] = {}
        self._tight: dict[int, tuple[Slope, Slope]] = {}

    def operands(self, eqn: Any, operands: list[Any]) -> list[Any]:
        """Return the operands, tightened unless this operation goes on with their chain."""
        if self._goes_on(eqn, [v for v in operands if is_slope(v)]):
            return operands
        return [self.tightened(v) for v in operands]

    def tightened(self, value: Any) -> Any:
        """Return a value with the bounds on its range and derivative that follow from its chain."""
        if not is_slope(value) or value.source is None or value.low.dtype.kind != "f":
            return value
        if id(value) not in self._tight:
            self._tight[id(value)] = value, self._by_pieces(value)
        return self._tight[id(value)][1]

    def _goes_on(self, eqn: Any, slopes: list[Slope]) -> bool:
        name = eqn.primitive.name
        if name not in OPERATIONS or not is_real(eqn.outvars[0].aval):
            return False
        if any(v.source is None or v.low.shape != eqn.outvars[0].aval.shape for v in slopes):
            return False
        first, *others = (self._root(v)[0] for v in slopes)
        return all(_is_same(first, other) for other in others)

    def _root(self, value: Slope) -> tuple[Slope, int]:
        """Return the root of a value with a source, and the number of operations from there."""
        known = self._roots.get(id(value))
        if known is None:
            source, root, count = value.source, value, 0
            if source.eqn is not None:
                slopes = [v for v in source.operands if is_slope(v)]
                if self._goes_on(source.eqn, slopes):
                    roots = [self._root(v) for v in slopes]
                    root, count = roots[0][0], 1 + sum(number for _, number in roots)
            # The value is kept, so that no other one gets its id.
            known = self._roots[id(value)] = value, root, count
        return known[1], known[2]

    def _by_pieces(self, value: Slope) -> Slope:
        root, count = self._root(value)
        is_curved = any(np.any(part.radius > 0) for part in value.parts.values())
        bounded = np.isfinite(root.low) & np.isfinite(root.high)
        if count < 2 or not is_curved or not bounded.any():
            return value
        ends = cuts(root.low, root.high)
        if ends is None:
            return value
        ones = np.ones((len(ends) - 1, *root.low.shape))
        piece = Slope(ends[:-1], ends[1:], {0: Part(ones, np.zeros_like(ones), False)})
        found = self._at(value, root, piece)
        if found is None:
            return value
        part = found.parts.get(0)
        center, radius = (np.zeros_like(ones),) * 2 if part is None else part[:2]
        down, up = np.min(center - radius, axis=0), np.max(center + radius, axis=0)
        parts = mapped(root.parts, lambda part: scaled(part, down, up))
        if any(part.full != value.parts[k].full for k, part in parts.items()):
            return value
        low, high = np.min(found.low, axis=0), np.max(found.high, axis=0)
        return sharper(value, Slope(low, high, parts, undefined=found.undefined))

    def _at(self, value: Slope, root: Slope, piece: Slope) -> Slope | None:
        """Return the value with `piece` in place of its root; None where a rule does not cover it."""
        memo: dict[int, Slope | None] = {root.source.key: piece}

        def visit(v: Any) -> Any:
            if not is_slope(v):
                return v
            source = v.source
            if source.key not in memo:
                operands = [visit(one) for one in source.operands]
                if any(one is None for one in operands):
                    return None
                memo[source.key] = self._operate(widened(source.eqn, piece.low.shape), operands)
            return memo[source.key]

        return visit(value)


def _is_same(a: Slope, b: Slope) -> bool:
    """Return whether two values are the same one in the same region: a branch of a selection is
    evaluated in a part of it."""
    if a is b:
        return True
    same = a.source.key == b.source.key
    return same and np.array_equal(a.low, b.low) and np.array_equal(a.high, b.high)


def widened(eqn: Any, shape: tuple[int, ...]) -> Any:
    """Return an elementwise operation on arrays of another shape, with one more axis in front."""
    aval = eqn.outvars[0].aval
    wide = SimpleNamespace(shape=shape, dtype=aval.dtype, ndim=len(shape))
    return SimpleNamespace(
        primitive=eqn.primitive,
        params=eqn.params,
        invars=eqn.invars,
        outvars=[SimpleNamespace(aval=wide)],
    )


def cuts(low: Values, high: Values) -> Values | None:
    """Return the ends of the pieces between two bounds, along a new first axis; None for too many.
    Entries without bounds are one piece, and others of length zero."""
    shares = np.concatenate([_SHARES, 1.0 - _SHARES, np.arange(_UNIFORM + 1) / _UNIFORM])
    if 2 * len(shares) * max(low.size, 1) > _MAX_NUMBERS:
        return None
    bounded = np.isfinite(low) & np.isfinite(high)
    left, right = np.where(bounded, low, 0.0), np.where(bounded, high, 0.0)
    length = right - left
    steps = shares.reshape(-1, *(1,) * low.ndim)
    near_zero = np.concatenate([-_SHARES, _SHARES]).reshape(-1, *(1,) * low.ndim)
    ends = np.concatenate([left + steps * length, near_zero * length], axis=0)
    ends = np.sort(np.clip(ends, left, right), axis=0)
    # What rounding leaves out at the ends belongs to the first and the last piece.
    ends[0], ends[-1] = low, high
    ends[1:-1] = np.where(bounded, ends[1:-1], low)
    return ends
