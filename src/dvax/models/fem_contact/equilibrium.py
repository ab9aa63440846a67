"""Static equilibrium: a variational inequality for the pressure."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from ... import _tree
from ...sets import Box
from ...spaces import L2
from ...vi import AbstractSolver, ActiveSet, VISolution, solve_vi

_DIRECT_STIFFNESS = 300.0
"""Up to this βc₁ the law is solved directly; beyond, by continuation from smaller β."""


class Equilibrium(eqx.Module):
    """A static equilibrium: the `pressure` on Γ_C, the `state` x, and the solution `vi`.

    `vi.error_bound` ≥ ‖p − p*‖ in L²(Γ_C) is its certificate.
    """

    pressure: jax.Array
    state: jax.Array
    vi: VISolution


class Law(NamedTuple):
    """The law 0 ∈ p/β + TTᵀWp + g + N_[0,κ₀](p), with `beta` = β/(1 + b_u)."""

    trace: jax.Array
    weights: jax.Array
    gap: jax.Array
    beta: jax.Array
    kappa0: jax.Array


def solve_equilibrium(
    law: Law, compliance: float, solver: AbstractSolver | None, tol: Any
) -> VISolution:
    """Return the pressure to `tol`, relative to the largest pressure that the gap could cause.

    If β‖C‖ is large and many points are at the cap, Newton's method on active sets cycles: all points
    are active after one step and none after the next. Continuation in β with the factor √10 needs a
    few steps for each β.
    """
    space, K = L2(law.weights), Box(0.0, law.kappa0)
    solver = ActiveSet(dense=4096) if solver is None else solver
    scale = jnp.minimum(law.kappa0, law.beta * jnp.maximum(jnp.max(-law.gap), 0.0))
    # Without contact the scale is 0; any positive tolerance is then sufficient.
    tol = tol * jnp.where(scale > 0, scale, 1.0)
    first, *others = (f * law.beta for f in _continuation_factors(law.beta, compliance))
    solution = _solve(law._replace(beta=first), jnp.zeros_like(law.gap), K, solver, tol, space)
    for beta in others:
        solution = _solve(law._replace(beta=beta), solution.y, K, solver, tol, space)
    return solution


def _solve(law: Law, guess: Any, K: Any, solver: Any, tol: Any, space: Any) -> VISolution:
    return solve_vi(_F, K, guess, law, solver, tol, gamma=1.0 / law.beta, space=space)


def _F(p: Any, law: Any) -> jax.Array:
    return p / law.beta + law.trace @ ((law.weights * p) @ law.trace) + law.gap


def _continuation_factors(beta: Any, compliance: float) -> list[float]:
    """Return the increasing factors of β for the continuation; the last is 1.

    A traced β is assumed to be large.
    """
    concrete = _tree.is_concrete(beta)
    stiffness_ratio = float(beta) * compliance / _DIRECT_STIFFNESS if concrete else 1e4
    count = max(0, math.ceil(2.0 * math.log10(max(stiffness_ratio, 1.0))))
    return [10.0 ** (-k / 2) for k in range(count, -1, -1)]
