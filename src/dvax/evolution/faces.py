"""The law written out: an affine inequality on a small box is affine in pieces, one a face.

On the face where the entries of a set B sit on their bounds and the others are free, the conditions
yᵢ = boundᵢ (i in B), (My + q)ᵢ = 0 (others) are linear: y = Gr with r made of the bounds and of −q. The
G of all 3ⁿ faces are computed once a run. An evaluation is then a few products, and the face whose
point satisfies the law is the one whose natural residual is zero.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

MOST = 4
"""Unknowns of a law that is written out: 81 faces."""


class Point(NamedTuple):
    """The solution y, z with proj(z) = y, both up to rounding, and w in F(z̄) + N_K(z̄) at z̄ = proj(z),
    which is of the size of rounding."""

    y: jax.Array
    z: jax.Array
    w: jax.Array


class Faces(eqx.Module):
    """F(y) = My + q on boxes of n unknowns, where M does not change; `pieces` holds G face by face."""

    M: jax.Array
    pieces: jax.Array

    def solve(self, q: jax.Array, low: jax.Array, up: jax.Array) -> Point:
        """The solution for this q and these bounds. Its derivative is that of the face that
        z = y − F(y) lies over, an entry on its bound counting as held."""
        shape, M = q.shape, self.M
        q, low, up = q.ravel(), low.ravel(), up.ravel()
        side = jnp.asarray(sides(q.size))
        right = jnp.where(side < 0, low[None], jnp.where(side > 0, up[None], -q[None]))
        there = jnp.all(jnp.isfinite(right), axis=1)
        # A bound at infinity has no face.
        right = jnp.where(jnp.isfinite(right), right, 0.0)
        # Nor has one where its matrix is singular.
        sound = jnp.all(jnp.isfinite(self.pieces), axis=(1, 2))
        there, pieces = there & sound, jnp.where(sound[:, None, None], self.pieces, 0.0)
        # Sums of products, for what are so few numbers: a product of matrices is a call of a library.
        points = jnp.sum(pieces * right[:, None, :], axis=2)
        F = jnp.sum(M[None] * points[:, None, :], axis=2) + q[None]
        off = jnp.max(jnp.abs(points - jnp.clip(points - F, low[None], up[None])), axis=1)
        off = lax.stop_gradient(jnp.where(there & ~jnp.isnan(off), off, jnp.inf))
        first = jnp.argmin(off)
        best = points[first]
        slack = 8 * self.rounding(best, q)
        z = best - (M @ best + q)
        held = jnp.where(z <= low + slack, -1, jnp.where(z >= up - slack, 1, 0))
        index = jnp.sum((held + 1) * 3 ** jnp.arange(q.size)[::-1])
        # Over that face, where it has the solution as well.
        face = jnp.where(off[index] <= off[first] + jnp.min(slack), index, first)
        # An entry that is held is its bound, to the last digit.
        y = jnp.clip(points[face], low, up)
        z = y - (M @ y + q)
        near = jnp.clip(z, low, up)
        # z − near is in N_K(near), and F(near) + z − near is:
        w = (y - near) + M @ (near - y)
        return Point(y.reshape(shape), z.reshape(shape), w.reshape(shape))

    def rounding(self, y: jax.Array, q: jax.Array) -> jax.Array:
        """What My + q, entry by entry, cannot be told from zero by."""
        y = jnp.abs(y.ravel())
        return jnp.finfo(q.dtype).eps * (jnp.abs(q.ravel()) + jnp.abs(self.M) @ y + y)


def sides(n: int) -> np.ndarray:
    """All faces of a box: −1 and 1 for an entry on its lower or upper bound, 0 for a free one."""
    return np.array(list(itertools.product((-1, 0, 1), repeat=n)))


def faces(F: Callable[[jax.Array], jax.Array], like: jax.Array) -> Faces:
    """The pieces of an affine F at arguments shaped like `like`."""
    M = jax.jacfwd(lambda v: F(v.reshape(like.shape)).ravel())(jnp.zeros_like(like).ravel())
    side, eye = jnp.asarray(sides(like.size)), jnp.eye(like.size, dtype=like.dtype)
    rows = jnp.where((side == 0)[:, :, None], M[None], eye[None])
    return Faces(M, jnp.linalg.inv(rows))


def fits(like: Any) -> bool:
    """Whether the law has few enough unknowns."""
    return isinstance(like, jax.Array) and 1 < like.size <= MOST
