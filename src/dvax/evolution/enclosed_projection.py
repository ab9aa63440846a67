"""Enclosures of projections onto a set.

*Of a line, by its ends.* Let K be polyhedral, and let its bounds be lines. For lines y and v between a
point and a normal at either end, with their multipliers μ and slacks s (`dvax.sets._face`), and every k
in K at the same time,

    ⟨v(θ), k − y(θ)⟩ ≤ θ(1 − θ)g ≤ g/4,   g = Σ (μ₀ᵢs₁ᵢ + μ₁ᵢs₀ᵢ).

With the same active constraints at both ends g = 0. Otherwise g = O(h²) for ends at a distance O(h).
The projection need not have rules.

*By rules.* On one side of a kink the rules of enclosures apply. Over a kink proj_K(z(θ)) differs from
the line between its ends by at most 2θ(1 − θ)‖z₁ − z₀‖ if z is a line and K does not move, since proj_K
is nonexpansive.
"""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..problem import Problem
from ..programs.enclosure import LinearEnclosure, enclose, is_enclosure
from ..sets import AbstractSet
from ..sets._face import Face, iterates
from ..spaces import AbstractSpace
from .moving_set import Motion

_ROUNDINGS, _ITERATED, _ROWS = 256.0, 0.75, 4.0
"""Error of a projection relative to the size of z and y: in units of ε, or, where active sets are
iterated, in units of a power of ε."""


def by_its_rules(
    problem: Problem, args: Any, space: AbstractSpace, t: LinearEnclosure, z: Tree, moves: Motion
) -> Tree:
    """Return the enclosure of proj_{K(t)}(z) for enclosures of t and z.

    **Raises:** `NoEnclosure` if the projection uses an operation without a rule.
    """
    found = enclose(lambda t, z: problem.set_at(t, args).project(z, space), t, z)
    change = space.norm(part(jtu.tree_map(_change, z, is_leaf=is_enclosure), "dev"))
    deviation = space.norm(part(z, "dev"))
    most = 0.5 * (change + moves.change) + deviation + moves.deviation
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


def rounding_of(K: AbstractSet, space: AbstractSpace, *places: Any) -> jax.Array:
    """Return a bound on the errors of projections y of z onto K, at places with both."""
    sizes = [
        (space.norm(at.z) + space.norm(at.y)) * (1.0 if at.face is None else at.face.condition)
        for at in places
    ]
    size = jnp.max(jnp.stack([v.astype(_tree.dtype(places[0].z)) for v in sizes]))
    eps = float(jnp.finfo(size.dtype).eps)
    return (_ROWS * eps**_ITERATED if iterates(K) else _ROUNDINGS * eps) * size


def gap(faces: tuple[Face, Face], scales: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Return g for the normals of two faces, times these numbers."""
    (first, last), total = faces, jnp.zeros_like(scales[0])
    for scale, mu, slacks in (
        (scales[0], first.multipliers, last.slacks), (scales[1], last.multipliers, first.slacks),
    ):  # fmt: skip
        terms = jtu.tree_leaves(jtu.tree_map(_product, mu, slacks))
        total = total + scale * sum((jnp.sum(term) for term in terms), jnp.zeros_like(total))
    return total


def _product(mu: Any, slack: Any) -> jax.Array:
    """Return a multiplier times a slack, which may be infinite where the multiplier is 0, and negative
    by roundoff."""
    return jnp.where(mu > 0.0, mu * jnp.maximum(slack, 0.0), 0.0)
