"""The responses of a solution, computed by a compiled program when they are first read."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._failure import nan_derivatives_where
from .._tree import Tree
from .after_run import after_run
from .plan import Plan
from .responses import Responses, responses
from .results import has_failed
from .setup import Setup


class Saved(NamedTuple):
    """The rows of a run: times, states, guesses for the law (None: zero), and the result of the run."""

    ts: jax.Array
    xs: Tree
    guesses: Tree | None
    result: Any


def saved_responses(setup: Setup, plan: Plan, rows: Saved) -> tuple[Responses, jax.Array]:
    """Return the responses of a run at its saved times, and the first of these times at which the run
    succeeded and its response is not finite (∞ if there is none).

    The arrays of a solution that left `equinox.filter_vmap` have the axes of the batch in front, and so
    have these.
    """
    # The response does not depend on the method.
    return after_run(_responses, setup._replace(method=None), plan, rows, rows.ts.ndim - 1)


def _responses(setup: Setup, plan: Plan, rows: Saved) -> tuple[Responses, jax.Array]:
    control = setup.problem.spaces(setup.x0)[1]
    saved = rows.ts, rows.xs, rows.guesses
    found = responses(plan.flow(setup), saved, control, setup.moduli)
    # Of a failed run, and of a law without a finite solution, all derivatives are NaN.
    finite = jax.vmap(_tree.all_finite)((found.us, found.law_residual))
    missing = ~finite & (rows.ts < jnp.inf)
    failed = has_failed(rows.result, rows.ts)
    given = eqx.filter((setup, rows), eqx.is_inexact_array)
    found = nan_derivatives_where(failed | jnp.any(missing), found, given)
    first = jnp.min(jnp.where(missing & ~failed, rows.ts, jnp.inf), initial=jnp.inf)
    return found, lax.stop_gradient(first)
