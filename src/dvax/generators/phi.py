"""φ-functions of numbers and of square matrices."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .._batch import largest_of_lanes
from .bounded_while import bounded_while

_TERMS = 20  # terms of the Taylor series on |z| < 1: 1/20! is below the roundoff of doubles
_MAX_ROWS_BY_SUM = 8  # up to this size a library call takes longer than the product itself
_MAX_ROWS_UNROLLED = 3  # up to this size unrolled sums are faster than a reduction
_LOOPS = (8, 8, 16)  # lengths of nested loops: at most 1023 halvings, for norms up to 10³⁰⁷


def phi_scalar(z: jax.Array, order: int) -> tuple[jax.Array, ...]:
    """Return (φ₀(z), …, φ_order(z)), elementwise, real or complex, with errors of a few eps.

    On |z| < 1 the recurrence φₖ₊₁ = (φₖ − 1/k!)/z suffers from cancellation. There φ_order is summed
    as a Taylor series, and the others follow from the downward recurrence, which is stable. On
    |z| ≥ 1 the recurrence is applied upward. The branch that is not selected is evaluated at a
    regular argument, so that derivatives remain finite.
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
    """Return (φ₀(Z), …, φ_order(Z)) of a square matrix of any norm, to the roundoff of Z.

    For ‖Z‖ ≤ 1 the method is that for numbers: a Taylor series for the highest order, and the
    downward recurrence for the others. A larger Z is halved s times, followed by s doublings

        φₖ(2Z) = 2⁻ᵏ (φ₀(Z)φₖ(Z) + Σⱼ φⱼ(Z)/(k − j)!),  j = 1, …, k

    (Skaflestad and Wright 2009), with E = φ₀ − 1 in place of φ₀, E(2Z) = E(Z)² + 2E(Z). This retains
    the accuracy of the slow modes of a stiff Z, whereas squaring φ₀ loses s bits.
    """
    eye = jnp.eye(z.shape[0], dtype=z.dtype)
    norm = lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(z), axis=0)))
    halvings = jnp.ceil(jnp.log2(jnp.where(norm > 1.0, norm, 1.0)))
    # The number is clipped: a non-finite Z gives non-finite results anyway.
    halvings = largest_of_lanes(jnp.clip(halvings, 0, math.prod(_LOOPS) - 1).astype(int))
    small = z * jnp.exp2(-halvings.astype(norm.dtype)).astype(z.dtype)

    top = max(order, 1)
    series = [1.0 / math.factorial(top + j) for j in range(_TERMS - 1, -1, -1)]
    weights = jnp.asarray(series, z.dtype)
    # Not unrolled, to limit compile time: a program contains several of these loops.
    taylor = lax.fori_loop(
        1, _TERMS, lambda j, sum_: _product(small, sum_) + weights[j] * eye, weights[0] * eye
    )
    down = [taylor]
    for k in range(top - 1, 0, -1):
        down.append(_product(small, down[-1]) + eye * (1.0 / math.factorial(k)))
    phis = tuple(reversed(down))

    def double(_: Any, carry: tuple[jax.Array, tuple[jax.Array, ...]]) -> Any:
        E, phis = carry
        new = []
        for k, phi in enumerate(phis, start=1):
            total = phi + _product(E, phi)
            for j in range(1, k + 1):
                total = total + phis[j - 1] / math.factorial(k - j)
            new.append(0.5**k * total)
        return _product(E, E) + 2.0 * E, tuple(new)

    start = (_product(small, phis[0]), phis)
    E, phis = bounded_while(halvings, double, start, 1, _LOOPS)
    return (eye + E, *phis)[: order + 1]


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the product of two square matrices, for small ones without a library call."""
    if len(a) <= _MAX_ROWS_UNROLLED:
        return functools.reduce(jnp.add, [a[:, k, None] * b[None, k] for k in range(len(a))])
    return jnp.sum(a[:, :, None] * b[None], axis=1) if len(a) <= _MAX_ROWS_BY_SUM else a @ b


def flow_factors(h: Any, phis: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    """Return (e^{hA}, h 0! φ₁, h 1! φ₂, …), the factors of x₀, c₀, c₁, … in a propagator."""
    return phis[0], *(h * math.factorial(j) * phi for j, phi in enumerate(phis[1:]))
