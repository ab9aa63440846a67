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
from ..problem import KNOT_ULPS
from .flow import Flow


def still(t: Any) -> Any:
    """t, as a number that nothing differentiates."""
    return jax.lax.stop_gradient(t)


def if_moving(made: Callable[..., Any], kept: Callable[..., Any], t: Any, *given: Any) -> Any:
    """kept(t, *given), or made(t, *given), of the same value, where t is differentiated. Neither
    closes over a number."""
    real, rest = eqx.partition((t, given), eqx.is_inexact_array)
    other, static = eqx.partition(rest, eqx.is_array)

    def by(function: Callable[..., Any]) -> Callable[..., Any]:
        def whole(real: Any, other: Any) -> Any:
            t, given = eqx.combine(real, other, static)
            return function(t, *given)

        return whole

    found = jax.custom_jvp(by(kept))

    @partial(found.defjvp, symbolic_zeros=True)
    def rule(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
        (real, other), (along, _) = primals, tangents
        way = by(kept if _is_zero(along[0]) else made)
        return jax.jvp(lambda real: way(real, other), (real,), (_filled(along),))

    return found(real, other)


def moved(
    x: Tree, shift: Any, speed: Callable[..., Tree], t: Any, *given: Any, transposed: bool = False
) -> Tree:
    """x at t, carried along x' = speed(t, x, *given) to t + shift, for a shift whose value is 0 and
    whose derivatives are not: x itself, and nothing is computed, where nothing is differentiated.
    `speed` closes over no number.

    Derivatives of every order are those of the flow by forward mode. Where the first is to be
    `transposed`, no rule of its own survives that, and they are right up to the second.
    """
    real, rest = eqx.partition((t, given), eqx.is_inexact_array)
    other, static = eqx.partition(rest, eqx.is_array)

    def rate(s: Any, x: Tree, real: Any, other: Any) -> Tree:
        return speed(s, x, *eqx.combine(real, other, static)[1])

    return _moved(rate, transposed, x, shift, t, real, other)


def _moved(rate: Callable[..., Tree], transposed: bool, *moving: Any) -> Tree:
    @jax.custom_jvp
    def same(x: Tree, shift: Any, t: Any, real: Any, other: Any) -> Tree:
        return x

    @partial(same.defjvp, symbolic_zeros=True)
    def rule(primals: tuple, tangents: tuple) -> tuple[Tree, Tree]:
        x, shift, t, real, other = primals
        along, by, later, turn, _ = tangents
        along, later, turn = map(_filled, (along, later, turn))

        def both(s: Any, pair: tuple, given: Any, other: Any) -> tuple:
            """The flow with its variation: a tangent goes along with it."""
            real, later, turn = given
            own = lambda s, x, real: rate(s, x, real, other)  # noqa: E731
            return jax.jvp(own, (s, pair[0], real), (later, pair[1], turn))

        if transposed:
            out = same(x, shift, t, real, other)
            varied = both(t + shift, (out, along), (real, later, turn), other)[1]
            along = _plus(along, shift, varied)
        else:
            out, along = _moved(both, False, (x, along), shift, t, (real, later, turn), other)
        if _is_zero(by):
            return out, along
        return out, _plus(along, by, rate(t + shift, out, real, other))

    return same(*moving)


def _plus(x: Tree, by: Any, rate: Tree) -> Tree:
    """x + by · rate, with one number for x or one for each of its rows."""
    wide = lambda leaf: by.reshape(by.shape + (1,) * (leaf.ndim - by.ndim))  # noqa: E731
    return jtu.tree_map(lambda a, r: a + wide(r) * r, x, rate)


def velocity(flow: Flow, t: Any, x: Tree) -> Tree:
    """x' = Ax + f̃(t, x)."""
    return _tree.add(flow.generator.apply(x), flow.rate(t, x, flow.guess(x)).value)


def arriving(t: Any, x: Tree, flow: Flow, begin: Any) -> Tree:
    """x' at t as the run comes there, or at its beginning as it goes: data may jump at t."""
    ulp = jnp.finfo(t.dtype).eps * jnp.maximum(jnp.abs(t), jnp.abs(begin))
    inset = still(jnp.where(t > begin, -KNOT_ULPS * ulp, KNOT_ULPS * ulp))
    return velocity(flow, t + inset, x)


def arrivals(ts: Any, xs: Tree, flow: Flow, begin: Any) -> Tree:
    """Those at several times."""
    return jax.vmap(lambda t, x: arriving(t, x, flow, begin))(ts, xs)


def _filled(tangents: Any) -> Any:
    real = lambda leaf: jnp.zeros(leaf.shape, leaf.dtype) if _is_zero(leaf) else leaf  # noqa: E731
    return jtu.tree_map(real, tangents, is_leaf=_is_zero)


def _is_zero(leaf: Any) -> bool:
    return isinstance(leaf, jax.custom_derivatives.SymbolicZero)
