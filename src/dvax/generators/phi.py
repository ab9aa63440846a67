"""The φ-functions of a number and of a matrix."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .._batch import largest_of_lanes
from .turns import turns

_TERMS = 20  # of the Taylor series on |z| < 1: 1/20! is below double rounding
_FEW = 8  # rows, up to which a call of a library costs more than a product
_VERY_FEW = 3  # rows, up to which terms are added as they stand, not by a function of XLA's
_LEVELS = 3  # 4³ halvings at most: norms up to 10¹⁹


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
    """(φ₀(Z), …, φ_order(Z)) of a square matrix of any norm, to the rounding that Z itself has.

    On ‖Z‖ ≤ 1 as for a number: the highest one as a Taylor series, the others by the recurrence read
    downward. A larger Z is halved s times, and then

        φₖ(2Z) = 2⁻ᵏ (φ₀(Z)φₖ(Z) + Σⱼ φⱼ(Z)/(k − j)!),  j = 1, …, k

    (Skaflestad and Wright 2009), with E = φ₀ − 1 in the place of φ₀, E(2Z) = E(Z)² + 2E(Z): what is
    slow in a stiff Z keeps its digits, of which squaring φ₀ loses s binary ones.
    """
    eye = jnp.eye(z.shape[0], dtype=z.dtype)
    norm = lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(z), axis=0)))
    halvings = jnp.ceil(jnp.log2(jnp.where(norm > 1.0, norm, 1.0)))
    # What is not finite stays so; a norm near overflow is no generator's.
    halvings = largest_of_lanes(jnp.clip(halvings, 0, 4**_LEVELS - 1).astype(int))
    small = z * jnp.exp2(-halvings.astype(norm.dtype)).astype(z.dtype)

    top = max(order, 1)
    series = [1.0 / math.factorial(top + j) for j in range(_TERMS - 1, -1, -1)]
    weights = jnp.asarray(series, z.dtype)
    # A loop and not its turns: a program holds several of these, and all are compiled.
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

    E, phis = turns(halvings, double, (_product(small, phis[0]), phis), 1, (4,) * _LEVELS)
    return (eye + E, *phis)[: order + 1]


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    """That of two square matrices; of few numbers term by term, without a call of a library."""
    if len(a) <= _VERY_FEW:
        return functools.reduce(jnp.add, [a[:, k, None] * b[None, k] for k in range(len(a))])
    return jnp.sum(a[:, :, None] * b[None], axis=1) if len(a) <= _FEW else a @ b


def flow_factors(h: Any, phis: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    """(e^{hA}, h 0! φ₁, h 1! φ₂, …): what a propagator multiplies x₀, c₀, c₁, … by."""
    return phis[0], *(h * math.factorial(j) * phi for j, phi in enumerate(phis[1:]))
