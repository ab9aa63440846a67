"""The law at rest: a variational inequality for the pressure alone."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from ... import _tree
from ...sets import Box
from ...spaces import L2
from ...vi import AbstractSolver, ActiveSet, VISolution, solve_vi

_SOFT = 300.0
"""From this βc₁ on a stiff law is approached from softer ones."""


class Equilibrium(eqx.Module):
    """A body at rest: the `pressure` on Γ_C, the `state` x, and the `vi` with its certificate,
    `vi.error_bound` ≥ ‖p − p*‖ in L²(Γ_C)."""

    pressure: jax.Array
    state: jax.Array
    vi: VISolution


class Law(NamedTuple):
    """0 ∈ p/β + TTᵀWp + g + N_[0,κ₀](p); β is divided by 1 + b_u already."""

    trace: jax.Array
    weights: jax.Array
    gap: jax.Array
    beta: jax.Array
    kappa0: jax.Array


def at_rest(law: Law, compliance: float, solver: AbstractSolver | None, tol: Any) -> VISolution:
    """The pressure to `tol`, relative to the largest that the gap could cause.

    Newton's method on active sets cycles where β‖C‖ is large and a cap holds many points: one step
    holds all, the next none. From the solution of a law softer by √10 it takes a few steps.
    """
    space, K = L2(law.weights), Box(0.0, law.kappa0)
    solver = ActiveSet(dense=4096) if solver is None else solver
    scale = jnp.minimum(law.kappa0, law.beta * jnp.maximum(jnp.max(-law.gap), 0.0))
    # Without contact any tolerance will do, but not 0.
    aim = tol * jnp.where(scale > 0, scale, 1.0)
    first, *others = (part * law.beta for part in _parts(law.beta, compliance))
    found = _solved(law._replace(beta=first), jnp.zeros_like(law.gap), K, solver, aim, space)
    for beta in others:
        found = _solved(law._replace(beta=beta), found.y, K, solver, aim, space)
    return found


def _solved(law: Law, guess: Any, K: Any, solver: Any, aim: Any, space: Any) -> VISolution:
    return solve_vi(_F, K, guess, law, solver, aim, gamma=1.0 / law.beta, space=space)


def _F(p: Any, law: Any) -> jax.Array:
    return p / law.beta + law.trace @ ((law.weights * p) @ law.trace) + law.gap


def _parts(beta: Any, compliance: float) -> list[float]:
    """Parts of β to go through, the last of them all. Of a β that is traced the size is not known; it
    is taken to be large."""
    stiff = float(beta) * compliance / _SOFT if _tree.is_concrete(beta) else 1e4
    count = max(0, math.ceil(2.0 * math.log10(max(stiff, 1.0))))
    return [10.0 ** (-k / 2) for k in range(count, -1, -1)]
