"""The traceable function from the arguments of a solve to its solution."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._failure import nan_derivatives_where
from .closures import closure_convert
from .event_arguments import checked_events
from .flow import Flow
from .implicit import Implicit
from .method import AbstractMethod
from .outcome import Outcome
from .picard import Picard, solve_by_windows
from .plan import Plan
from .responses import are_finite
from .results import RESULTS, has_failed, is_success
from .setup import Options, Setup
from .solution import Guesses, Solution
from .steps import by_steps


def integrate(setup: Setup, ts: Any, options: Options) -> tuple[Solution, bool]:
    """Return the solution, and whether functions of the problem close over traced values.

    If the run failed, the derivatives of the solution are NaN.
    """
    # Check shapes and knots while tracing, so that compiled calls do not pay for it.
    setup.problem.check(setup.number("t0"), setup.x0, setup.args)
    plan = Plan.of(setup)
    flow = plan.flow(setup)
    flow = dataclasses.replace(
        flow, problem=closure_convert(setup.problem, setup.number("t0"), setup.x0, flow.args)
    ).prepare(setup.number("t0"), setup.x0)
    valid = setup.is_valid(ts)
    events = checked_events(setup, flow.args)
    outcome = _run(setup._replace(events=events), flow, ts, valid, options)
    result = RESULTS.where(valid, outcome.result, RESULTS.invalid_number)
    solution = _solution(setup, plan, flow, outcome._replace(result=result))
    failed = has_failed(solution.result, solution.ts)
    # The setup is not an output of the compiled program.
    arrays, tree = jtu.tree_flatten(solution, is_leaf=lambda node: node is setup)
    assert arrays.pop() is setup
    given = eqx.filter((flow, setup, events, ts), eqx.is_inexact_array)
    arrays = nan_derivatives_where(failed, arrays, given)
    return tree.unflatten([*arrays, setup]), flow.problem is not setup.problem


def _run(setup: Setup, flow: Flow, ts: Any, valid: jax.Array, options: Options) -> Outcome:
    """Run the method from t0 over the knots of the data to t1."""
    method, t0, t1 = setup.method, setup.number("t0"), setup.number("t1")
    # If the numbers are invalid, t1 = NaN prevents all steps and saved times.
    t1 = jnp.where(valid, t1, jnp.nan)
    knots = jnp.asarray(setup.problem.knots(t0, t1, setup.x0, setup.args), setup.dtype)
    stops = jnp.concatenate([t0[None], knots, t1[None]])
    times = None if ts is None else jnp.where(valid, jnp.asarray(ts, setup.dtype), jnp.nan)
    if isinstance(method, Implicit):
        from .implicit_steps import solve_by_implicit_steps  # Diffrax is slow to import

        return solve_by_implicit_steps(setup, method, flow, stops, times, options)
    if isinstance(method, Picard):
        return solve_by_windows(setup, method, flow, stops, times, options)
    assert isinstance(method, AbstractMethod)  # PiecewiseLinear runs on the host
    return by_steps(setup, method, flow, stops, times, options)


def _solution(setup: Setup, plan: Plan, flow: Flow, outcome: Outcome) -> Solution:
    rows = outcome.rows
    # A non-finite response is a failure even if f does not depend on it. Rows behind a terminal event
    # are NaN.
    result = outcome.result
    skipped = (rows.t == jnp.inf) & (result == RESULTS.terminal_event)
    finite = jnp.all(are_finite(flow, (rows.t, rows.x, rows.guess)) | skipped)
    result = RESULTS.where(is_success(result) & ~finite, RESULTS.nonfinite, result)
    return Solution(
        ts=rows.t,
        xs=rows.x,
        law=Guesses(rows.guess),
        defect=None if rows.integrated_defect is None else rows.integrated_defect[0],
        law_defect=None if rows.integrated_defect is None else rows.integrated_defect[1],
        completed_defect=rows.completed_defect,
        bounds=rows.bounds,
        stats=outcome.stats,
        result=result,
        records=outcome.records,
        events=outcome.events,
        enclosed=flow.enclosed,
        plan=plan,
        setup=setup,
    )
