"""The law written out: an affine inequality on a small box is affine in pieces, one a face.

On the face where the entries of a set B sit on their bounds and the others are free, the conditions
yᵢ = boundᵢ (i in B), (My + q)ᵢ = 0 (others) are linear: y = Gr with r made of the bounds and of −q. The
G of all 3ⁿ faces are computed once a run. An evaluation is then a few products, and the face whose
point satisfies the law is the one whose natural residual is zero.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .written import AbstractWritten


class Faces(AbstractWritten):
    """F(y) = My + q on boxes of n unknowns, where M does not change; `pieces` holds G face by face."""

    M: jax.Array
    pieces: jax.Array

    def find(self, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        M, side = self.M, jnp.asarray(sides(q.size))
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
        held = self.held(best, q, low, up)
        index = jnp.sum((held + 1) * 3 ** jnp.arange(q.size)[::-1])
        # Over that face, where it has the solution as well.
        slack = 8 * self.rounding(best, q)
        return points[jnp.where(off[index] <= off[first] + jnp.min(slack), index, first)]


def sides(n: int) -> np.ndarray:
    """All faces of a box: −1 and 1 for an entry on its lower or upper bound, 0 for a free one."""
    return np.array(list(itertools.product((-1, 0, 1), repeat=n)))


def faces(M: jax.Array) -> Faces:
    """The pieces for this M."""
    n = len(M)
    side, eye = jnp.asarray(sides(n)), jnp.eye(n, dtype=M.dtype)
    rows = jnp.where((side == 0)[:, :, None], M[None], eye[None])
    return Faces(M, jnp.linalg.inv(rows))
