"""An affine law on a small box, solved by writing the solution out."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

MOST = 4
"""Unknowns of a law that is written out."""


class Point(NamedTuple):
    """The solution y, z = y − τF(y) with proj(z) = y, both up to rounding, and w in F(z̄) + N_K(z̄) at
    z̄ = proj(z), which is of the size of rounding."""

    y: jax.Array
    z: jax.Array
    w: jax.Array


class AbstractWritten(eqx.Module):
    """F(y) = My + q on boxes, where M does not change."""

    M: eqx.AbstractVar[jax.Array]

    @abc.abstractmethod
    def find(self, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        """y for vectors q and bounds, up to rounding. Its derivative is that of the face that
        z = y − F(y) lies over, an entry on its bound counting as held."""

    def solve(self, q: jax.Array, low: jax.Array, up: jax.Array) -> Point:
        """The solution for this q and these bounds, of any shape."""
        shape, M = q.shape, self.M
        q, low, up = q.ravel(), low.ravel(), up.ravel()
        # An entry that is held is its bound, to the last digit.
        y = jnp.clip(self.find(q, low, up), low, up)
        # A step of at most 1/‖M‖, or what rounding leaves of F would be taken for z.
        tau = 1.0 / jnp.maximum(1.0, jnp.max(jnp.sum(jnp.abs(M), axis=1)))
        z = y - tau * (M @ y + q)
        near = jnp.clip(z, low, up)
        # (z − near)/τ is in N_K(near), and F(near) + (z − near)/τ is:
        w = (y - near) / tau + M @ (near - y)
        return Point(y.reshape(shape), z.reshape(shape), w.reshape(shape))

    def held(self, y: jax.Array, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        """−1 and 1 for an entry that z = y − F(y) has on its lower or upper bound, 0 for a free one."""
        z, slack = y - (self.M @ y + q), 8 * self.rounding(y, q)
        return jnp.where(z <= low + slack, -1, jnp.where(z >= up - slack, 1, 0))

    def rounding(self, y: jax.Array, q: jax.Array) -> jax.Array:
        """What My + q, entry by entry, cannot be told from zero by."""
        y = jnp.abs(y.ravel())
        return jnp.finfo(q.dtype).eps * (jnp.abs(q.ravel()) + jnp.abs(self.M) @ y + y)


def fits(like: Any) -> bool:
    """Whether the law has few enough unknowns."""
    return isinstance(like, jax.Array) and 1 < like.size <= MOST
