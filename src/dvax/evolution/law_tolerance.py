"""The tolerance of the law, relative to the state, and the sizes that tolerances are relative to."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._tree import Tree
from ..spaces import AbstractSpace, Product
from .setup import Setup

_SHARE = 1e-3
"""Tolerance of the law in units of that of the defect."""

_FIXED_STEPS = 1e-12
"""Tolerance of the law with fixed steps, relative to the state."""


class RootMeanSquares(eqx.Module):
    """The root mean square of each part of a state: its norm over that of the constant 1.

    The weights of the space are arrays of the loop like all others: a function that closes over them
    would hide them from the transformations of the loop."""

    space: AbstractSpace

    def __call__(self, x: Tree) -> list[Any]:
        if isinstance(self.space, Product):
            return [_mean(s, part) for s, part in zip(self.space.spaces, x, strict=True)]
        return [_mean(self.space, x)]


class LawTolerance(eqx.Module):
    """The largest ‖w‖/γ, or ‖w‖, of a law that counts as solved: atol + rtol‖x‖.

    ‖x‖ is the root mean square of the state, of its smallest part where it has several. A law whose
    roundoff is larger is solved to roundoff (`FrozenVI.stops_at_roundoff`).
    """

    atol: Any
    rtol: Any
    sizes: RootMeanSquares

    def __call__(self, x: Tree) -> jax.Array:
        return self.atol + self.rtol * jnp.min(jnp.stack(self.sizes(x)))


def law_tolerance(setup: Setup) -> LawTolerance:
    """Return the tolerance of the law: a thousandth of that of the defect. Where it is known that an
    error of the law is multiplied by more than 1 in f̃, by β_f‖P⁻¹‖, it is divided by that."""
    share = _SHARE / jnp.maximum(1.0, setup.number("horizon"))
    if "law_gain" in setup.moduli:
        share = share / jnp.maximum(1.0, setup.moduli["law_gain"])
    has_fixed_steps = ~jnp.isnan(setup.number("dt"))
    atol = jnp.where(has_fixed_steps, 0.0, share * setup.number("atol"))
    rtol = jnp.where(has_fixed_steps, _FIXED_STEPS, share * setup.number("rtol"))
    return LawTolerance(atol, rtol, RootMeanSquares(setup.problem.spaces(setup.x0)[0]))


def _mean(space: AbstractSpace, part: Tree) -> Any:
    norm = space.norm(part)
    return norm / jnp.sqrt(space.size()).astype(norm.dtype)
