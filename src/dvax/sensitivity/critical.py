"""The set that the response moves in, to first order: where y = proj_K(z), the directional derivative
of the projection along v is the projection of v onto the critical cone

    C = {v ∈ T_K(y) : ⟨z − y, v⟩ = 0}

where K is polyhedral, and firmly nonexpansive in v for any K: the resolvent of the derivative of N_K.
So δy solves a variational inequality of the same kind (Robinson 1980; Dontchev and Rockafellar 2014,
Section 2E). K may move with η: then C is shifted by what its boundary moves.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..sets import AbstractSet, Box
from ..spaces import AbstractSpace


def critical(
    K: Callable[[Any], AbstractSet], args: Any, dargs: Any, y: Tree, w: Tree, tol: Any
) -> AbstractSet:
    """The set of δy for a response y with w = −F(y) ∈ N_K(y), where K(args) changes along dargs.

    A bound within `tol` of y holds it, weakly where |w| ≤ tol as well: then y may leave it.
    """
    bounds = K(args).intervals(y)
    if bounds is None:
        return Ahead(K, args, dargs, jtu.tree_map(jnp.add, y, w), tol)
    move = jax.jvp(lambda a: K(a).intervals(y), (args,), (dargs,))[1]
    parts, structure = zip(*map(jtu.tree_flatten, (y, w, *bounds, *move)), strict=True)
    ends = [_entries(*leaves, tol) for leaves in zip(*parts, strict=True)]
    return Box(*(structure[0].unflatten(side) for side in zip(*ends, strict=True)))


def _entries(
    y: jax.Array, w: jax.Array, low: jax.Array, high: jax.Array, dlow: Any, dhigh: Any, tol: Any
) -> tuple[jax.Array, jax.Array]:
    """(lower, upper) of δy, entry by entry."""
    at_low, at_high = y - low <= tol, high - y <= tol
    held_low, held_high = at_low & (w < -tol), at_high & (w > tol)
    least = jnp.where(at_low, dlow, jnp.where(held_high, dhigh, -jnp.inf))
    most = jnp.where(at_high, dhigh, jnp.where(held_low, dlow, jnp.inf))
    # Between two bounds that coincide there is one place, where they move together.
    return jnp.minimum(least, most), most


class Ahead(AbstractSet):
    """What any set does just ahead of a point: project(v) is the derivative of the projection along v
    at z or, within `tol` of a kink, at z + εv, for an ε so small that no other kink lies between."""

    K: Callable[[Any], AbstractSet] = eqx.field(static=True)
    args: Any
    dargs: Any
    z: Tree
    tol: Any

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        size, found = space.norm(z), self.K(self.args).switches(self.z, space)
        near = [jnp.any(jnp.abs(s) <= self.tol) for s in found or ()]
        # At a kink, past all that counts as one: then the side is the one that v points to.
        at_kink = jnp.any(jnp.stack(near)) if near else jnp.asarray(False)
        ahead = jnp.where(at_kink, 10.0 * self.tol / jnp.where(size > 0, size, 1.0), 0.0)
        shifted = jtu.tree_map(lambda p, v: p + ahead * v, self.z, z)
        args = jtu.tree_map(lambda p, v: p + ahead * v, self.args, self.dargs)
        at = lambda point, a: self.K(a).project(point, space)  # noqa: E731
        return jax.jvp(at, (shifted, args), (z, self.dargs))[1]

    def switches(self, z: Tree, space: AbstractSpace) -> None:
        return None

    def intervals(self, like: Tree) -> None:
        return None

    def check(self, like: Tree) -> None:
        self.K(self.args).check(like)
