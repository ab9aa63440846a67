"""The parameters that force the linearised equation v' = (A + Df̃)v + G by a G = ∂f̃/∂p of their own.

The steps that resolve x need not resolve G: where p is the amplitude of a wave and p = 0, nothing of
the wave is in x. So where a derivative in p is wanted, the steps resolve G as well (`TangentLimit`). A
G that does not depend on t explicitly, as that of a coefficient of x, changes as x does, and is not
looked at.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..programs.structure import independent
from .flow import Flow

Groups = tuple[tuple[int, ...], ...]
"""The numbers of parameters, as leaves of (problem, args), in groups that change together."""

_LARGEST_COUNT = 8
"""Largest number of groups, each of which costs a product with the derivative of f̃ at each sample."""


def groups(flow: Flow, t: Any, x: Tree, chosen: Sequence[bool] | None = None) -> Groups:
    """Return the parameters whose G depends on t explicitly, among the `chosen` ones (None: all)."""
    leaves, rebuild = _parts(flow)
    u = flow.problem.zero_control(x)

    def depends_on_time(k: int) -> bool:
        def change(t: Any) -> Tree:
            def values(leaf: Any) -> Tree:
                problem, args = rebuild([*leaves[:k], leaf, *leaves[k + 1 :]])
                data = eqx.filter(problem.set_at(t, args), eqx.is_inexact_array)
                return problem.f(t, x, u, args), problem.h(t, x, u, args), data

            return jax.jvp(values, (leaves[k],), (jnp.ones_like(leaves[k]),))[1]

        try:
            return not independent(change, t)
        except TypeError:
            return False  # code with a derivative in reverse alone

    real = [jnp.issubdtype(leaf.dtype, jnp.inexact) for leaf in leaves]
    wanted = [r and (chosen is None or chosen[k]) for k, r in enumerate(real)]
    found = [k for k in range(len(leaves)) if wanted[k] and depends_on_time(k)]
    alone, together = found[: _LARGEST_COUNT - 1], found[_LARGEST_COUNT - 1 :]
    return (*((k,) for k in alone), *([tuple(together)] if together else []))


def parameters(flow: Flow, chosen: Groups) -> list[Any]:
    """Return the arrays of these parameters, one after the other."""
    leaves, _ = _parts(flow)
    return [leaves[k] for group in chosen for k in group]


def with_parameters(flow: Flow, chosen: Groups, values: list[Any]) -> Flow:
    """Return the flow with other values of these parameters."""
    leaves, rebuild = _parts(flow)
    for k, value in zip((k for group in chosen for k in group), values, strict=True):
        leaves[k] = value
    problem, args = rebuild(leaves)
    return dataclasses.replace(flow, problem=problem, args=args, prepared=None)


def directions(flow: Flow, chosen: Groups, weights: jax.Array) -> list[jax.Array]:
    """Return changes of these parameters, those of each group with its weight. The entries of an array
    change by different amounts, so that their effects do not cancel."""
    leaves, _ = _parts(flow)
    found = []
    for group, weight in zip(chosen, weights, strict=True):
        for k in group:
            j = jnp.arange(leaves[k].size, dtype=leaves[k].dtype).reshape(leaves[k].shape)
            found.append(weight.astype(j.dtype) * jnp.cos(0.5 + j * (1.0 + 0.6180339887 * j)))
    return found


def _parts(flow: Flow) -> tuple[list[Any], Callable[[list[Any]], tuple[Any, Any]]]:
    """Return the arrays of the problem and of args, and how they make both."""
    arrays, static = eqx.partition((flow.problem, flow.args), eqx.is_array)
    leaves, tree = jtu.tree_flatten(arrays)
    return leaves, lambda leaves: eqx.combine(jtu.tree_unflatten(tree, leaves), static)
