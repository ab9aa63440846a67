"""How far the response over a step is from a line between its values at both ends.

At the ends k = 0, 1 of a step let yₖ = proj_K(zₖ) and vₖ = σₖ(zₖ − yₖ) with σₖ ≥ 0, so that
vₖ ∈ N_K(yₖ). Let y, v and u = P⁻¹y be lines between their values at the ends. For every k ∈ K

    ⟨v(θ), k − y(θ)⟩ ≤ θ(1 − θ)g ≤ g/4,   g = ⟨v₁ − v₀, y₁ − y₀⟩ ≥ 0.

For a polyhedral K with the same active constraints at both ends, g = 0. If K is a box whose bounds are
the lines l and b, then with s⁺ = max(s, 0) and s⁻ = max(−s, 0)

    g = ⟨v₀⁺, b₁ − y₁⟩ + ⟨v₁⁺, b₀ − y₀⟩ + ⟨v₀⁻, y₁ − l₁⟩ + ⟨v₁⁻, y₀ − l₀⟩.

Let F(y) = P⁻¹y − h(t, x, P⁻¹y). An enclosure of h along u proves ‖F(y(θ)) + v(θ)‖ ≤ r. Let y* solve the
law at the same t and x. F is strongly pseudomonotone: ⟨F(y*), y − y*⟩ ≥ 0 implies

    γ‖y − y*‖² ≤ ⟨F(y), y − y*⟩ ≤ r‖y − y*‖ + g/4,   so that γ‖y − y*‖ ≤ ρ = ½(r + √(r² + γg)).

If the bounds of the box are lines up to d, each yᵢ moves by at most dᵢ with the bound to which vᵢ is
normal: g stays the same, and F changes by at most L_F‖d‖.

For smooth data r = O(h²), and g = O(h²) in a step in which active constraints change. The solver of
the law is neither differentiated nor enclosed.
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
from ..sets import AbstractSet, Ball, Ellipsoid, Intersection, SecondOrderCone
from ..sets._library import is_of_library, sets_in
from ..spaces import AbstractSpace

_CURVED = (Ball, Ellipsoid, SecondOrderCone)

_ROUNDINGS = 1e4
"""Error of a projection that is no box, in units of ε times the size of z and y."""


class Place(NamedTuple):
    """An end of a step: z, its projection y onto K, and the switch functions of K at z where K is no
    box."""

    z: Tree
    y: Tree
    switches: list[jax.Array] | None


class InterpolatedResponse(NamedTuple):
    """The line between the responses at both ends of a step.

    - `u`: the line, as enclosures without a deviation;
    - `residual`: ρ of the file's docstring, at all times of the step;
    - `apart`: a bound on ‖y − y*‖, which is ρ/γ unless bounds move."""

    u: Tree
    residual: jax.Array
    apart: jax.Array


def is_polyhedral(K: AbstractSet, like: Tree) -> bool:
    """Return whether K is known to be a box, or a polyhedral set with an exact projection."""
    if K.intervals(like) is not None:
        return True
    return is_of_library(K) and not any(isinstance(s, (*_CURVED, Intersection)) for s in sets_in(K))


def interpolated(
    problem: Problem, args: Any, P: AbstractOperator, t: LinearEnclosure, x: Tree,
    places: tuple[Place, Place], gamma: Any, L_F: Any,
) -> InterpolatedResponse:  # fmt: skip
    """Return the line between the responses at two places, for enclosures of t and x.

    **Raises:** `NoEnclosure` where h, or the bounds of a box, use an operation without a rule.
    """
    start = jtu.tree_map(lambda q: q.a, x, is_leaf=is_enclosure)
    space, like = problem.spaces(start)[1], problem.zero_control(start)
    lines, moved = None, jnp.zeros((), _tree.dtype(like))
    if problem.set_at(t.a, args).intervals(like) is not None:
        lines = enclose(lambda t: problem.set_at(t, args).intervals(like), t)
        places = _clipped(places[0], lines, "a"), _clipped(places[1], lines, "b")
        moved = space.norm(_full(jtu.tree_map(_larger, *lines, is_leaf=is_enclosure), like))
    u = straight(*(P.inverse(place.y) for place in places))
    h = enclose(lambda t, x, u: problem.h(t, x, u, args), t, x, u)
    F = [_tree.sub(_part(u, end), _part(h, end)) for end in ("a", "b")]
    normals = [_normal(space, *pair) for pair in zip(F, places, strict=True)]
    sums = [space.norm(_tree.add(value, v)) for value, (v, _) in zip(F, normals, strict=True)]
    stretch = jnp.maximum(*(sigma for _, sigma in normals))
    v = tuple(v for v, _ in normals)
    if lines is not None:
        g, rounding = _gap_of_box(space, places, v, lines), jnp.zeros_like(moved)
    else:
        rounding = _rounding(space, places)
        g = _gap(space, places, v, stretch, rounding)
    r = jnp.maximum(*sums) + space.norm(_part(h, "dev")) + L_F * moved + (L_F + stretch) * rounding
    rho = 0.5 * (r + jnp.sqrt(jnp.square(r) + gamma * g)) + gamma * (moved + rounding)
    return InterpolatedResponse(u, rho, rho / gamma)


def _part(enclosures: Tree, name: str) -> Tree:
    return jtu.tree_map(lambda q: getattr(q, name), enclosures, is_leaf=is_enclosure)


def _larger(low: LinearEnclosure, up: LinearEnclosure) -> jax.Array:
    """Return the larger deviation of two bounds; a bound that is infinite all the time has none."""
    never = [(q.a == q.b) & jnp.isinf(q.a) for q in (low, up)]
    low_dev, up_dev = (
        jnp.where(none, 0.0, q.dev) for none, q in zip(never, (low, up), strict=True)
    )
    return jnp.maximum(low_dev, up_dev)


def _full(tree: Tree, like: Tree) -> Tree:
    return jtu.tree_map(lambda v, w: jnp.broadcast_to(v, w.shape), tree, like)


def _clipped(place: Place, lines: tuple[Tree, Tree], end: str) -> Place:
    """Return the place with the projection between the bounds of this end."""
    return place._replace(y=jtu.tree_map(jnp.clip, place.z, *(_part(line, end) for line in lines)))


def _normal(space: AbstractSpace, F: Tree, place: Place) -> tuple[Tree, jax.Array]:
    """Return v = σ(z − y) and σ ≥ 0, for which ‖F + v‖ is smallest."""
    s = _tree.sub(place.z, place.y)
    square = space.inner(s, s)
    sigma = jnp.where(square > 0.0, jnp.maximum(-space.inner(F, s), 0.0) / square, 0.0)
    sigma = jnp.where(jnp.isfinite(sigma), sigma, 0.0)
    return _tree.scale(sigma, s), sigma


def _gap_of_box(
    space: AbstractSpace, places: tuple[Place, Place], v: tuple[Tree, Tree], lines: tuple[Tree, Tree]
) -> jax.Array:  # fmt: skip
    """Return g for a box whose bounds are lines."""

    def of_leaf(
        y0: jax.Array, y1: jax.Array, v0: jax.Array, v1: jax.Array, low: Any, up: Any
    ) -> jax.Array:
        return (
            _product(v0, up.b - y1) + _product(v1, up.a - y0)
            + _product(-v0, y1 - low.b) + _product(-v1, y0 - low.a)
        )  # fmt: skip

    first, last = places
    terms = jtu.tree_map(of_leaf, first.y, last.y, *v, *lines)
    return space.inner(terms, jtu.tree_map(jnp.ones_like, terms))


def _product(v: jax.Array, slack: jax.Array) -> jax.Array:
    """Return v⁺ times a slack, which may be infinite where v⁺ = 0."""
    return jnp.where(v > 0.0, v * slack, 0.0)


def _rounding(space: AbstractSpace, places: tuple[Place, Place]) -> jax.Array:
    """Return a bound on the error of the projections."""
    size = jnp.maximum(*(space.norm(place.z) + space.norm(place.y) for place in places))
    return _ROUNDINGS * jnp.finfo(size.dtype).eps * size


def _gap(
    space: AbstractSpace, places: tuple[Place, Place], v: tuple[Tree, Tree], stretch: Any,
    rounding: Any,
) -> jax.Array:  # fmt: skip
    """Return g for a set that does not move: 0 if no switch function changes its sign."""
    first, last = places
    of_y, of_v = _tree.sub(last.y, first.y), _tree.sub(v[1], v[0])
    doubt = 2.0 * rounding * (space.norm(of_v) + stretch * (space.norm(of_y) + 2.0 * rounding))
    g = jnp.maximum(space.inner(of_v, of_y), 0.0)
    if first.switches is None or last.switches is None:
        return g + doubt
    same = g <= doubt
    for a, b in zip(first.switches, last.switches, strict=True):
        same &= jnp.all(((a > rounding) & (b > rounding)) | ((a < -rounding) & (b < -rounding)))
    return jnp.where(same, 0.0, g + doubt)
