"""How far the projection onto a set changes with the data of the set, by its kind.

The bounds hold for every z. The rules are derived in docs/theory/proofs.md.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from ..spaces import Product as ProductSpace
from ._library import is_of_library, sets_in
from ._weights import flat_roots, full_weights
from .abstract import AbstractSet
from .affine import AffineSubspace, normalised_conditions
from .ball import Ball
from .constrained_box import ConstrainedBox
from .ellipsoid import Ellipsoid
from .half_space import HalfSpace
from .hyperplane import Hyperplane
from .intersection import Intersection
from .l1_ball import L1Ball
from .polyhedron import Polyhedron
from .product import Product
from .simplex import Simplex
from .translated import Translated, full_offset

_MAX_ROWS = 64
"""Largest number of rows of a constrained box whose speed is bounded."""


class Entries(NamedTuple):
    """‖gain v‖, where vᵢ is the largest speed of entry i of the `arrays`. The gain is a vector, entry
    by entry, or a matrix."""

    arrays: tuple[Any, ...]
    gain: Any


class Sum(NamedTuple):
    """The sum of the speeds of the parts."""

    parts: tuple[Any, ...]


class Independent(NamedTuple):
    """The root of the sum of the squares of the speeds of the parts."""

    parts: tuple[Any, ...]


class Fixed(NamedTuple):
    """Data that must not depend on t: the speed is 0, or unknown."""

    arrays: tuple[Any, ...]


class Unbounded(NamedTuple):
    """Bounds of conditions whose rows share unknowns: the speed is 0 if they do not depend on t, or
    unknown. The set is the same for every θ if they are lines between their values at two times."""

    arrays: tuple[Any, ...]


class Description(NamedTuple):
    """K(t) as arrays: bounds `low` ≤ y ≤ `high` of its elements, entry by entry; the `motion` of the
    projection; and `gaps` that are ≥ 0 if and only if K(t) is not empty, if its `Fixed` data are."""

    low: Tree
    high: Tree
    motion: Any
    gaps: list[Any]


def describe(
    K: AbstractSet, pattern: AbstractSet | None, like: Tree, space: AbstractSpace
) -> Description | None:
    """Return a description of K(t), or None for a set without a rule here.

    `pattern` is this set at one time with concrete data, whose zeros and sizes select the rule; None
    if there are no concrete data.
    """
    bounds = K.intervals(like)
    if bounds is not None:
        low, high = bounds
        arrays = tuple(map(_flat, (low, high)))
        gaps = jtu.tree_leaves(jtu.tree_map(jnp.subtract, high, low))
        return Description(low, high, Entries(arrays, flat_roots(space, like)), gaps)
    if isinstance(K, Product):
        return _product(K, pattern, like, space)
    if isinstance(K, Translated):
        inner = describe(K.set, getattr(pattern, "set", None), like, space)
        if inner is None:
            return None
        offset = full_offset(K, like)
        motion = Sum((inner.motion, _element(offset, space, like)))
        return inner._replace(
            low=_tree.add(inner.low, offset), high=_tree.add(inner.high, offset), motion=motion
        )
    if isinstance(K, HalfSpace | Hyperplane):
        return _half_space(K, like, space)
    if not isinstance(like, tuple):
        if isinstance(K, Ball):
            reach = K.radius / jnp.sqrt(jnp.broadcast_to(space.weights(), like.shape))
            return _round(K.center, reach, _number(K.radius), K.radius, space, like)
        if isinstance(K, L1Ball):
            number = _number(_heaviest(space) * K.radius)
            return _round(K.center, K.radius, number, K.radius, space, like)
        if isinstance(K, Ellipsoid):
            data = K.radii if K.shape is None else K.shape
            assert data is not None
            reach = data if K.shape is None else jnp.sqrt(jnp.diagonal(data))
            return _round(K.center, reach, Fixed((data,)), None, space, like)
        if isinstance(K, Simplex):
            return _simplex(K, pattern, like, space)
        if isinstance(K, ConstrainedBox):
            return _constrained_box(K, pattern, like, space)
    if isinstance(K, AffineSubspace):
        return _affine_subspace(K, pattern, like, space)
    if isinstance(K, Polyhedron):
        rows = Fixed((jnp.ravel(K.G), jnp.ravel(K.E)))
        return Description(*_no_bounds(like), Sum((rows, Unbounded((K.d, K.e)))), [])
    return _unmoved(K, like)


def rejects_empty(K: AbstractSet) -> bool:
    """Return whether the constructor of this set raises an error for an empty set."""
    return is_of_library(K) and not any(isinstance(part, Intersection) for part in sets_in(K))


def _product(
    K: Product, pattern: AbstractSet | None, like: Tree, space: AbstractSpace
) -> Description | None:
    spaces = space.spaces if isinstance(space, ProductSpace) else (space,) * len(K.parts)
    patterns = pattern.parts if isinstance(pattern, Product) else (None,) * len(K.parts)
    given = zip(K.parts, patterns, like, spaces, strict=True)
    found = [describe(part, now, leaf, space) for part, now, leaf, space in given]
    parts = [part for part in found if part is not None]
    if len(parts) < len(found):
        return None
    motion = Independent(tuple(part.motion for part in parts))
    gaps = [gap for part in parts for gap in part.gaps]
    low, high = tuple(part.low for part in parts), tuple(part.high for part in parts)
    return Description(low, high, motion, gaps)


def _round(
    center: Any, reach: Any, of_size: Any, gap: Any, space: AbstractSpace, like: jax.Array
) -> Description:
    """Return the description of center + {y : |yᵢ| ≤ reach and others}."""
    center = jnp.broadcast_to(center, like.shape)
    motion = Sum((_element(center, space, like), of_size))
    gaps = [] if gap is None else [gap]
    return Description(center - reach, center + reach, motion, gaps)


def _half_space(K: HalfSpace | Hyperplane, like: Tree, space: AbstractSpace) -> Description:
    """A plane at distance b/(Σ aᵢ²/wᵢ)^{1/2} from 0."""
    normal, weights = _flat(K.normal), _flat(full_weights(space, like))
    largest = jnp.max(jnp.abs(normal))  # the square of a very small normal would underflow
    length = largest * jnp.sqrt(jnp.sum((normal / largest) ** 2 / weights))
    motion = Sum((Fixed((normal,)), _number(K.offset / length)))
    return Description(*_no_bounds(like), motion, [])


def _simplex(
    K: Simplex, pattern: AbstractSet | None, like: jax.Array, space: AbstractSpace
) -> Description:
    """An entry rises at most by the share of the change of its total that its weight allows."""
    if K.count is None:
        totals = jnp.broadcast_to(K.total, like.shape[:-1])  # one for each simplex that shares it
        total = jnp.broadcast_to(K.total[..., None], like.shape)
    else:
        totals = jnp.broadcast_to(K.total, (K.count,))
        total = jnp.broadcast_to(jnp.max(totals), like.shape)
        if isinstance(pattern, Simplex) and pattern.blocks is not None:
            numbers = np.concatenate([np.asarray(b.number).reshape(-1) for b in pattern.blocks])
            total = totals[numbers[np.asarray(pattern.position)]]
    motion = _number(_heaviest(space) * totals)
    return Description(jnp.zeros_like(total), total, motion, [K.total])


def _constrained_box(
    K: ConstrainedBox, pattern: AbstractSet | None, like: jax.Array, space: AbstractSpace
) -> Description:
    """Rows without a common unknown act on parts of their own."""
    lower, upper = (jnp.broadcast_to(v, like.shape) for v in (K.lower, K.upper))
    R = np.asarray(pattern.R) if isinstance(pattern, ConstrainedBox) else None
    if len(K.R) > 1 and (R is None or not _are_apart(R)):
        bounds = Unbounded(tuple(map(jnp.ravel, (K.lower, K.upper, K.low, K.high))))
        return Description(lower, upper, Sum((Fixed((jnp.ravel(K.R),)), bounds)), [])
    box = Entries((lower, upper), flat_roots(space, like))
    # With the free unknowns of a row, at least one of them, it moves by its change over their length.
    size = jnp.abs(K.R if R is None else jnp.asarray(R))
    shares = size / flat_roots(space, like)[None]
    lengths = jnp.min(jnp.where(size > 0.0, shares, jnp.inf), axis=1)
    rows = Sum((Entries((K.low, K.high), 1.0 / lengths),
                Entries((lower, upper), size / lengths[:, None])))  # fmt: skip
    least, greatest = [], []
    for row in () if R is None else R:
        (at,) = np.nonzero(row)
        of_sign = row[at] > 0
        ends = (jnp.where(of_sign, upper[at], lower[at]), jnp.where(of_sign, lower[at], upper[at]))
        greatest.append(jnp.sum(row[at] * ends[0]))
        least.append(jnp.sum(row[at] * ends[1]))
    gaps = [upper - lower, K.high - K.low]
    if least:
        gaps += [K.high - jnp.stack(least), jnp.stack(greatest) - K.low]
    motion = Sum((Fixed((jnp.ravel(K.R),)), Independent((box, rows))))
    return Description(lower, upper, motion, gaps)


def _are_apart(R: np.ndarray) -> bool:
    """Return whether every row has unknowns of its own."""
    used = R != 0
    few = len(R) <= _MAX_ROWS and used.sum(axis=0).max(initial=0) <= 1
    return bool(few and used.any(axis=1).all())


def _affine_subspace(
    K: AffineSubspace, pattern: AbstractSet | None, like: Tree, space: AbstractSpace
) -> Description:
    """The projection moves by the shortest element that changes the equations as e does."""
    if not isinstance(pattern, AffineSubspace):
        rows, values = normalised_conditions(K.E, K.e)
        back = jnp.linalg.pinv(rows / flat_roots(space, like)[None])
        of_values: Any = Entries((values,), jnp.abs(back))
    else:
        E, e = pattern.E, K.e
        with jax.ensure_compile_time_eval():
            scaled = np.asarray(E, float).reshape(len(E), -1) / np.asarray(flat_roots(space, like))
        # No element may change equations that depend on each other.
        is_independent = np.linalg.matrix_rank(scaled) == len(scaled)
        back = np.abs(np.linalg.pinv(scaled))
        of_values = Entries((e,), jnp.asarray(back)) if is_independent else Unbounded((e,))
    motion = Sum((Fixed((jnp.ravel(K.E),)), of_values))
    return Description(*_no_bounds(like), motion, [])


def _unmoved(K: AbstractSet, like: Tree) -> Description | None:
    """Return the description of a set that is not empty and must not move, or None."""
    leaves = jtu.tree_leaves(K)
    # A function in a set may use t, which its code does not show.
    if not (rejects_empty(K) and all(map(eqx.is_array_like, leaves))):
        return None
    arrays = tuple(jnp.ravel(jnp.asarray(leaf, float)) for leaf in leaves)
    return Description(*_no_bounds(like), Fixed(arrays), [])


def _element(value: Tree, space: AbstractSpace, like: Tree) -> Entries:
    """Return the motion by an element, in the norm of the space."""
    return Entries((_flat(value),), flat_roots(space, like))


def _number(value: Any) -> Entries:
    """Return the motion by a number or by an array of numbers, in the Euclidean norm."""
    flat = jnp.ravel(value)
    return Entries((flat,), jnp.ones_like(flat))


def _heaviest(space: AbstractSpace) -> jax.Array:
    return jnp.sqrt(jnp.max(space.weights()))


def _flat(tree: Tree) -> jax.Array:
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jtu.tree_leaves(tree)])


def _no_bounds(like: Tree) -> tuple[Tree, Tree]:
    low = jtu.tree_map(lambda leaf: jnp.full(leaf.shape, -jnp.inf), like)
    return low, jtu.tree_map(jnp.negative, low)
