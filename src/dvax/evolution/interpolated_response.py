"""How far the response over a step is from a line between its values at both ends.

Let F(y) = P⁻¹y − h(t, x, P⁻¹y), and let y* solve the law at the t and x of a time θ in the step. Let y
be the line between its values at the ends, and u = P⁻¹y. Since F is strongly pseudomonotone,
⟨F(y*), y − y*⟩ ≥ 0 implies γ‖y − y*‖² ≤ ⟨F(y), y − y*⟩. The law's solver is not enclosed.

*Polyhedral sets.* With normals v at the ends, an enclosure of h along u proves ‖F(y(θ)) + v(θ)‖ ≤ r for
the line v, and with g of `enclosed_projection`

    γ‖y − y*‖² ≤ r‖y − y*‖ + g/4,   so that γ‖y − y*‖ ≤ ρ = ½(r + √(r² + γg)).

This holds where the bounds of K are lines between their values at the ends. If the projection onto K
then differs by at most m from that onto the set of the lines (`moving_set`), the response differs by at
most (1 + L_F/γ)m.

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
from ..sets._face import Face
from ..spaces import AbstractSpace
from .enclosed_projection import by_its_rules, gap, part, rounding_of
from .moving_set import motion

_ROUNDINGS = 8.0
"""Relative roundoff of the terms of F, in units of ε."""


class Place(NamedTuple):
    """An end of a step: z, its projection y onto K, and the face of K there if K is polyhedral."""

    z: Tree
    y: Tree
    face: Face | None


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
    K, moves = problem.set_at(t.a, args), motion(problem, args, t, like, space)
    y = places[0].y, places[1].y
    u = straight(*map(P.inverse, y))
    law = lambda t, x, u: _tree.sub(u, problem.h(t, x, u, args))  # noqa: E731
    F = enclose(law, t, x, u)
    terms = [2.0 * space.norm(part(u, end)) + space.norm(part(F, end)) for end in ("a", "b")]
    roundoff = _ROUNDINGS * jnp.finfo(terms[0].dtype).eps * jnp.maximum(*terms)  # of F
    faces = [place.face for place in places if place.face is not None]
    if len(faces) < 2:
        stepped = enclose(lambda y, F: _step(y, F, L_F), straight(*y), F)
        projected = by_its_rules(problem, args, space, t, stepped, moves)
        R = enclose(_tree.sub, straight(*y), projected)
        largest = space.norm(jtu.tree_map(lambda q: q.largest, R, is_leaf=is_enclosure))
        scale = gamma + 2.0 * L_F
        return InterpolatedResponse(u, scale * (largest + roundoff / L_F), scale * largest)
    scales = [
        _scale(space, value, found.v)
        for value, found in zip((part(F, "a"), part(F, "b")), faces, strict=True)
    ]
    g = gap((faces[0], faces[1]), (scales[0], scales[1]))
    is_box = K.intervals(like) is not None  # whose projection is exact
    rounding = jnp.zeros_like(g) if is_box else rounding_of(K, space, *places)
    ends = [
        space.norm(_tree.add(part(F, end), _tree.scale(scale, found.v)))
        for end, scale, found in zip(("a", "b"), scales, faces, strict=True)
    ]
    r = jnp.maximum(*ends) + space.norm(part(F, "dev"))
    rho, resolved = (
        0.5 * (r + more + jnp.sqrt(jnp.square(r + more) + gamma * g))
        + (gamma + L_F) * moves.deviation
        for more in ((L_F + jnp.maximum(*scales)) * rounding + roundoff, 0.0)
    )
    return InterpolatedResponse(u, rho + gamma * rounding, resolved)


def interpolated_projection(
    K: AbstractSet, space: AbstractSpace, z: Tree, places: tuple[Place, Place], deviation: Any
) -> tuple[Tree, jax.Array, jax.Array]:
    """Return the line between the projections onto a polyhedral set at two places, as enclosures, and
    bounds on the distance of the projection from it, with roundoff and without, for an enclosure of z
    and the deviation of the set.

    This is the law of F(y) = y − z."""
    first, last = places
    assert first.face is not None and last.face is not None
    rounding, one = rounding_of(K, space, *places), jnp.ones_like(deviation)
    g = gap((first.face, last.face), (one, one))
    ends = [
        space.norm(_tree.sub(part(z, end), place.z))
        for end, place in zip(("a", "b"), places, strict=True)
    ]
    r = jnp.maximum(*ends) + space.norm(part(z, "dev"))
    apart, resolved = (
        0.5 * (r + more + jnp.sqrt(jnp.square(r + more) + g)) + 2.0 * deviation
        for more in (2.0 * rounding, 0.0)
    )
    return straight(first.y, last.y), apart + rounding, resolved


def _step(y: Tree, F: Tree, L_F: Any) -> Tree:
    return jtu.tree_map(lambda a, b: a - b / L_F, y, F)


def _scale(space: AbstractSpace, F: Tree, v: Tree) -> jax.Array:
    """Return the σ ≥ 0 for which ‖F + σv‖ is smallest."""
    square = space.inner(v, v)
    sigma = jnp.where(square > 0.0, jnp.maximum(-space.inner(F, v), 0.0) / square, 0.0)
    return jnp.where(jnp.isfinite(sigma), sigma, 0.0)
