"""The largest displacement between two samples, from what is known at both."""

from typing import Any

import jax
import jax.numpy as jnp

_ROUNDS = 5


def largest(d: jax.Array, v: jax.Array, a: jax.Array, h: Any) -> jax.Array:
    """max |d| over all times, for displacements d, velocities v and accelerations a at times h apart.

    Between two of them d is taken to be the quintic that fits all six numbers, and its extremum is
    where its velocity, nearly a cubic, is zero. With ω h = 0.5 a sine is met within 10⁻⁷.
    """
    d0, d1, v0, v1, a0, a1 = d[:-1], d[1:], v[:-1], v[1:], h * a[:-1], h * a[1:]
    # The cubic v₀ + s(a₀ + s(b + s c)) through both velocities and accelerations, s = (t − t₀)/h.
    rise = v1 - v0
    b, c = 3.0 * rise - 2.0 * a0 - a1, a0 + a1 - 2.0 * rise
    turns = (v0 > 0) != (v1 > 0)
    s = jnp.where(turns, v0 / jnp.where(turns, v0 - v1, 1.0), 0.0)
    for _ in range(_ROUNDS):
        value, slope = v0 + s * (a0 + s * (b + s * c)), a0 + s * (2.0 * b + 3.0 * s * c)
        s = jnp.clip(s - value / jnp.where(slope != 0, slope, 1.0), 0.0, 1.0)

    def moved(s: Any) -> Any:
        return h * s * (v0 + s * (a0 / 2.0 + s * (b / 3.0 + s * c / 4.0)))

    # What the cubic misses at the end, spread so that neither v nor a changes at the ends.
    missed = d1 - d0 - moved(1.0)
    top = d0 + moved(s) + missed * s**3 * (10.0 - s * (15.0 - 6.0 * s))
    ends = jnp.max(jnp.abs(d))
    return jnp.maximum(ends, jnp.max(jnp.where(turns, jnp.abs(top), 0.0)))
