"""The φ-functions of a number and of a matrix."""

import math
from typing import Any

import jax
import jax.numpy as jnp

_TERMS = 20  # of the Taylor series on |z| < 1: 1/20! is below double rounding


def phi_scalar(z: jax.Array, order: int) -> tuple[jax.Array, ...]:
    """(φ₀(z), …, φ_order(z)), elementwise, real or complex, to a few rounding errors.

    On |z| < 1 the recurrence φₖ₊₁ = (φₖ − 1/k!)/z cancels, so the highest one is summed as a Taylor
    series and the others follow by the recurrence read downward, which is stable there; on |z| ≥ 1
    it is read upward. Both branches are evaluated with a harmless argument where they are not
    taken, so that derivatives stay finite.
    """
    if order == 0:
        return (jnp.exp(z),)
    small = jnp.abs(z) < 1.0
    inner = jnp.where(small, z, 0.5)
    outer = jnp.where(small, 1.5, z)

    top = jnp.full_like(inner, 1.0 / math.factorial(order + _TERMS - 1))
    for j in range(_TERMS - 2, -1, -1):
        top = top * inner + 1.0 / math.factorial(order + j)
    down = [top]
    for k in range(order - 1, -1, -1):
        down.append(inner * down[-1] + 1.0 / math.factorial(k))
    down.reverse()

    up = [jnp.exp(outer)]
    for k in range(order):
        up.append((up[-1] - 1.0 / math.factorial(k)) / outer)

    return tuple(jnp.where(small, a, b) for a, b in zip(down, up, strict=True))


def phi_matrix(z: jax.Array, order: int) -> tuple[jax.Array, ...]:
    """(φ₀(Z), …, φ_order(Z)) of a square matrix, from one exponential.

    exp of the block matrix [[Z, I, 0, …], [0, 0, I, …], …, [0, …, 0]] has first block row
    (φ₀(Z), φ₁(Z), …) (Al-Mohy and Higham 2011, Theorem 2.1).
    """
    n = z.shape[0]
    size = (order + 1) * n
    block = jnp.zeros((size, size), z.dtype).at[:n, :n].set(z)
    shift = jnp.eye(order * n, dtype=z.dtype)
    block = block.at[: order * n, n:].add(shift) if order else block
    first_row = expm(block)[:n]
    return tuple(first_row[:, k * n : (k + 1) * n] for k in range(order + 1))


def expm(matrix: jax.Array) -> jax.Array:
    """The exponential of a matrix of any norm: JAX by itself gives NaN beyond 3·10⁵."""
    return jax.scipy.linalg.expm(matrix, max_squarings=64)


def flow_factors(h: Any, phis: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    """(e^{hA}, h 0! φ₁, h 1! φ₂, …): what a propagator multiplies x₀, c₀, c₁, … by."""
    return phis[0], *(h * math.factorial(j) * phi for j, phi in enumerate(phis[1:]))
