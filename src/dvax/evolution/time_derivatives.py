"""Derivatives in time: of states at times that are differentiated themselves.

The end of a step that meets a stop carries the tangent of that stop, and the step is differentiated
as it was computed; all other ends of adaptive steps are constants. What is left to do is done at the
saved times: `transport` moves a state from the end of its step to a saved time of the same value and
another tangent.
"""

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


@jax.custom_jvp
def is_differentiated(t: Any) -> Any:
    """Return whether t is differentiated, for a program that has two ways to the same values."""
    return jnp.asarray(False)


@partial(is_differentiated.defjvp, symbolic_zeros=True)
def _(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    return jnp.asarray(not is_zero(tangents[0])), np.zeros((), jax.dtypes.float0)


def transport(x: Tree, shift: Any, rate: Callable[..., Tree], t: Any, *given: Any) -> Tree:
    """Transport x from t along x' = rate(t, x, *given) to t + shift, for a shift whose value is zero
    and whose tangent is not.

    The value is x, and where the shift is not differentiated nothing is computed. The derivatives are
    those of one step of the midpoint rule of length `shift`: at length zero its first and second
    derivatives are those of the flow. `rate` closes over no array.
    """
    real, rest = eqx.partition((t, given), eqx.is_inexact_array)
    other, static = eqx.partition(rest, eqx.is_array)

    @jax.custom_jvp
    def same(x: Tree, shift: Any, real: Any, other: Any) -> Tree:
        return x

    @partial(same.defjvp, symbolic_zeros=True)
    def rule(primals: tuple, tangents: tuple) -> tuple[Tree, Tree]:
        *args, other = primals
        along = tuple(map(instantiate_zeros, tangents[:-1]))
        if is_zero(tangents[1]):
            return same(*primals), along[0]

        def shifted(x: Tree, shift: Any, real: Any) -> Tree:
            t, given = eqx.combine(real, other, static)
            return midpoint(x, shift, rate, t, *given)

        return same(*primals), jax.jvp(shifted, tuple(args), along)[1]

    return same(x, shift, real, other)


def midpoint(x: Tree, shift: Any, rate: Callable[..., Tree], t: Any, *given: Any) -> Tree:
    """Return x at t + shift along x' = rate(t, x, *given), by one step of the midpoint rule from t."""
    middle = _plus(x, 0.5 * shift, rate(t, x, *given))
    return _plus(x, shift, rate(t + 0.5 * shift, middle, *given))


def velocity(t: Any, x: Tree, flow: Flow) -> Tree:
    """Return x' = Ax + f̃(t, x)."""
    return _tree.add(flow.generator.apply(x), flow.rate(t, x, flow.guess(x)).value)


def _plus(x: Tree, by: Any, rate: Tree) -> Tree:
    """Return x + by · rate, with one number for x or one for each of its rows."""

    def one(a: Any, r: Any) -> Any:
        return a + by.reshape(by.shape + (1,) * (a.ndim - by.ndim)) * r

    return jtu.tree_map(one, x, rate)


def left_derivatives(ts: Any, xs: Tree, flow: Flow, ends: tuple[Any, Any]) -> Tree:
    """Return x' = Ax + f̃(t, x) just before each of several times, or just after the start of the run:
    data may jump at these times."""

    def left_derivative(t: Any, x: Tree) -> Tree:
        begin, end = ends
        ulps = jnp.where((t <= begin) | (t >= end), END_ULPS, KNOT_ULPS)
        inset = ulps * jnp.finfo(t.dtype).eps * jnp.maximum(jnp.abs(t), jnp.abs(begin))
        t = t + jax.lax.stop_gradient(jnp.where(t > begin, -inset, inset))
        return velocity(t, x, flow)

    return jax.vmap(left_derivative)(ts, xs)


def instantiate_zeros(tangents: Any) -> Any:
    """Replace symbolic zeros by arrays."""

    def real(leaf: Any) -> Any:
        return jnp.zeros(leaf.shape, leaf.dtype) if is_zero(leaf) else leaf

    return jtu.tree_map(real, tangents, is_leaf=is_zero)


def is_zero(leaf: Any) -> bool:
    """Return whether a tangent is a symbolic zero."""
    return isinstance(leaf, jax.custom_derivatives.SymbolicZero)
