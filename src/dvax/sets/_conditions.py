"""The linear conditions of a polyhedral set."""

from typing import NamedTuple

import jax.tree_util as jtu
import numpy as np
import scipy.linalg

from .._tree import Tree
from .abstract import AbstractSet
from .affine import AffineSubspace
from .constrained_box import ConstrainedBox
from .half_space import HalfSpace
from .hyperplane import Hyperplane
from .polyhedron import Polyhedron
from .product import Product
from .simplex import Simplex
from .translated import Translated


class Conditions(NamedTuple):
    """K = {y : low ≤ R y ≤ high} for the entries y of an element as one vector."""

    R: np.ndarray
    low: np.ndarray
    high: np.ndarray


def conditions(K: AbstractSet, like: Tree) -> Conditions | None:
    """Return the conditions of a set with concrete data, for elements shaped like `like`, or None for a
    set without a rule here."""
    if isinstance(K, Product):
        parts = [conditions(k, part) for k, part in zip(K.parts, like, strict=True)]
        known = [part for part in parts if part is not None]
        return _product(known) if len(known) == len(parts) else None
    if isinstance(K, Translated):
        inner = conditions(K.set, like)
        if inner is None:
            return None
        moved = inner.R @ _flat(K.offset, like)
        return Conditions(inner.R, inner.low + moved, inner.high + moved)
    size = sum(int(np.size(leaf)) for leaf in jtu.tree_leaves(like))
    bounds = K.intervals(like)
    if bounds is not None:
        return Conditions(np.eye(size), *(_flat(end, like) for end in bounds))
    if isinstance(K, ConstrainedBox):
        ends = (_flat(end, like) for end in (K.lower, K.upper))
        low, high = (np.asarray(end, float) for end in (K.low, K.high))
        return _joined(Conditions(np.eye(size), *ends), Conditions(_matrix(K.R, size), low, high))
    if isinstance(K, Polyhedron):
        return _joined(_below(K.G, K.d, size), _equal(K.E, K.e, size))
    if isinstance(K, AffineSubspace):
        return _equal(K.E, K.e, size)
    if isinstance(K, HalfSpace | Hyperplane):
        row = _flat(K.normal, like)[None]
        of = _below if isinstance(K, HalfSpace) else _equal
        return of(row, np.reshape(np.asarray(K.offset), 1), size)
    if isinstance(K, Simplex):
        positive = Conditions(np.eye(size), np.zeros(size), np.full(size, np.inf))
        number = _numbers(K, like)
        sums = (np.arange(number.max() + 1)[:, None] == number).astype(float)
        shape = np.shape(like)[:-1] if K.blocks is None else (len(sums),)
        total = np.broadcast_to(np.asarray(K.total, float), shape).reshape(-1)
        return _joined(positive, _equal(sums, total, size))
    return None


def _numbers(K: Simplex, like: Tree) -> np.ndarray:
    """Return the number of the simplex of each entry."""
    if K.blocks is None:
        return np.arange(np.size(like)) // np.shape(like)[-1]
    numbers = np.empty(np.size(like), int)
    for block in K.blocks:
        parts = (np.asarray(v).reshape(-1) for v in (block.start, block.size, block.number))
        for start, size, number in zip(*parts, strict=True):
            numbers[start : start + size] = number
    return numbers


def _flat(tree: Tree, like: Tree) -> np.ndarray:
    leaves = jtu.tree_map(
        lambda v, w: np.broadcast_to(np.asarray(v, float), np.shape(w)), tree, like
    )
    return np.concatenate([leaf.reshape(-1) for leaf in jtu.tree_leaves(leaves)])


def _matrix(rows: object, size: int) -> np.ndarray:
    return np.asarray(rows, float).reshape(-1, size)


def _below(rows: object, bounds: object, size: int) -> Conditions:
    high = np.asarray(bounds, float)
    return Conditions(_matrix(rows, size), np.full(len(high), -np.inf), high)


def _equal(rows: object, values: object, size: int) -> Conditions:
    both = np.asarray(values, float)
    return Conditions(_matrix(rows, size), both, both)


def _joined(*parts: Conditions) -> Conditions:
    return Conditions(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def _product(parts: list[Conditions]) -> Conditions:
    return Conditions(
        scipy.linalg.block_diag(*(part.R for part in parts)),
        np.concatenate([part.low for part in parts]),
        np.concatenate([part.high for part in parts]),
    )
