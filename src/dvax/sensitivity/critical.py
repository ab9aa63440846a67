"""The set that the response moves in, to first order: where y = proj_K(z), the directional derivative
of the projection along v is the projection of v onto the critical cone

    C = {v ∈ T_K(y) : ⟨z − y, v⟩ = 0}

where K is polyhedral, and firmly nonexpansive in v for any K: the resolvent of the derivative of N_K.
So δy solves a variational inequality of the same kind (Robinson 1980; Dontchev and Rockafellar 2014,
Section 2E). K may move with η: then C is shifted by what its boundary moves.

Between two kinks of the trajectory nothing about C changes but its place. What kind of stretch it is,
its *code*, is read off once, in the middle: near its ends rounding would decide.
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


def code(K: AbstractSet, y: Tree, w: Tree, space: AbstractSpace, tol: float) -> Tree:
    """Of a stretch with this response in its middle, w = −F(y) ∈ N_K(y).

    For intervals, entry by entry, (at the lower bound, at the upper one, held there by a force: the
    same twice); else the signs of the set's switches, 0 within `tol` of zero.
    """
    bounds = K.intervals(y)
    if bounds is not None:

        def of(y: jax.Array, w: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
            at_low, at_high = y - low <= tol, high - y <= tol
            flags = (at_low, at_high, at_low & (w < -tol), at_high & (w > tol))
            return jnp.stack([flag.astype(y.dtype) for flag in flags])

        return jtu.tree_map(of, y, w, *bounds)
    s = _switches(K, jtu.tree_map(jnp.add, y, w), space)
    return jnp.where(jnp.abs(s) <= tol, 0.0, jnp.sign(s))


def critical(
    K: Callable[[Any], AbstractSet], args: Any, dargs: Any, y: Tree, w: Tree, code: Tree, tol: Any
) -> AbstractSet:
    """The set of δy for a response y with w = −F(y), where K(args) changes along dargs."""
    if K(args).intervals(y) is None:
        return Ahead(K, args, dargs, jtu.tree_map(jnp.add, y, w), code, tol)
    move = jax.jvp(lambda a: K(a).intervals(y), (args,), (dargs,))[1]
    leaves, structure = jtu.tree_flatten(y)
    lows, highs, codes = (jtu.tree_leaves(tree) for tree in (*move, code))
    ends = [_entries(*parts) for parts in zip(lows, highs, codes, strict=True)]
    assert len(leaves) == len(ends)
    if isinstance(y, tuple):
        return Product(*(Box(*pair) for pair in ends))
    return Box(*(structure.unflatten(side) for side in zip(*ends, strict=True)))


def _entries(dlow: jax.Array, dhigh: jax.Array, code: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(lower, upper) of δy, entry by entry: one place where a force holds it, a half-line where it is
    at a bound without one, and everything elsewhere."""
    at_low, at_high, held_low, held_high = code > 0.5
    least = jnp.where(at_low, dlow, jnp.where(held_high, dhigh, -jnp.inf))
    most = jnp.where(at_high, dhigh, jnp.where(held_low, dlow, jnp.inf))
    # Between two bounds that coincide there is one place, where they move together.
    return jnp.minimum(least, most), most


class Ahead(AbstractSet):
    """What any set does just ahead of a point: project(v) is the derivative of the projection along v
    at z or, at a kink (a 0 in the code), at z + εv, for an ε so small that no other kink lies between.
    """

    K: Callable[[Any], AbstractSet] = eqx.field(static=True)
    args: Any
    dargs: Any
    z: Tree
    code: jax.Array
    tol: Any

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        moves = sum(jnp.sum(jnp.square(leaf)) for leaf in jtu.tree_leaves(self.dargs))
        size = jnp.sqrt(space.norm(z) ** 2 + moves)
        # At a kink, past all that counts as one: then the side is the one that v and δη point to.
        ahead = 10.0 * self.tol / jnp.where(size > 0, size, 1.0)
        ahead = jnp.where(jnp.any(self.code == 0), ahead, 0.0)
        shifted = jtu.tree_map(lambda p, v: p + ahead * v, self._aside(space), z)
        args = jtu.tree_map(lambda p, v: p + ahead * v, self.args, self.dargs)
        at = lambda point, a: self.K(a).project(point, space)  # noqa: E731
        return jax.jvp(at, (shifted, args), (z, self.dargs))[1]

    def _aside(self, space: AbstractSpace) -> Tree:
        """z, where rounding has it on the wrong side of a kink put on the side of its stretch."""
        switch = lambda z: _switches(self.K(self.args), z, space)  # noqa: E731
        if not self.code.size:
            return self.z
        s, slopes = switch(self.z), jax.jacrev(switch)(self.z)
        wrong = (self.code != 0) & (s * self.code <= 0) & (jnp.abs(s) <= self.tol)
        lengths = sum(
            jnp.sum(jnp.square(leaf).reshape(len(s), -1), axis=1)
            for leaf in jtu.tree_leaves(slopes)
        )
        move = jnp.where(
            wrong, (self.code * self.tol - s) / jnp.where(lengths > 0, lengths, 1.0), 0.0
        )
        return jtu.tree_map(lambda p, g: p + jnp.tensordot(move, g, 1), self.z, slopes)

    def switches(self, z: Tree, space: AbstractSpace) -> None:
        return None

    def intervals(self, like: Tree) -> None:
        return None

    def check(self, like: Tree) -> None:
        self.K(self.args).check(like)


def _switches(K: AbstractSet, z: Tree, space: AbstractSpace) -> jax.Array:
    found = K.switches(z, space)
    return jnp.concatenate([jnp.ravel(s) for s in found]) if found else jnp.zeros(0)
