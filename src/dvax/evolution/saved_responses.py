"""The responses of a solution, computed by a compiled program when they are first read."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._failure import nan_derivatives_where
from .._jax.messages import is_equinox_check
from .._tree import Tree
from .plan import Plan
from .responses import Responses, responses
from .results import has_failed
from .setup import Setup, pack, unpack
from .signature import Signature, flatten

_SETTING = "t0", "dt", "rtol", "atol", "horizon"
"""The entries of `Setup.setting` that the tolerance of the law and its plan depend on."""


class Saved(NamedTuple):
    """The rows of a run: times, states, guesses for the law (None: zero), and the result of the run."""

    ts: jax.Array
    xs: Tree
    guesses: Tree | None
    result: Any


def saved_responses(setup: Setup, plan: Plan, rows: Saved) -> tuple[Responses, jax.Array]:
    """Return the responses of a run at its saved times, and the first of these times at which the run
    succeeded and its response is not finite (∞ if there is none).

    Concrete values are computed at once even inside a transformation of other values. The arrays of a
    solution that left `equinox.filter_vmap` have the axes of the batch in front, and so have these.
    """
    code = setup.problem, setup.vi_solver, plan
    setting = pack({name: setup.setting[name] for name in _SETTING})
    data = setup.x0, setup.args, setup.moduli, rows
    numbers, signature = flatten(code, data, rows.ts.ndim - 1)
    given = numbers, setting
    if not _tree.is_concrete(given):
        return _compiled(*given, signature)
    with jax.ensure_compile_time_eval():
        try:
            return _compiled(*given, signature)
        except jax.errors.JaxRuntimeError as error:
            if is_equinox_check(error):
                # Run again under Equinox, which reports the message of an `eqx.error_if` in f or h.
                eqx.filter_jit(_batched)(*given, signature)
            raise


def _batched(numbers: list[Any], setting: Any, signature: Signature) -> tuple[Responses, jax.Array]:
    """Return the responses of a batch, whose axes are in front of all arrays.

    Python floats, which no transformation has seen, have none: nor has a setting of these alone.
    """
    run, depth = partial(_responses, signature=signature), signature.options
    seen = numbers, setting if isinstance(setting, list) else None
    axes = jtu.tree_map(lambda leaf: 0 if jnp.ndim(leaf) >= depth else None, seen)
    for _ in range(depth):
        run = jax.vmap(run, in_axes=axes)
    return run(numbers, setting)


def _responses(
    numbers: list[Any], entries: Any, signature: Signature
) -> tuple[Responses, jax.Array]:
    (problem, vi_solver, plan), data = signature.unflatten(numbers)
    x0, args, moduli, rows = data
    setting = unpack(entries, _SETTING)
    # The response does not depend on the method.
    setup = Setup(problem, x0, args, setting, None, vi_solver, moduli)
    control = problem.spaces(x0)[1]
    saved = rows.ts, rows.xs, rows.guesses
    found = responses(plan.flow(setup), saved, control, moduli)
    # Of a failed run, and of a law without a finite solution, all derivatives are NaN.
    finite = jax.vmap(_tree.all_finite)((found.us, found.law_residual))
    missing = ~finite & (rows.ts < jnp.inf)
    failed = has_failed(rows.result, rows.ts)
    given = eqx.filter((setup, rows), eqx.is_inexact_array)
    found = nan_derivatives_where(failed | jnp.any(missing), found, given)
    first = jnp.min(jnp.where(missing & ~failed, rows.ts, jnp.inf), initial=jnp.inf)
    return found, lax.stop_gradient(first)


_compiled = jax.jit(_batched, static_argnums=2)
