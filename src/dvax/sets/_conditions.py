"""The linear conditions low ≤ R y ≤ high of a polyhedral set, for the entries of y as one vector."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._small_matrices import times
from .._tree import Tree
from .abstract import AbstractSet
from .affine import AffineSubspace
from .constrained_box import ConstrainedBox
from .half_space import HalfSpace
from .hyperplane import Hyperplane
from .polyhedron import Polyhedron
from .product import Product
from .simplex import Simplex
from .translated import Translated, full_offset


class Limits(NamedTuple):
    """The limits of R y. `width`: high − low, which is 0 for an equation."""

    low: Any
    high: Any
    width: Any


def rows(K: AbstractSet, like: Tree) -> np.ndarray | None:
    """Return R of a set with concrete data, for elements shaped like `like`, or None for a set without
    a rule here."""
    if isinstance(K, Product):
        import scipy.linalg  # a slow import that only this function needs

        parts = [rows(k, leaf) for k, leaf in zip(K.parts, like, strict=True)]
        known = [part for part in parts if part is not None]
        return scipy.linalg.block_diag(*known) if len(known) == len(parts) else None
    if isinstance(K, Translated):
        return rows(K.set, like)
    size = _size(like)
    if K.intervals(like) is not None:
        return np.eye(size)
    if isinstance(K, Simplex):
        number = _numbers(K, like)
        sums = np.arange(number.max() + 1)[:, None] == number
        return np.concatenate([np.eye(size), sums.astype(float)])
    matrices = [np.asarray(data, float).reshape(-1, size) for data in row_data(K)]
    if isinstance(K, ConstrainedBox):
        matrices.insert(0, np.eye(size))
    return np.concatenate(matrices) if matrices else None


def row_data(K: AbstractSet) -> list[Any]:
    """Return the data of K on which its rows depend."""
    if isinstance(K, Product):
        return [data for part in K.parts for data in row_data(part)]
    if isinstance(K, Translated):
        return row_data(K.set)
    if isinstance(K, ConstrainedBox):
        return [K.R]
    if isinstance(K, Polyhedron):
        return [K.G, K.E]
    if isinstance(K, AffineSubspace):
        return [K.E]
    return [_flat(K.normal, K.normal)] if isinstance(K, HalfSpace | Hyperplane) else []


def limits(K: AbstractSet, R: Any, like: Tree) -> Limits:
    """Return the limits of a set with the rows R, which may move."""
    if isinstance(K, Product):
        found, row, column = [], 0, 0
        for part, leaf in zip(K.parts, like, strict=True):
            end = column + _size(leaf)
            found.append(limits(part, R[row:, column:end], leaf))
            row, column = row + len(found[-1].low), end
        return _joined(*found)
    if isinstance(K, Translated):
        inner = limits(K.set, R, like)
        moved = times(jnp.asarray(R[: len(inner.low)]), _flat(full_offset(K, like), like))
        return inner._replace(low=inner.low + moved, high=inner.high + moved)
    bounds = K.intervals(like)
    if bounds is not None:
        return _between(*(_flat(end, like) for end in bounds))
    if isinstance(K, ConstrainedBox):
        box = _between(*(_flat(end, like) for end in (K.lower, K.upper)))
        return _joined(box, _between(K.low, K.high))
    if isinstance(K, Polyhedron):
        return _joined(_below(K.d), _equal(K.e))
    if isinstance(K, AffineSubspace):
        return _equal(K.e)
    if isinstance(K, Simplex):
        positive = _between(jnp.zeros(_size(like)), jnp.full(_size(like), jnp.inf))
        of_each = np.shape(like)[:-1] if K.count is None else (K.count,)
        return _joined(positive, _equal(jnp.broadcast_to(K.total, of_each).reshape(-1)))
    assert isinstance(K, HalfSpace | Hyperplane)
    offset = jnp.reshape(K.offset, 1)
    return _below(offset) if isinstance(K, HalfSpace) else _equal(offset)


def _numbers(K: Simplex, like: Tree) -> np.ndarray:
    """Return for every entry the number of its simplex."""
    if K.blocks is None:
        return np.arange(np.size(like)) // np.shape(like)[-1]
    numbers = np.empty(np.size(like), int)
    for block in K.blocks:
        parts = (np.asarray(v).reshape(-1) for v in (block.start, block.size, block.number))
        for start, size, number in zip(*parts, strict=True):
            numbers[start : start + size] = number
    return numbers


def _size(like: Tree) -> int:
    return sum(int(np.size(leaf)) for leaf in jtu.tree_leaves(like))


def _flat(tree: Tree, like: Tree) -> jax.Array:
    leaves = jtu.tree_map(lambda v, w: jnp.broadcast_to(v, np.shape(w)), tree, like)
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jtu.tree_leaves(leaves)])


def _between(low: Any, high: Any) -> Limits:
    return Limits(low, high, high - low)


def _below(high: Any) -> Limits:
    return Limits(jnp.full_like(high, -jnp.inf), high, jnp.full_like(high, jnp.inf))


def _equal(values: Any) -> Limits:
    return Limits(values, values, jnp.zeros_like(values))


def _joined(*parts: Limits) -> Limits:
    return Limits(*(jnp.concatenate(fields) for fields in zip(*parts, strict=True)))
