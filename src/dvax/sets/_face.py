"""Projections onto polyhedral sets with the normals there, in terms of the conditions of the set.

Let K = {y : ⟨aᵢ, y⟩ ≤ bᵢ}, where some may be equations. With y = proj_K(z) there are multipliers μᵢ ≥ 0
and v = Σ μᵢaᵢ ∈ N_K(y), which is z − y. Let sᵢ = bᵢ − ⟨aᵢ, y⟩ ≥ 0 be the slacks of a point y of K, or
of a set with the same aᵢ and other bounds. For every k in this set ⟨v, k − y⟩ ≤ Σ μᵢsᵢ.

The multiplier of a condition that is not active is 0, and so is the slack of one that is.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from ..spaces import Product as ProductSpace
from ._library import is_of_library, sets_in
from ._weights import inverse_weights
from .abstract import AbstractSet
from .affine import AffineSubspace
from .ball import Ball
from .constrained_box import ConstrainedBox, bounds_and_rows
from .ellipsoid import Ellipsoid
from .half_space import HalfSpace
from .hyperplane import Hyperplane, excess, subtract_along_normal
from .intersection import Intersection
from .l1_ball import L1Ball
from .polyhedron import Polyhedron, rows_at
from .product import Product
from .scaled import Scaled
from .second_order_cone import SecondOrderCone
from .simplex import Simplex
from .translated import Translated, full_offset


class Face(NamedTuple):
    """A projection y, the normal v there, and the multipliers and slacks of the conditions.

    `condition`: at least the factor by which roundoff in active rows moves y, as far as it is known."""

    y: Tree
    v: Tree
    multipliers: tuple[Tree, ...]
    slacks: tuple[Tree, ...]
    condition: Any = 1.0


def is_polyhedral(K: AbstractSet) -> bool:
    """Return whether `face` has a rule for a set that is no box."""
    others = Ball, Ellipsoid, Intersection, SecondOrderCone
    return is_of_library(K) and not any(isinstance(part, others) for part in sets_in(K))


def iterates(K: AbstractSet) -> bool:
    """Return whether a projection onto K iterates active rows, at least in one part."""
    return any(isinstance(part, Polyhedron | ConstrainedBox) for part in sets_in(K))


def face(K: AbstractSet, z: Tree, space: AbstractSpace) -> Face | None:
    """Return the face of K at the projection of z, or None for a set without a rule here."""
    bounds = K.intervals(z)
    if bounds is not None:
        return _box(z, *bounds, space)
    if not is_polyhedral(K):
        return None
    if isinstance(K, Product):
        spaces = space.spaces if isinstance(space, ProductSpace) else (space,) * len(K.parts)
        found = [face(k, leaf, s) for k, leaf, s in zip(K.parts, z, spaces, strict=True)]
        parts = [part for part in found if part is not None]
        ys, vs, multipliers, slacks, conditions = zip(*parts, strict=True)
        largest = jnp.max(jnp.stack([jnp.asarray(c, jnp.result_type(float)) for c in conditions]))
        return Face(ys, vs, sum(multipliers, ()), sum(slacks, ()), largest)
    if isinstance(K, Translated):
        offset = full_offset(K, z)
        inner = face(K.set, _tree.sub(z, offset), space)
        return None if inner is None else inner._replace(y=_tree.add(inner.y, offset))
    if isinstance(K, Scaled):
        inner = face(K.set, _tree.scale(1.0 / K.factor, z), space)
        if inner is None:
            return None
        y, v = (_tree.scale(K.factor, part) for part in inner[:2])
        size = jnp.abs(K.factor)
        multipliers, slacks = (tuple(_tree.scale(size, a) for a in part) for part in inner[2:4])
        return Face(y, v, multipliers, slacks, inner.condition)
    if isinstance(K, Hyperplane | AffineSubspace):
        y = K.project(z, space)
        return Face(y, _tree.sub(z, y), (), ())  # equations have no slacks
    if isinstance(K, HalfSpace):
        return _half_space(K, z, space)
    if isinstance(K, Polyhedron):
        y, is_active, multiplier, slack, condition = rows_at(K, z, space)
        multiplier = jnp.where(is_active, multiplier, 0.0)
        slack = jnp.where(is_active, 0.0, jnp.maximum(slack, 0.0))
        return Face(y, z - y, (multiplier,), (slack,), condition)
    if isinstance(K, ConstrainedBox):
        return Face(*bounds_and_rows(K, z, space))
    if isinstance(K, Simplex):
        return _simplex(K, z, space)
    return _l1_ball(K, z, space) if isinstance(K, L1Ball) else None


def _box(z: Tree, low: Tree, up: Tree, space: AbstractSpace) -> Face:
    y = jtu.tree_map(jnp.clip, z, low, up)
    v, weights = _tree.sub(z, y), _weights(space, z)
    multipliers = tuple(
        jtu.tree_map(lambda w, a, sign=sign: w * jnp.maximum(sign * a, 0.0), weights, v)
        for sign in (1.0, -1.0)
    )
    return Face(y, v, multipliers, (_tree.sub(up, y), _tree.sub(y, low)))


def _half_space(K: HalfSpace, z: Tree, space: AbstractSpace) -> Face:
    """The multiplier and the slack are the distances of z and of y from the plane."""
    y = K.project(z, space)
    v = _tree.sub(z, y)
    above = excess(K.normal, K.offset, y)
    slack = space.norm(_tree.sub(y, subtract_along_normal(y, above, K.normal, space)))
    is_active = excess(K.normal, K.offset, z) >= 0.0
    return Face(y, v, (space.norm(v),), (jnp.where(is_active, 0.0, slack),))


def _simplex(K: Simplex, z: jax.Array, space: AbstractSpace) -> Face:
    """With the multiplier λ of the sum, ⟨v, k − y⟩ ≤ Σ (λ − wᵢvᵢ)yᵢ."""
    weights, y = _weights(space, z), K.project(z, space)
    (distance,) = K.switches(z, space)
    level = weights * (z - distance)
    lack = jnp.where(y > 0.0, 0.0, jnp.maximum(-weights * distance, 0.0))
    return Face(y, (level - lack) / weights, (lack,), (y,))


def _l1_ball(K: L1Ball, z: jax.Array, space: AbstractSpace) -> Face:
    """With d = y − c and the multiplier λ of the radius,

    ⟨v, k − y⟩ ≤ λ(r − Σ|dᵢ|) + Σ (λ − wᵢvᵢ)dᵢ⁺ + Σ (λ + wᵢvᵢ)dᵢ⁻."""
    weights, y = _weights(space, z), K.project(z, space)
    d = y - K.center
    room, distance = K.switches(z, space)
    level = jnp.where(room > 0.0, 0.0, weights * (jnp.abs(z - K.center) - distance))
    level = jnp.maximum(level, 0.0)
    force = jnp.where(d == 0.0, jnp.clip(weights * (z - y), -level, level), jnp.sign(d) * level)
    slack = jnp.where(room > 0.0, jnp.maximum(K.radius - jnp.sum(jnp.abs(d)), 0.0), 0.0)
    slacks = slack, jnp.maximum(d, 0.0), jnp.maximum(-d, 0.0)
    return Face(y, force / weights, (jnp.max(level), level - force, level + force), slacks)


def _weights(space: AbstractSpace, like: Tree) -> Tree:
    """Return w, shaped like an element and of its type."""
    return jtu.tree_map(jnp.reciprocal, inverse_weights(space, like))
