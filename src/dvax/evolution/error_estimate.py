"""An estimate e of the error of x that goes along with the steps.

The computed trajectory solves x_h' = Ax_h + p, so that e = x − x_h solves e' = (A + Df̃)e + δ to first
order, with δ = f̃(·, x_h) − p. A step from t₀ takes e to

    e₁ = e^{hA}(e + ¼hBe) + ∫ δ,   B = Df̃(t₀, x₀),

or with A + Df̃ in the place of A and no B for a method that linearises, and with A + Df̃ in the place of
B and no A for one that is explicit in A. On the negative axis 1 + ¼z is above e^z for z ≥ −3.9 and
stable for z ≥ −8, where the methods are: no part of e is taken to decay faster than the error does. Be
is a difference quotient, from an evaluation of f̃ next to x₀.

The entries of ∫ δ are added with the signs of those of e: e turns less than the error does, and would
cancel where the error adds up.

Only a decay within one regime, by a step that is far from the limit of stability, counts
(`ErrorTest` says what for): e is no bound.
"""

from typing import Any

import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace


def probe(space: AbstractSpace, h: Any, x0: Tree, e: Tree, here: Tree) -> Tree:
    """Return a state next to x₀ in the direction of e; f̃ at x₀ is `here`."""
    return lax.stop_gradient(_tree.add(x0, _tree.scale(_factor(space, h, x0, e, here), e)))


def with_decay(space: AbstractSpace, h: Any, x0: Tree, e: Tree, there: Tree, here: Tree) -> Tree:
    """Return e + ¼hBe from the values of f̃ at the probe and at x₀."""
    factor = _factor(space, h, x0, e, here)
    share = jnp.where(factor > 0, 0.25 * h / jnp.where(factor > 0, factor, 1.0), 0.0)
    return _tree.add(e, _tree.scale(share, _tree.sub(there, here)))


def counted(e: Tree, left: Tree, kinked: Any, slope: Any) -> Tree:
    """Return what is taken to be left of e: all of it where the step is `kinked`, and where `slope`, h
    times the slope of what the method treats explicitly (None: nothing), is above 2."""
    share = jnp.where(kinked, 0.0, 1.0)
    if slope is not None:
        share *= jnp.where(jnp.isfinite(slope), jnp.clip(2.0 - slope, 0.0, 1.0), 1.0)
    return _tree.add(_tree.scale(share, left), _tree.scale(1.0 - share, e))


def finite_or_zero(e: Tree) -> Tree:
    """Return e, or zero if an entry is not finite: then nothing is known to decay."""
    return _tree.where(_tree.all_finite(e), e, _tree.zeros_like(e))


def _factor(space: AbstractSpace, h: Any, x0: Tree, e: Tree, here: Tree) -> Any:
    """Return the factor that makes e as long as a difference quotient needs."""
    size, length = space.norm(x0) + h * space.norm(here), space.norm(e)
    scale = jnp.sqrt(jnp.finfo(length.dtype).eps) * size
    return jnp.where(length > 0, scale / jnp.where(length > 0, length, 1.0), 0.0)
