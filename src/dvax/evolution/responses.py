"""The responses at the saved times, with their certificates.

The program of a run only checks that they are finite. `Responses` are computed by a program of their
own when a field of the solution is read (`saved_responses.py`), since each evaluation site of a law
that is solved by iteration takes about as long to compile as the steps.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._jax import outlined
from .._tree import Tree
from ..vi import certify
from .flow import Flow

_MAX_BATCHED_STATE = 4096
"""Largest number of entries of the state for which iterative laws are solved at all saved times at
once. Beyond it, solving them one after the other saves memory, and each solve stops by itself."""

Rows = tuple[jax.Array, Tree, Tree | None]
"""Times, states, and initial guesses for the solver of the law (None: zero)."""


class Responses(NamedTuple):
    """Rows of u, y = P u, ‖w‖, ‖ȳ − y‖ and the bound C0 on the error of u (None without constants)."""

    us: Tree
    ys: Tree
    law_residual: Any
    law_step: Any
    law_error: Any


def responses(flow: Flow, rows: Rows, control: Any, moduli: dict[str, Any]) -> Responses:
    """Return the responses at the saved states."""
    gamma, norm_P_inv = moduli.get("gamma"), moduli.get("norm_P_inv")
    tau = 1.0 if moduli.get("L_F") is None else 1.0 / moduli["L_F"]
    run = partial(_response, flow, control, tau)
    us, ys, w, projection_step = _at_rows(flow, rows, run, jnp.nan)
    residual, step = jax.vmap(control.norm)(w), jax.vmap(control.norm)(projection_step)
    error = None
    if gamma is not None and norm_P_inv is not None:
        error = norm_P_inv * (residual / gamma + step)
    return Responses(us, ys, residual, step, error)


def are_finite(flow: Flow, rows: Rows) -> jax.Array:
    """Return, for each saved state, whether its response is finite.

    A law that is solved by iteration is not solved if the steps left a guess: F must be finite at the
    projection of the guess, where its solver starts.
    """
    return _at_rows(flow, rows, partial(_is_finite, flow), False)


def _at_rows(flow: Flow, rows: Rows, run: Any, missing: Any) -> Any:
    """Return run(t, x, guess) for each row, or the value `missing` if no row was reached."""
    times, xs, _ = rows
    entries = sum(leaf.size for leaf in jtu.tree_leaves(xs))

    def solve() -> Any:
        is_batched = flow.direct or entries <= _MAX_BATCHED_STATE * len(times)
        return outlined(_batched if is_batched else _sequential, run, large=rows)

    def skip() -> Any:
        full = lambda s: jnp.full(s.shape, missing, s.dtype)  # noqa: E731
        return jtu.tree_map(full, jax.eval_shape(solve))

    if not len(times):
        return skip()
    # The condition prevents XLA from fusing the law into the sums of the norms, which costs a factor
    # of twenty for a large state.
    return lax.cond(times[0] < jnp.inf, solve, skip)


def _batched(run: Any, times: Any, xs: Tree, guesses: Tree | None) -> Any:
    if len(times) == 1:
        row = jtu.tree_map(lambda leaf: leaf[0], (times, xs, guesses))
        return jtu.tree_map(lambda leaf: leaf[None], run(*row))
    return jax.vmap(run)(times, xs, guesses)


def _sequential(run: Any, times: Any, xs: Tree, guesses: Tree | None) -> Any:
    return lax.map(lambda row: run(*row), (times, xs, guesses))


def _response(flow: Flow, control: Any, tau: Any, t: Any, x: Tree, guess: Tree | None) -> Any:
    """Return u, y, w and ȳ − y at one time."""
    rate = flow.rate(t, x, guess)
    K = flow.set_at(t)
    frozen = flow.problem.frozen(t, x, flow.args)
    certificate = certify(frozen, K, control, rate.y, tau)
    return flow.operator.inverse(rate.y), rate.y, certificate.w, _tree.sub(certificate.y, rate.y)


def _is_finite(flow: Flow, t: Any, x: Tree, guess: Tree | None) -> jax.Array:
    problem, args = flow.problem, flow.args
    if guess is None:
        return _tree.all_finite(flow.rate(t, x, guess).y)
    y = flow.set_at(t).project(guess, problem.spaces(x)[1])
    return _tree.all_finite((guess, problem.frozen(t, x, args)(y)))
