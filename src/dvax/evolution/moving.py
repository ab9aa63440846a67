"""Derivatives in time: of states at times that are differentiated themselves."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from .flow import Flow


def still(t: Any) -> Any:
    """t, as a number that nothing differentiates."""
    return jax.lax.stop_gradient(t)


def moved(x: Tree, shift: Any, speed: Callable[..., Tree], *given: Any) -> Tree:
    """x + shift · speed(*given) for a shift whose value is 0 and whose derivative is not: x itself,
    and nothing is computed, where nothing is differentiated. `speed` closes over no number."""
    dynamic, static = eqx.partition(given, eqx.is_array)

    @jax.custom_jvp
    def same(x: Tree, shift: Any, dynamic: Any) -> Tree:
        return x

    @partial(same.defjvp, symbolic_zeros=True)
    def rule(primals: tuple, tangents: tuple) -> tuple[Tree, Tree]:
        x, _, dynamic = primals
        along, by, _ = tangents
        along = jtu.tree_map(lambda leaf: jnp.zeros_like(leaf) if _is_zero(leaf) else leaf, along,
                             is_leaf=_is_zero)  # fmt: skip
        if _is_zero(by):
            return x, along
        rate = speed(*eqx.combine(dynamic, static))
        return x, jtu.tree_map(
            lambda a, r: a + r * by.reshape(by.shape + (1,) * (r.ndim - by.ndim)), along, rate
        )

    return same(x, shift, dynamic)


def velocity(flow: Flow, t: Any, x: Tree) -> Tree:
    """x' = Ax + f̃(t, x)."""
    return _tree.add(flow.generator.apply(x), flow.rate(t, x, flow.guess(x)).value)


def velocities(flow: Flow, ts: Any, xs: Tree) -> Tree:
    """Those at several times."""
    return jax.vmap(lambda t, x: velocity(flow, t, x))(ts, xs)


def _is_zero(leaf: Any) -> bool:
    return isinstance(leaf, jax.custom_derivatives.SymbolicZero)
