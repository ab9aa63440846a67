"""How far the response over a step is from a line between its values at both ends.

Let F(y) = P⁻¹y − h(t, x, P⁻¹y), and let y* solve the law at the t and x of a time θ in the step. Let y
be the line between its values at the ends, and u = P⁻¹y. Since F is strongly pseudomonotone,
⟨F(y*), y − y*⟩ ≥ 0 implies γ‖y − y*‖² ≤ ⟨F(y), y − y*⟩. The law's solver is not enclosed.

*Polyhedral sets.* With normals v at the ends, an enclosure of h along u proves ‖F(y(θ)) + v(θ)‖ ≤ r for
the line v, and with g of `enclosed_projection`

    γ‖y − y*‖² ≤ r‖y − y*‖ + g/4,   so that γ‖y − y*‖ ≤ ρ = ½(r + √(r² + γg)).

If the bounds of a box are lines up to d, each yᵢ moves by at most dᵢ with the bound to which vᵢ is
normal: g stays the same, and F changes by at most L_F‖d‖.

*Other sets.* The natural residual R = y − proj_K(y − F(y)/L_F) is enclosed, and
γ‖y − y*‖ ≤ ρ = (γ + 2L_F)‖R‖ (`docs/theory/proofs.md`, C1).

For smooth data ρ = O(h²), and ρ = O(h) in a step in which active constraints change.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..operators import AbstractOperator
from ..problem import Problem
from ..programs.enclosure import LinearEnclosure, enclose, is_enclosure, straight
from ..sets import AbstractSet
from ..spaces import AbstractSpace
from .enclosed_projection import (
    Gap,
    by_its_rules,
    gap,
    gap_of_box,
    is_polyhedral,
    part,
    rounding_of,
)

_ROUNDINGS = 8.0
"""Relative roundoff of the terms of F, in units of ε."""


class Place(NamedTuple):
    """An end of a step: z, its projection y onto K, and the switch functions of K at z where they are
    known."""

    z: Tree
    y: Tree
    switches: list[jax.Array] | None


class InterpolatedResponse(NamedTuple):
    """The line between the responses at both ends of a step.

    - `u`: the line, as enclosures without a deviation;
    - `residual`: ρ of the file's docstring, at all times of the step; ‖y − y*‖ ≤ ρ/γ;
    - `resolved`: ρ without roundoff, which does not decrease with the step."""

    u: Tree
    residual: jax.Array
    resolved: jax.Array


def interpolated(
    problem: Problem, args: Any, P: AbstractOperator, t: LinearEnclosure, x: Tree,
    places: tuple[Place, Place], gamma: Any, L_F: Any,
) -> InterpolatedResponse:  # fmt: skip
    """Return the line between the responses at two places, for enclosures of t and x.

    **Raises:** `NoEnclosure` where h, the bounds of a box, or the projection onto a set that is not
    polyhedral use an operation without a rule.
    """
    start = part(x, "a")
    space, like = problem.spaces(start)[1], problem.zero_control(start)
    K = problem.set_at(t.a, args)
    bounds, moved = None, jnp.zeros((), _tree.dtype(like))
    if K.intervals(like) is not None:
        bounds = enclose(lambda t: problem.set_at(t, args).intervals(like), t)
        places = _clipped(places[0], bounds, "a"), _clipped(places[1], bounds, "b")
        moved = space.norm(_full(jtu.tree_map(_larger, *bounds, is_leaf=is_enclosure), like))
    y = places[0].y, places[1].y
    u = straight(*map(P.inverse, y))
    law = lambda t, x, u: _tree.sub(u, problem.h(t, x, u, args))  # noqa: E731
    F = enclose(law, t, x, u)
    terms = [2.0 * space.norm(part(u, end)) + space.norm(part(F, end)) for end in ("a", "b")]
    roundoff = _ROUNDINGS * jnp.finfo(terms[0].dtype).eps * jnp.maximum(*terms)  # of F
    if bounds is None and not is_polyhedral(K):
        stepped = enclose(lambda y, F: _step(y, F, L_F), straight(*y), F)
        R = enclose(_tree.sub, straight(*y), by_its_rules(K, space, stepped))
        largest = space.norm(jtu.tree_map(lambda q: q.largest, R, is_leaf=is_enclosure))
        scale = gamma + 2.0 * L_F
        return InterpolatedResponse(u, scale * (largest + roundoff / L_F), scale * largest)
    normals = [
        _normal(space, value, place)
        for value, place in zip((part(F, "a"), part(F, "b")), places, strict=True)
    ]
    v, stretch = (normals[0][0], normals[1][0]), jnp.maximum(normals[0][1], normals[1][1])
    if bounds is None:
        rounding = rounding_of(K, space, *(place[:2] for place in places))
        switches = places[0].switches, places[1].switches
        g = gap(space, y, v, switches, stretch, rounding)
    else:
        of_box = gap_of_box(space, y, v, bounds)
        g, rounding = Gap(of_box, of_box), jnp.zeros_like(moved)
    ends = [space.norm(_tree.add(part(F, end), w)) for end, w in zip(("a", "b"), v, strict=True)]
    r = jnp.maximum(*ends) + space.norm(part(F, "dev")) + L_F * moved
    rho, resolved = (
        0.5 * (r + more + jnp.sqrt(jnp.square(r + more) + gamma * gap)) + gamma * moved
        for more, gap in (((L_F + stretch) * rounding + roundoff, g.bound), (0.0, g.resolved))
    )
    return InterpolatedResponse(u, rho + gamma * rounding, resolved)


def interpolated_projection(
    K: AbstractSet, space: AbstractSpace, z: Tree, places: tuple[Place, Place]
) -> tuple[Tree, jax.Array]:
    """Return the line between the projections onto a polyhedral set at two places, as enclosures, and
    a bound on the distance of the projection from it, for an enclosure of z.

    This is the law of F(y) = y − z."""
    y = places[0].y, places[1].y
    v = _tree.sub(places[0].z, y[0]), _tree.sub(places[1].z, y[1])
    rounding = rounding_of(K, space, *(place[:2] for place in places))
    g = gap(space, y, v, (places[0].switches, places[1].switches), 1.0, rounding)
    ends = [
        space.norm(_tree.sub(part(z, end), place.z))
        for end, place in zip(("a", "b"), places, strict=True)
    ]
    r = jnp.maximum(*ends) + space.norm(part(z, "dev")) + 2.0 * rounding
    return straight(*y), 0.5 * (r + jnp.sqrt(jnp.square(r) + g.bound)) + rounding


def _step(y: Tree, F: Tree, L_F: Any) -> Tree:
    return jtu.tree_map(lambda a, b: a - b / L_F, y, F)


def _larger(low: LinearEnclosure, up: LinearEnclosure) -> jax.Array:
    """Return the larger deviation of two bounds; a bound that is infinite all the time has none."""
    never = [(q.a == q.b) & jnp.isinf(q.a) for q in (low, up)]
    low_dev, up_dev = (
        jnp.where(none, 0.0, q.dev) for none, q in zip(never, (low, up), strict=True)
    )
    return jnp.maximum(low_dev, up_dev)


def _full(tree: Tree, like: Tree) -> Tree:
    return jtu.tree_map(lambda v, w: jnp.broadcast_to(v, w.shape), tree, like)


def _clipped(place: Place, bounds: tuple[Tree, Tree], end: str) -> Place:
    """Return the place with the projection between the bounds of this end."""
    return place._replace(y=jtu.tree_map(jnp.clip, place.z, *(part(line, end) for line in bounds)))


def _normal(space: AbstractSpace, F: Tree, place: Place) -> tuple[Tree, jax.Array]:
    """Return v = σ(z − y) and σ ≥ 0, for which ‖F + v‖ is smallest."""
    s = _tree.sub(place.z, place.y)
    square = space.inner(s, s)
    sigma = jnp.where(square > 0.0, jnp.maximum(-space.inner(F, s), 0.0) / square, 0.0)
    sigma = jnp.where(jnp.isfinite(sigma), sigma, 0.0)
    return _tree.scale(sigma, s), sigma
