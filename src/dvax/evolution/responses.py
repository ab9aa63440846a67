"""The responses at the saved times, with their certificates."""

from functools import partial

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._jax import outlined
from ..vi import certify

_MAX_BATCHED_STATE = 4096
"""Largest number of entries of the state for which iterative laws are solved at all saved times at
once. Beyond it, solving them one after the other saves memory, and each solve stops by itself."""


def responses(flow, rows, control, moduli):
    """Return u, y, ‖w‖, ‖ȳ − y‖ and the bound C0 on the error of u at the saved states.

    `rows` = (times, states, initial guesses for the solver of the law).
    """
    gamma, norm_P_inv = moduli.get("gamma"), moduli.get("norm_P_inv")
    tau = 1.0 if moduli.get("L_F") is None else 1.0 / moduli["L_F"]

    times, xs, _ = rows
    entries = sum(leaf.size for leaf in jtu.tree_leaves(xs))

    def solve():
        is_batched = flow.direct or entries <= _MAX_BATCHED_STATE * len(times)
        return outlined(_batched if is_batched else _sequential, flow, control, tau, large=rows)

    def nan():
        return jtu.tree_map(lambda s: jnp.full(s.shape, jnp.nan, s.dtype), jax.eval_shape(solve))

    # The condition prevents XLA from fusing the law into the sums of the norms, which costs a factor
    # of twenty for a large state.
    us, ys, w, projection_step = lax.cond(times[0] < jnp.inf, solve, nan)
    residual, step = jax.vmap(control.norm)(w), jax.vmap(control.norm)(projection_step)
    error = None
    if gamma is not None and norm_P_inv is not None:
        error = norm_P_inv * (residual / gamma + step)
    return us, ys, residual, step, error


def _batched(flow, control, tau, times, xs, guesses):
    if len(times) == 1:
        rows = jtu.tree_map(lambda leaf: leaf[0], (times, xs, guesses))
        return jtu.tree_map(lambda leaf: leaf[None], _response(flow, control, tau, *rows))
    return jax.vmap(partial(_response, flow, control, tau))(times, xs, guesses)


def _sequential(flow, control, tau, times, xs, guesses):
    return lax.map(lambda row: _response(flow, control, tau, *row), (times, xs, guesses))


def _response(flow, control, tau, t, x, guess):
    """Return u, y, w and ȳ − y at one time."""
    rate = flow.rate(t, x, guess)
    K = flow.problem.set_at(t, flow.args)
    frozen = flow.problem.frozen(t, x, flow.args)
    certificate = certify(frozen, K, control, rate.y, tau)
    return flow.operator.inverse(rate.y), rate.y, certificate.w, _tree.sub(certificate.y, rate.y)
