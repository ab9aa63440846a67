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
from .._batch import zeros_like_lanes
from .._knots import END_ULPS, KNOT_ULPS
from .._tree import Tree
from .flow import Flow


@jax.custom_jvp
def zero_with_tangent(t: Any) -> Any:
    """Return zero with the tangent of t."""
    return zeros_like_lanes(t)


@zero_with_tangent.defjvp
def _(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    return zero_with_tangent(*primals), tangents[0]


def select_if_differentiated(
    differentiated: Callable[..., Any], plain: Callable[..., Any], t: Any, *given: Any
) -> Any:
    """Return plain(t, *given), or differentiated(t, *given) where t is differentiated. Both have the
    same value, and neither closes over an array."""
    real, rest = eqx.partition((t, given), eqx.is_inexact_array)
    other, static = eqx.partition(rest, eqx.is_array)

    def by(function: Callable[..., Any]) -> Callable[..., Any]:
        def whole(real: Any, other: Any) -> Any:
            t, given = eqx.combine(real, other, static)
            return function(t, *given)

        return whole

    found = jax.custom_jvp(by(plain))

    @partial(found.defjvp, symbolic_zeros=True)
    def rule(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
        (real, other), (along, _) = primals, tangents
        way = by(plain if is_zero(along[0]) else differentiated)
        return jax.jvp(lambda real: way(real, other), (real,), (instantiate_zeros(along),))

    return found(real, other)


@jax.custom_jvp
def is_differentiated(t: Any) -> Any:
    """Return whether t is differentiated, for a program that has two ways to the same values."""
    return jnp.asarray(False)


@partial(is_differentiated.defjvp, symbolic_zeros=True)
def _(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    return jnp.asarray(not is_zero(tangents[0])), np.zeros((), jax.dtypes.float0)


def transport(
    x: Tree, shift: Any, speed: Callable[..., Tree], t: Any, *given: Any, transposed: bool = False
) -> Tree:
    """Transport x from t along x' = speed(t, x, *given) to t + shift, for a shift whose value is zero
    and whose tangent is not. The value is x, and where nothing is differentiated nothing is computed.
    `speed` closes over no array.

    Derivatives of every order are those of the flow by forward mode; where the first is to be
    `transposed`, they are right up to the second, by forward over reverse.
    """
    real, rest = eqx.partition((t, given), eqx.is_inexact_array)
    other, static = eqx.partition(rest, eqx.is_array)

    def rate(s: Any, x: Tree, real: Any, other: Any) -> Tree:
        return speed(s, x, *eqx.combine(real, other, static)[1])

    return (_transport_transposed if transposed else _transport)(rate, x, shift, t, real, other)


def _transport(rate: Callable[..., Tree], *moving: Any) -> Tree:
    @jax.custom_jvp
    def same(x: Tree, shift: Any, t: Any, real: Any, other: Any) -> Tree:
        return x

    @partial(same.defjvp, symbolic_zeros=True)
    def rule(primals: tuple, tangents: tuple) -> tuple[Tree, Tree]:
        x, shift, t, real, other = primals
        along, by, later, turn, _ = tangents
        along, later, turn = map(instantiate_zeros, (along, later, turn))

        def both(s: Any, pair: tuple, given: Any, other: Any) -> tuple:
            """The flow with its variation: a tangent goes along with it."""
            real, later, turn = given
            own = lambda s, x, real: rate(s, x, real, other)  # noqa: E731
            return jax.jvp(own, (s, pair[0], real), (later, pair[1], turn))

        # The value by itself: JAX ≥ 0.12 has to know it without the tangents (`jax.linearize`).
        out = _transport(rate, *primals)
        _, along = _transport(both, (x, along), shift, t, (real, later, turn), other)
        if is_zero(by):
            return out, along
        return out, _plus(along, by, rate(t + shift, out, real, other))

    return same(*moving)


def _transport_transposed(rate: Callable[..., Tree], *moving: Any) -> Tree:
    """The same with a transposable first derivative: x̄ is the cotangent of x, ⟨x̄, x'⟩ that of the
    shift. Terms that only second derivatives contain are not computed for a first one."""

    @jax.custom_vjp
    def same(x: Tree, shift: Any, t: Any, real: Any, other: Any) -> Tree:
        return x

    def forward(*given: Any) -> Any:
        moves = _tree.Static(given[1].perturbed)
        _, *where = given = jtu.tree_map(lambda v: v.value, given, is_leaf=_is_primal)
        out = _transport(rate, *given)
        return out, (moves, out, *where)

    def backward(kept: Any, bar: Any) -> Any:
        moves, x, shift, t, real, other = kept
        bar = instantiate_zeros(bar)
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
    """Return shift · (∂rate(t, x, real))ᵀ x̄: zero, with its derivative in the shift."""

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
    """Return x + by · rate, with one number for x or one for each of its rows."""
    wide = lambda leaf: by.reshape(by.shape + (1,) * (leaf.ndim - by.ndim))  # noqa: E731
    return jtu.tree_map(lambda a, r: a + wide(r) * r, x, rate)


def velocity(flow: Flow, t: Any, x: Tree) -> Tree:
    """Return x' = Ax + f̃(t, x)."""
    return _tree.add(flow.generator.apply(x), flow.rate(t, x, flow.guess(x)).value)


def left_derivative(t: Any, x: Tree, flow: Flow, ends: tuple[Any, Any]) -> Tree:
    """Return x' just before t, or just after the start of the run: data may jump at t."""
    begin, end = ends
    ulps = jnp.where((t <= begin) | (t >= end), END_ULPS, KNOT_ULPS)
    inset = ulps * jnp.finfo(t.dtype).eps * jnp.maximum(jnp.abs(t), jnp.abs(begin))
    return velocity(flow, t + jax.lax.stop_gradient(jnp.where(t > begin, -inset, inset)), x)


def left_derivatives(ts: Any, xs: Tree, flow: Flow, ends: tuple[Any, Any]) -> Tree:
    """Return the left derivatives at several times."""
    return jax.vmap(lambda t, x: left_derivative(t, x, flow, ends))(ts, xs)


def instantiate_zeros(tangents: Any) -> Any:
    """Replace symbolic zeros by arrays."""
    real = lambda leaf: jnp.zeros(leaf.shape, leaf.dtype) if is_zero(leaf) else leaf  # noqa: E731
    return jtu.tree_map(real, tangents, is_leaf=is_zero)


def is_zero(leaf: Any) -> bool:
    return isinstance(leaf, jax.custom_derivatives.SymbolicZero)


def _is_primal(leaf: Any) -> bool:
    return isinstance(leaf, jax.custom_derivatives.CustomVJPPrimal)
