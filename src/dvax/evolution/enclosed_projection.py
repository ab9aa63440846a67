"""Enclosures of projections onto a set that does not move.

*Of a line, by its ends.* Let yₖ = proj_K(zₖ) for k = 0, 1, and vₖ ∈ N_K(yₖ), say zₖ − yₖ. For lines y
and v between their values at the ends, and every k ∈ K,

    ⟨v(θ), k − y(θ)⟩ ≤ θ(1 − θ)g ≤ g/4,   g = ⟨v₁ − v₀, y₁ − y₀⟩ ≥ 0.

For a polyhedral K with the same active constraints at both ends, g = 0. Otherwise g = O(h²) for ends at
a distance O(h). The projection need not have rules.

*By rules.* On one side of a kink the rules of enclosures apply. Over a kink proj_K(z(θ)) differs from
the line between its ends by at most 2θ(1 − θ)‖z₁ − z₀‖ if z is a line, since proj_K is nonexpansive.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..programs.enclosure import LinearEnclosure, enclose, is_enclosure
from ..sets import (
    AbstractSet,
    Ball,
    ConstrainedBox,
    Ellipsoid,
    Intersection,
    Polyhedron,
    SecondOrderCone,
)
from ..sets._library import is_of_library, sets_in
from ..spaces import AbstractSpace

_NOT_POLYHEDRAL = (Ball, Ellipsoid, SecondOrderCone, Intersection)

_ROUNDINGS, _ITERATED = 256.0, 0.75
"""Error of a projection relative to the size of z and y: in units of ε, or as a power of ε where active
sets are iterated."""


class Gap(NamedTuple):
    """A bound on g, and its value as computed, 0 where it is roundoff."""

    bound: jax.Array
    resolved: jax.Array


def is_polyhedral(K: AbstractSet) -> bool:
    """Return whether K is known to be a polyhedral set with an exact projection."""
    return is_of_library(K) and not any(isinstance(s, _NOT_POLYHEDRAL) for s in sets_in(K))


def by_its_rules(K: AbstractSet, space: AbstractSpace, z: Tree) -> Tree:
    """Return the enclosure of proj_K(z) for an enclosure of z.

    **Raises:** `NoEnclosure` if the projection uses an operation without a rule.
    """
    found = enclose(lambda z: K.project(z, space), z)
    change = part(jtu.tree_map(_change, z, is_leaf=is_enclosure), "dev")
    most = 0.5 * space.norm(change) + space.norm(part(z, "dev"))
    return widened(found, most, space, jnp.minimum)


def widened(enclosures: Tree, by: Any, space: AbstractSpace, join: Any = jnp.add) -> Tree:
    """Return enclosures with their deviations joined to the largest entry of elements of norm `by`."""

    def one(q: LinearEnclosure, w: jax.Array) -> LinearEnclosure:
        largest = (by / jnp.sqrt(w)).astype(q.dev.dtype)
        return q._replace(dev=jnp.broadcast_to(join(q.dev, largest), q.a.shape))

    return jtu.tree_map(one, enclosures, space.weights(), is_leaf=is_enclosure)


def part(enclosures: Tree, name: str) -> Tree:
    """Return the starts "a", the ends "b" or the deviations "dev"."""
    return jtu.tree_map(lambda q: getattr(q, name), enclosures, is_leaf=is_enclosure)


def _change(q: LinearEnclosure) -> LinearEnclosure:
    return q._replace(dev=jnp.abs(q.b - q.a))


def rounding_of(K: AbstractSet, space: AbstractSpace, *pairs: tuple[Tree, Tree]) -> jax.Array:
    """Return a bound on the errors of projections y of z onto K, for pairs of both."""
    size = jnp.max(jnp.stack([space.norm(z) + space.norm(y) for z, y in pairs]))
    is_iterated = any(isinstance(s, Polyhedron | ConstrainedBox) for s in sets_in(K))
    eps = float(jnp.finfo(size.dtype).eps)
    return (eps**_ITERATED if is_iterated else _ROUNDINGS * eps) * size


def gap(
    space: AbstractSpace, y: tuple[Tree, Tree], v: tuple[Tree, Tree],
    switches: tuple[list[jax.Array] | None, list[jax.Array] | None], stretch: Any, rounding: Any,
) -> Gap:  # fmt: skip
    """Return g for v = σ(z − y) with σ up to `stretch`, and y up to `rounding`; 0 for the same active
    constraints, at which no switch function changes its sign."""
    of_y, of_v = _tree.sub(y[1], y[0]), _tree.sub(v[1], v[0])
    doubt = 2.0 * rounding * (space.norm(of_v) + stretch * (space.norm(of_y) + 2.0 * rounding))
    g = jnp.maximum(space.inner(of_v, of_y), 0.0)
    first, last = switches
    if first is None or last is None:
        return Gap(g + doubt, g)
    same = g <= doubt
    for a, b in zip(first, last, strict=True):
        positive, negative = (a > rounding) & (b > rounding), (a < -rounding) & (b < -rounding)
        # An equation has a constant.
        same &= jnp.all(positive | negative | ((a == b) & (a != 0)))
    return Gap(jnp.where(same, 0.0, g + doubt), jnp.where(g <= doubt, 0.0, g))


def gap_of_box(
    space: AbstractSpace, y: tuple[Tree, Tree], v: tuple[Tree, Tree], bounds: tuple[Tree, Tree]
) -> jax.Array:
    """Return g for a box whose bounds are lines l and b: with s⁺ = max(s, 0) and s⁻ = max(−s, 0)

    g = ⟨v₀⁺, b₁ − y₁⟩ + ⟨v₁⁺, b₀ − y₀⟩ + ⟨v₀⁻, y₁ − l₁⟩ + ⟨v₁⁻, y₀ − l₀⟩."""

    def of_leaf(y0: Any, y1: Any, v0: Any, v1: Any, low: Any, up: Any) -> jax.Array:
        return (
            _product(v0, up.b - y1) + _product(v1, up.a - y0)
            + _product(-v0, y1 - low.b) + _product(-v1, y0 - low.a)
        )  # fmt: skip

    terms = jtu.tree_map(of_leaf, *y, *v, *bounds)
    return space.inner(terms, jtu.tree_map(jnp.ones_like, terms))


def _product(v: jax.Array, slack: jax.Array) -> jax.Array:
    """Return v⁺ times a slack, which may be infinite where v⁺ = 0."""
    return jnp.where(v > 0.0, v * slack, 0.0)
