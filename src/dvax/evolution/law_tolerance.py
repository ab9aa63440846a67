"""The tolerance of the law from its effect on the state, and the sizes that tolerances refer to."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .._tree import Tree
from ..spaces import AbstractSpace, Product
from .setup import Setup

_SHARE = 1e-3
"""Tolerance of the law in units of that of the defect."""

_RELATIVE = 1e-2
"""Tolerance of the law relative to its own terms, in units of rtol."""

_FIXED_STEPS = 1e-12
"""The same with fixed steps."""


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
    """The largest ‖w‖/γ, or ‖w‖, of a law that counts as solved: (atol + rtol‖x‖)/gain.

    `atol` and `rtol` are those of the defect, times a small share. ‖x‖ is the root mean square of the
    state, of its smallest part where it has several. The gain is β_f‖P⁻¹‖ if it is known. Otherwise it
    is estimated, as the root mean square of the change of f along one direction of y at the guess, and
    1 if f does not change. Since such an estimate may be too small, ‖w‖ is also limited by `relative`
    times the size of its terms. No tolerance exceeds `most`.
    """

    atol: Any
    rtol: Any
    most: Any
    relative: Any
    gain: Any
    sizes: RootMeanSquares

    def __call__(self, x: Tree, effect: Callable[[Tree], Tree], like: Tree) -> jax.Array:
        """Return the tolerance at x, where `effect` is the derivative of f with respect to y = Pu."""
        gain = self.gain
        if gain is None:
            gain = jnp.max(jnp.stack(self.sizes(effect(one_direction(like)))))
        allowed = self.atol + self.rtol * jnp.min(jnp.stack(self.sizes(x)))
        tol = jnp.minimum(allowed / jnp.where(gain > 0.0, gain, 1.0), self.most)
        # Solvers that do not know the size of their terms need a limit that they can reach.
        return lax.stop_gradient(jnp.maximum(tol, 100 * jnp.finfo(tol.dtype).eps))


def law_tolerance(setup: Setup) -> LawTolerance:
    """Return the tolerance of the law: a thousandth of that of the defect, in its effect on f̃."""
    share = _SHARE / setup.number("horizon")
    has_fixed_steps = ~jnp.isnan(setup.number("dt"))
    sizes = RootMeanSquares(setup.problem.spaces(setup.x0)[0])
    return LawTolerance(
        atol=jnp.where(has_fixed_steps, jnp.inf, share * setup.number("atol")),
        rtol=jnp.where(has_fixed_steps, 0.0, share * setup.number("rtol")),
        most=jnp.where(has_fixed_steps, _FIXED_STEPS, jnp.inf),
        relative=jnp.where(has_fixed_steps, _FIXED_STEPS, _RELATIVE * setup.number("rtol")),
        gain=setup.moduli.get("law_gain"),
        sizes=sizes,
    )


def one_direction(like: Tree) -> Tree:
    """Return a fixed element of which neither sums nor differences of entries vanish."""

    def of_leaf(leaf: jax.Array) -> jax.Array:
        k = jnp.arange(leaf.size, dtype=leaf.dtype).reshape(leaf.shape)
        return 1.0 + jnp.cos(1.0 + 2.3 * k)

    return jtu.tree_map(of_leaf, like)


def _mean(space: AbstractSpace, part: Tree) -> Any:
    norm = space.norm(part)
    return norm / jnp.sqrt(space.size()).astype(norm.dtype)
