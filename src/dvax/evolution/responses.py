"""The responses at the saved times, with their certificates."""

from functools import partial

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._jax import outlined
from ..vi import certify

_IN_TURN = 4096
"""Entries of the state from which laws that are solved by iteration are solved one saved time after
the other: each then stops at its own iteration, with the memory of one."""


def responses(flow, rows, control, moduli):
    """u, y and the certificate C0 of the law at the saved states, `rows` being times, states and where
    the solver of the law begins."""
    gamma, norm_P_inv = moduli.get("gamma"), moduli.get("norm_P_inv")
    tau = 1.0 if moduli.get("L_F") is None else 1.0 / moduli["L_F"]

    times, xs, _ = rows
    entries = sum(leaf.size for leaf in jtu.tree_leaves(xs))

    def every():
        respond = _at_once if flow.direct or entries <= _IN_TURN * len(times) else _in_turn
        return outlined(respond, flow, control, tau, large=rows)

    def nothing():
        return jtu.tree_map(lambda s: jnp.full(s.shape, jnp.nan, s.dtype), jax.eval_shape(every))

    # Whether anything was saved is never in doubt, but the compiler does not know that: it would
    # draw all of the above into the sums of the norms, at twenty times the cost for a large state.
    us, ys, w, apart = lax.cond(times[0] < jnp.inf, every, nothing)
    residual, step = jax.vmap(control.norm)(w), jax.vmap(control.norm)(apart)
    error = None
    if gamma is not None and norm_P_inv is not None:
        error = norm_P_inv * (residual / gamma + step)
    return us, ys, residual, step, error


def _at_once(flow, control, tau, times, xs, guesses):
    if len(times) == 1:
        rows = jtu.tree_map(lambda leaf: leaf[0], (times, xs, guesses))
        return jtu.tree_map(lambda leaf: leaf[None], _response(flow, control, tau, *rows))
    return jax.vmap(partial(_response, flow, control, tau))(times, xs, guesses)


def _in_turn(flow, control, tau, times, xs, guesses):
    return lax.map(lambda row: _response(flow, control, tau, *row), (times, xs, guesses))


def _response(flow, control, tau, t, x, guess):
    """u, y, and what certifies it."""
    rate = flow.rate(t, x, guess)
    K = flow.problem.set_at(t, flow.args)
    frozen = flow.problem.frozen(t, x, flow.args)
    checked = certify(frozen, K, control, rate.y, tau)
    return flow.operator.inverse(rate.y), rate.y, checked.w, _tree.sub(checked.y, rate.y)
