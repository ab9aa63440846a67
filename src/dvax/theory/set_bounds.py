"""Boxes around sets that are given by linear conditions."""

import numpy as np

from .._tree import Tree
from ..programs.slope import Values
from ..sets import AbstractSet, ConstrainedBox, L1Ball, Polyhedron

_PASSES = 4
_ROUNDOFF = 4 * np.finfo(float).eps
"""Relative enlargement of a bound for each term of the sums in it, more than their roundoff."""


def bounds_of_fixed_set(K: AbstractSet, like: Tree) -> tuple[Values, Values] | None:
    """Return (low, high) with low ≤ y ≤ high for y ∈ K, or None for a set without a rule here.

    The data of K are concrete, and `like` is an array of the shape of y.
    """
    shape = np.shape(like)
    if isinstance(K, L1Ball):
        center, radius = np.asarray(K.center), np.asarray(K.radius)
        ends = np.broadcast_to(center - radius, shape), np.broadcast_to(center + radius, shape)
        return _enlarged(*ends, np.abs(center) + radius)
    if isinstance(K, ConstrainedBox):
        lower, upper = (np.broadcast_to(np.asarray(v), shape) for v in (K.lower, K.upper))
        rows, low, high = K.R, K.low, K.high
    elif isinstance(K, Polyhedron):
        lower, upper = np.full(shape, -np.inf), np.full(shape, np.inf)
        rows = np.concatenate([np.asarray(K.G), np.asarray(K.E)])
        low = np.concatenate([np.full(len(K.d), -np.inf), np.asarray(K.e)])
        high = np.concatenate([np.asarray(K.d), np.asarray(K.e)])
    else:
        return None
    matrix = np.asarray(rows, float).reshape(len(low), -1)
    ends = propagate(
        lower.reshape(-1), upper.reshape(-1), matrix, np.asarray(low), np.asarray(high)
    )
    return ends[0].reshape(shape), ends[1].reshape(shape)


def propagate(
    lower: Values, upper: Values, rows: Values, low: Values, high: Values
) -> tuple[Values, Values]:
    """Return bounds of {lower ≤ y ≤ upper, low ≤ rows y ≤ high} that are at least as sharp as
    (lower, upper), by interval propagation: rₖᵢ yᵢ ≤ highₖ − min Σ_{j≠i} rₖⱼ yⱼ, and so for low."""
    roundoff = _ROUNDOFF * (rows.shape[1] + 4)
    for _ in range(_PASSES):
        before = lower, upper
        for sign, bound in ((1.0, high), (-1.0, -low)):
            # The condition is A y ≤ bound.
            A = sign * rows
            with np.errstate(invalid="ignore", divide="ignore"):
                least = np.where(A > 0, A * lower, np.where(A < 0, A * upper, 0.0))
                finite = np.where(np.isfinite(least), least, 0.0)
                unbounded = least == -np.inf
                others = unbounded.sum(axis=1, keepdims=True) - unbounded
                rest = bound[:, None] - (finite.sum(axis=1, keepdims=True) - finite)
                size = np.abs(bound)[:, None] + np.abs(finite).sum(axis=1, keepdims=True)
                rest = np.where(others > 0, np.inf, rest + roundoff * size)
                limit = rest / A
            upper = np.minimum(upper, np.where(A > 0, limit, np.inf).min(axis=0, initial=np.inf))
            lower = np.maximum(lower, np.where(A < 0, limit, -np.inf).max(axis=0, initial=-np.inf))
        if np.array_equal(before[0], lower) and np.array_equal(before[1], upper):
            break
    return lower, upper


def _enlarged(low: Values, high: Values, size: Values) -> tuple[Values, Values]:
    return low - _ROUNDOFF * size, high + _ROUNDOFF * size
