"""A multigrid V-cycle for −Δ on the free nodes of a square grid: what a user brings to precondition
the linear systems of an obstacle problem.

Grids have 2ᵏ − 1 inner nodes a side and zero boundary values; a coarse node is free where the fine one
at the same place is (truncation, Kornhuber 1994).
"""

import jax
import jax.numpy as jnp


def minus_laplacian(y: jax.Array, h: float) -> jax.Array:
    """The five-point −Δ with zero boundary values."""
    p = jnp.pad(y, 1)
    return (4 * y - p[2:, 1:-1] - p[:-2, 1:-1] - p[1:-1, 2:] - p[1:-1, :-2]) / h**2


def v_cycle(free: jax.Array, r: jax.Array, h: float) -> jax.Array:
    """An approximate solution of −Δd = r at the free nodes, d = 0 elsewhere.

    Two damped Jacobi steps before and after, so that the cycle is symmetric and may precondition
    conjugate gradients.
    """

    def apply(d: jax.Array) -> jax.Array:
        return jnp.where(free, minus_laplacian(d, h), 0.0)

    weight = 0.8 * h * h / 4
    d = weight * r
    if r.shape[0] == 1:
        return jnp.where(free, r * h * h / 4, 0.0)
    d = d + weight * (r - apply(d))
    coarse = free[1::2, 1::2]
    correction = v_cycle(coarse, jnp.where(coarse, _restrict(r - apply(d)), 0.0), 2 * h)
    d = d + jnp.where(free, prolong(correction), 0.0)
    for _ in range(2):
        d = d + weight * (r - apply(d))
    return d


def prolong(coarse: jax.Array) -> jax.Array:
    """Bilinear interpolation to the next finer grid, zero on the boundary."""
    m = coarse.shape[0]
    p = jnp.pad(coarse, 1)
    fine = jnp.zeros((2 * m + 1, 2 * m + 1), coarse.dtype).at[1::2, 1::2].set(coarse)
    fine = fine.at[0::2, 1::2].set((p[:-1, 1:-1] + p[1:, 1:-1]) / 2)
    fine = fine.at[1::2, 0::2].set((p[1:-1, :-1] + p[1:-1, 1:]) / 2)
    corners = p[:-1, :-1] + p[1:, :-1] + p[:-1, 1:] + p[1:, 1:]
    return fine.at[0::2, 0::2].set(corners / 4)


def _restrict(r: jax.Array) -> jax.Array:
    """Full weighting: a quarter of the transpose of `prolong`."""
    beside = r[1::2, 0:-1:2] + r[1::2, 2::2] + r[0:-1:2, 1::2] + r[2::2, 1::2]
    corners = r[0:-1:2, 0:-1:2] + r[2::2, 0:-1:2] + r[0:-1:2, 2::2] + r[2::2, 2::2]
    return (4 * r[1::2, 1::2] + 2 * beside + corners) / 16
