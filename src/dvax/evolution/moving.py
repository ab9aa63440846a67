"""Derivatives in time: of states at times that are differentiated themselves."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._batch import zeros_of_batch
from .._knots import END_ULPS, KNOT_ULPS
from .._tree import Tree
from .flow import Flow


def still(t: Any) -> Any:
    """t, as a number that nothing differentiates."""
    return jax.lax.stop_gradient(t)


@jax.custom_jvp
def shift(t: Any) -> Any:
    """0, which moves as t does."""
    return zeros_of_batch(t)


@shift.defjvp
def _(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    return shift(*primals), tangents[0]


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
        way = by(kept if is_zero(along[0]) else made)
        return jax.jvp(lambda real: way(real, other), (real,), (filled(along),))

    return found(real, other)


@jax.custom_jvp
def is_moving(t: Any) -> Any:
    """Whether t is differentiated, for a program that has two ways to the same values."""
    return jnp.asarray(False)


@partial(is_moving.defjvp, symbolic_zeros=True)
def _(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    return jnp.asarray(not is_zero(tangents[0])), np.zeros((), jax.dtypes.float0)


def moved(
    x: Tree, shift: Any, speed: Callable[..., Tree], t: Any, *given: Any, transposed: bool = False
) -> Tree:
    """x at t, carried along x' = speed(t, x, *given) to t + shift, for a shift whose value is 0 and
    whose derivatives are not: x itself, and nothing is computed, where nothing is differentiated.
    `speed` closes over no number.

    Derivatives of every order are those of the flow by forward mode; where the first is to be
    `transposed`, they are right up to the second, by forward over reverse.
    """
    real, rest = eqx.partition((t, given), eqx.is_inexact_array)
    other, static = eqx.partition(rest, eqx.is_array)

    def rate(s: Any, x: Tree, real: Any, other: Any) -> Tree:
        return speed(s, x, *eqx.combine(real, other, static)[1])

    return (_moved_back if transposed else _moved)(rate, x, shift, t, real, other)


def _moved(rate: Callable[..., Tree], *moving: Any) -> Tree:
    @jax.custom_jvp
    def same(x: Tree, shift: Any, t: Any, real: Any, other: Any) -> Tree:
        return x

    @partial(same.defjvp, symbolic_zeros=True)
    def rule(primals: tuple, tangents: tuple) -> tuple[Tree, Tree]:
        x, shift, t, real, other = primals
        along, by, later, turn, _ = tangents
        along, later, turn = map(filled, (along, later, turn))

        def both(s: Any, pair: tuple, given: Any, other: Any) -> tuple:
            """The flow with its variation: a tangent goes along with it."""
            real, later, turn = given
            own = lambda s, x, real: rate(s, x, real, other)  # noqa: E731
            return jax.jvp(own, (s, pair[0], real), (later, pair[1], turn))

        # The value by itself: JAX ≥ 0.12 has to know it without the tangents (`jax.linearize`).
        out = _moved(rate, *primals)
        _, along = _moved(both, (x, along), shift, t, (real, later, turn), other)
        if is_zero(by):
            return out, along
        return out, _plus(along, by, rate(t + shift, out, real, other))

    return same(*moving)


def _moved_back(rate: Callable[..., Tree], *moving: Any) -> Tree:
    """The same, to be transposed: x̄ goes back to x, ⟨x̄, x'⟩ to the shift, and what only a second
    derivative sees is not computed for a first."""

    @jax.custom_vjp
    def same(x: Tree, shift: Any, t: Any, real: Any, other: Any) -> Tree:
        return x

    def forward(*given: Any) -> Any:
        moves = _tree.Static(given[1].perturbed)
        _, *where = given = jtu.tree_map(lambda v: v.value, given, is_leaf=_is_primal)
        out = _moved(rate, *given)
        return out, (moves, out, *where)

    def backward(kept: Any, bar: Any) -> Any:
        moves, x, shift, t, real, other = kept
        bar = filled(bar)
        later, along, turn = _turned(rate, bar, shift, t, x, real, other)
        by = jnp.zeros_like(shift)
        if moves.value:
            found = rate(t + shift, x, real, other)
            rows = lambda b, r: jnp.sum((b * r).reshape(*shift.shape, -1), axis=-1)  # noqa: E731
            by = sum(jtu.tree_leaves(jtu.tree_map(rows, bar, found)))
        none = jtu.tree_map(lambda leaf: np.zeros(leaf.shape, jax.dtypes.float0), other)
        return _tree.add(bar, along), by, later, turn, none

    same.defvjp(forward, backward, symbolic_zeros=True)
    return same(*moving)


def _turned(rate: Callable[..., Tree], bar: Tree, shift: Any, *at: Any) -> Any:
    """shift · (∂rate(t, x, real))ᵀ x̄: 0, but for its derivative in the shift."""

    @jax.custom_jvp
    def nothing(none: Any, bar: Tree, shift: Any, t: Any, x: Tree, real: Any, other: Any) -> Any:
        return none

    @nothing.defjvp
    def rule(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
        none, bar, _, t, x, real, other = primals
        _, pull = jax.vjp(lambda t, x, real: rate(t, x, real, other), t, x, real)
        return none, pull(_plus(_tree.zeros_like(bar), tangents[2], bar))

    # Batched where x̄ is: a batched tangent is taken for a batched value alone.
    zero = sum(jnp.sum(jnp.where(leaf == leaf, 0.0, 0.0)) for leaf in jtu.tree_leaves(bar))
    t, x, real, _ = at
    none = jtu.tree_map(lambda leaf: jnp.full_like(leaf, zero), (t, x, real))
    return nothing(none, bar, shift, *at)


def _plus(x: Tree, by: Any, rate: Tree) -> Tree:
    """x + by · rate, with one number for x or one for each of its rows."""
    wide = lambda leaf: by.reshape(by.shape + (1,) * (leaf.ndim - by.ndim))  # noqa: E731
    return jtu.tree_map(lambda a, r: a + wide(r) * r, x, rate)


def velocity(flow: Flow, t: Any, x: Tree) -> Tree:
    """x' = Ax + f̃(t, x)."""
    return _tree.add(flow.generator.apply(x), flow.rate(t, x, flow.guess(x)).value)


def arriving(t: Any, x: Tree, flow: Flow, ends: tuple[Any, Any]) -> Tree:
    """x' at t as the run comes there, or at its beginning as it goes: data may jump at t."""
    begin, end = ends
    ulps = jnp.where((t <= begin) | (t >= end), END_ULPS, KNOT_ULPS)
    inset = ulps * jnp.finfo(t.dtype).eps * jnp.maximum(jnp.abs(t), jnp.abs(begin))
    return velocity(flow, t + still(jnp.where(t > begin, -inset, inset)), x)


def arrivals(ts: Any, xs: Tree, flow: Flow, ends: tuple[Any, Any]) -> Tree:
    """Those at several times."""
    return jax.vmap(lambda t, x: arriving(t, x, flow, ends))(ts, xs)


def filled(tangents: Any) -> Any:
    """With zeros in the place of those that JAX says are none."""
    real = lambda leaf: jnp.zeros(leaf.shape, leaf.dtype) if is_zero(leaf) else leaf  # noqa: E731
    return jtu.tree_map(real, tangents, is_leaf=is_zero)


def is_zero(leaf: Any) -> bool:
    return isinstance(leaf, jax.custom_derivatives.SymbolicZero)


def _is_primal(leaf: Any) -> bool:
    return isinstance(leaf, jax.custom_derivatives.CustomVJPPrimal)
