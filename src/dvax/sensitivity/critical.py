"""The critical cone, in which the response varies to first order.

For y = proj_K(z) and polyhedral K, the directional derivative of the projection along v is the
projection of v onto the critical cone

    C = {v ∈ T_K(y) : ⟨z − y, v⟩ = 0}.

For any K it is firmly nonexpansive in v: the resolvent of the derivative of N_K. So δy solves a
variational inequality of the same kind (Robinson 1980; Dontchev and Rockafellar 2014, Section 2E).
If K depends on η, C is shifted by the displacement of its boundary.

Between two kinks of the trajectory the active constraints do not change. This *activity* is determined
once, at the midpoint of the interval, since near its ends roundoff would decide.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..sets import AbstractSet, Box, Product
from ..spaces import AbstractSpace


def activity(K: AbstractSet, y: Tree, w: Tree, space: AbstractSpace, tol: float) -> Tree:
    """Return the activity of an interval between kinks, with the response y at its midpoint.

    w = −F(y) ∈ N_K(y). For boxes it is, entry by entry: at the lower bound, at the upper bound,
    strictly active at the lower bound, strictly active at the upper bound (with a nonzero
    multiplier). For other sets it is the signs of the set's switches, 0 within `tol` of zero."""
    bounds = K.intervals(y)
    if bounds is not None:

        def flags_of(y: jax.Array, w: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
            at_low, at_high = y - low <= tol, high - y <= tol
            flags = (at_low, at_high, at_low & (w < -tol), at_high & (w > tol))
            return jnp.stack([flag.astype(y.dtype) for flag in flags])

        return jtu.tree_map(flags_of, y, w, *bounds)
    s = _switches(K, jtu.tree_map(jnp.add, y, w), space)
    return jnp.where(jnp.abs(s) <= tol, 0.0, jnp.sign(s))


def critical_cone(
    K: Callable[[Any], AbstractSet],
    args: Any,
    dargs: Any,
    y: Tree,
    w: Tree,
    activity: Tree,
    tol: Any,
) -> AbstractSet:
    """Return the set of δy for a response y with w = −F(y), where K(args) changes along dargs."""
    if K(args).intervals(y) is None:
        return CriticalCone(K, args, dargs, jtu.tree_map(jnp.add, y, w), activity, tol)
    dbounds = jax.jvp(lambda a: K(a).intervals(y), (args,), (dargs,))[1]
    leaves, structure = jtu.tree_flatten(y)
    lows, highs, flags = (jtu.tree_leaves(tree) for tree in (*dbounds, activity))
    bounds = [_bounds(*parts) for parts in zip(lows, highs, flags, strict=True)]
    assert len(leaves) == len(bounds)
    if isinstance(y, tuple):
        return Product(*(Box(*pair) for pair in bounds))
    return Box(*(structure.unflatten(side) for side in zip(*bounds, strict=True)))


def _bounds(dlow: jax.Array, dhigh: jax.Array, flags: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the bounds (lower, upper) of δy, entry by entry.

    They enclose a point for strictly active entries, a half-line for weakly active ones, and the real
    line for the others.
    """
    at_low, at_high, strict_low, strict_high = flags > 0.5
    lower = jnp.where(at_low, dlow, jnp.where(strict_high, dhigh, -jnp.inf))
    upper = jnp.where(at_high, dhigh, jnp.where(strict_low, dlow, jnp.inf))
    # If both bounds coincide, δy is their common displacement.
    return jnp.minimum(lower, upper), upper


class CriticalCone(AbstractSet):
    """The directional derivative of the projection onto a set that is not a box.

    project(v) is the derivative of the projection along v at z. At a kink (a 0 in `activity`) it is the
    derivative at z + εv, for an ε so small that there is no other kink in between.
    """

    K: Callable[[Any], AbstractSet] = eqx.field(static=True)
    args: Any
    dargs: Any
    z: Tree
    activity: jax.Array
    tol: Any

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        dargs_squared = sum(jnp.sum(jnp.square(leaf)) for leaf in jtu.tree_leaves(self.dargs))
        size = jnp.sqrt(space.norm(z) ** 2 + dargs_squared)
        # At a kink, step beyond the tolerance in the direction of (v, δη) to select the side.
        epsilon = 10.0 * self.tol / jnp.where(size > 0, size, 1.0)
        epsilon = jnp.where(jnp.any(self.activity == 0), epsilon, 0.0)
        shifted = jtu.tree_map(lambda p, v: p + epsilon * v, self._corrected_z(space), z)
        args = jtu.tree_map(lambda p, v: p + epsilon * v, self.args, self.dargs)

        def project(point: Tree, args: Any) -> Tree:
            return self.K(args).project(point, space)

        return jax.jvp(project, (shifted, args), (z, self.dargs))[1]

    def _corrected_z(self, space: AbstractSpace) -> Tree:
        """Return z, moved across a kink if roundoff has put it on the wrong side of it."""

        def switch(z: Tree) -> jax.Array:
            return _switches(self.K(self.args), z, space)

        if not self.activity.size:
            return self.z
        s, gradients = switch(self.z), jax.jacrev(switch)(self.z)
        wrong_side = (self.activity != 0) & (s * self.activity <= 0) & (jnp.abs(s) <= self.tol)
        squares = sum(
            jnp.sum(jnp.square(leaf).reshape(len(s), -1), axis=1)
            for leaf in jtu.tree_leaves(gradients)
        )
        step = (self.activity * self.tol - s) / jnp.where(squares > 0, squares, 1.0)
        step = jnp.where(wrong_side, step, 0.0)
        return jtu.tree_map(lambda p, g: p + jnp.tensordot(step, g, 1), self.z, gradients)

    def switches(self, z: Tree, space: AbstractSpace) -> None:
        return None

    def intervals(self, like: Tree) -> None:
        return None

    def check(self, like: Tree) -> None:
        self.K(self.args).check(like)


def _switches(K: AbstractSet, z: Tree, space: AbstractSpace) -> jax.Array:
    switches = K.switches(z, space)
    return jnp.concatenate([jnp.ravel(s) for s in switches]) if switches else jnp.zeros(0)
