"""A function from a setup to its solution, to be compiled as a whole."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._failure import nan_derivatives_where
from .._jax import forward_only, outlined
from ..vi import certify
from . import excursions, implicit, picard, reverse
from .closures import closure_convert
from .control import (
    AbstractController,
    Adaptive,
    ErrorTest,
    Fixed,
    root_mean_squares,
    step_count,
)
from .flow import Flow
from .implicit import Implicit
from .loop import Loop, Record, Saved, State
from .method import ETD2RK, AbstractMethod
from .picard import Picard
from .results import RESULTS
from .setup import Setup
from .solution import Solution
from .stepper import Stepper
from .time_derivatives import left_derivative, left_derivatives, transport, zero_with_tangent


class Options(NamedTuple):
    """What a time loop is compiled for, apart from shapes; see `dvax.solve`."""

    fixed: bool
    measure: bool
    track_bounds: bool
    check_finite: bool
    dense: bool
    max_steps: int
    adjoint: str
    progress: bool


def integrate(setup: Setup, ts: Any, options: Options) -> Solution:
    """The solution; where it failed, NaN is its derivative with respect to everything real."""
    # Shapes and knots are looked at here, while tracing: a call that is compiled pays nothing.
    setup.problem.check(setup.number("t0"), setup.x0, setup.args)
    flow = setup.flow()
    flow = dataclasses.replace(
        flow, problem=closure_convert(setup.problem, setup.number("t0"), setup.x0, flow.args)
    )
    valid = setup.is_valid(ts)
    solution = _solved(setup, flow, ts, valid, options)
    result = RESULTS.where(valid, solution.result, RESULTS.invalid_number)
    solution = dataclasses.replace(solution, result=result)
    failed = (solution.result != RESULTS.successful) | ~jnp.all(solution.ts < jnp.inf)
    # The setup is what was asked: it is no output.
    arrays, tree = jtu.tree_flatten(solution, is_leaf=lambda node: node is setup)
    assert arrays.pop() is setup
    given = eqx.filter((flow, setup, ts), eqx.is_inexact_array)
    return tree.unflatten([*nan_derivatives_where(failed, arrays, given), setup])


def _solved(setup: Setup, flow: Flow, ts: Any, valid: jax.Array, options: Options) -> Solution:
    problem, x0, args = setup.problem, setup.x0, setup.args
    t0, t1 = setup.number("t0"), setup.number("t1")
    # No step is made and no time is saved where the numbers are not valid.
    t1 = jnp.where(valid, t1, jnp.nan)
    knots = jnp.asarray(problem.knots(t0, t1, x0, args), setup.dtype)
    stops = jnp.concatenate([t0[None], knots, t1[None]])
    times = None if ts is None else jnp.where(valid, jnp.asarray(ts, setup.dtype), jnp.nan)
    if isinstance(setup.method, Implicit):
        return _implicitly(setup, setup.method, flow, stops, times, options)
    if isinstance(setup.method, Picard):
        return _by_windows(setup, setup.method, flow, stops, times, options)
    method = setup.method
    assert isinstance(method, AbstractMethod)  # PiecewiseLinear runs on the host
    controller = _controller(setup, method, stops, options)
    loop = Loop(
        _stepper(setup, method, flow, stops, options),
        controller,
        max_steps=options.max_steps + (knots.shape[0] if options.fixed else 0),
        check_finite=options.check_finite,
        dense=options.dense,
        progress=options.progress,
        forward_mode=options.adjoint == "forward",
    )
    if options.adjoint == "forward":
        saved, end = outlined(Loop.run, loop, x0, times)
        saved, end = forward_only((saved, end))
    else:
        saved, end = reverse.run(loop, x0, times)
    return _solution(setup, flow, controller, saved, end, times, options)


def _implicitly(
    setup: Setup,
    method: Implicit,
    flow: Flow,
    stops: jax.Array,
    ts: jax.Array | None,
    options: Options,
) -> Solution:
    steps = implicit.controller(setup.number("rtol"), setup.number("atol"), stops)
    first = setup.number("dt0")
    end = implicit.run(
        method, flow, setup.x0, stops, ts, steps, first, options.max_steps, options.adjoint,
        options.progress,
    )  # fmt: skip
    rows = Saved(end.ts, end.xs)
    # What is known of a run that failed is the last saved time that it reached.
    count = jnp.sum(jnp.isfinite(end.ts))
    row = jnp.maximum(count - 1, 0)
    last = jtu.tree_map(lambda leaf, x: jnp.where(count > 0, leaf[row], x), end.xs, setup.x0)
    t = jnp.where(count > 0, end.ts[row], stops[0])
    stats = {
        "steps": end.steps, "rejected": end.rejected, "t": t, "x": last, "next_dt": first,
    }  # fmt: skip
    return _assembled(setup, flow, rows, stats, end.result, None)


def _by_windows(
    setup: Setup,
    method: Picard,
    flow: Flow,
    stops: jax.Array,
    ts: jax.Array | None,
    options: Options,
) -> Solution:
    x0 = setup.x0
    growth = flow.generator.growth(flow.state_space(x0)) if flow.enclosed else None
    ends = stops[0], stops[-1]
    stepper = Stepper(
        ETD2RK(), flow, True, False, None, options.track_bounds, True, ends, None, growth
    )
    rtol, atol, horizon = map(setup.number, ("rtol", "atol", "horizon"))
    sizes = jax.vmap(
        lambda *parts: jnp.stack(root_mean_squares(setup.problem.spaces(x0)[0])(*parts))
    )

    def size(error: Any, before: Any, after: Any) -> Any:
        """What the defect amounts to, in tolerances: the mean of the steps, since a kink is in one."""
        scale = atol + rtol * jnp.maximum(sizes(before), sizes(after))
        ratio = horizon * jnp.max(jnp.mean(sizes(error) / scale, axis=0))
        return jnp.where(jnp.isnan(ratio), jnp.inf, ratio)

    def matters(change: Any, X: Any, value: Any) -> Any:
        """Whether f̃ still changes by more than rounding, and by a part of the tolerance that shows
        beside the defect."""
        worst = lambda v: jnp.max(sizes(v))  # noqa: E731
        rounding = 20 * jnp.finfo(setup.dtype).eps * worst(value)
        more = ~(worst(change) <= rounding)
        return more if options.fixed else more & ~(size(change, X, X) <= 0.01)

    first = setup.number("dt") if options.fixed else setup.number("dt0")
    windows = max(1, -(-options.max_steps // method.nodes))
    if options.fixed:
        # Each stretch between two knots rounds up to whole windows.
        windows += stops.shape[0]
    run = picard.Run(
        method, stepper, stops, options.fixed, first, size, matters,
        windows, options.dense,
    )  # fmt: skip
    saved, end = forward_only(run.solve(x0, ts))
    complete = end.t >= stops[-1]
    result = RESULTS.where(
        (end.result == RESULTS.successful) & ~complete, RESULTS.max_steps, end.result
    )
    rows = _end_alone(end, complete, stops[-1], True) if saved is None else saved
    if ts is not None:
        ends = lax.stop_gradient((stops[0], stops[-1]))
        rows = _carried(rows, ts, x0, flow, ends, False)
    stats = {
        "steps": end.steps, "rejected": end.refused, "t": end.t, "x": end.x,
        "next_dt": end.length / method.nodes, "windows": end.windows, "sweeps": end.sweeps,
        "contraction": end.contraction,
    }  # fmt: skip
    return _assembled(setup, flow, rows, stats, result, end.records)


def _controller(
    setup: Setup, method: AbstractMethod, stops: jax.Array, options: Options
) -> AbstractController:
    if options.fixed:
        return Fixed(stops, setup.number("dt"))
    sizes = root_mean_squares(setup.problem.spaces(setup.x0)[0])
    rtol, atol, horizon = map(setup.number, ("rtol", "atol", "horizon"))
    return Adaptive(
        stops,
        ErrorTest(rtol, atol, horizon, sizes),
        first=setup.number("dt0"),
        first_growth=setup.number("dt0_growth"),
        longest=setup.number("dt_max"),
        order=method.degree + 1,
    )


def _stepper(
    setup: Setup, method: AbstractMethod, flow: Flow, stops: jax.Array, options: Options
) -> Stepper:
    t0, t1, measure = stops[0], stops[-1], options.measure
    growth = None
    if measure and flow.enclosed:
        # Once a run: for a matrix it takes an eigenvalue.
        growth = flow.generator.growth(flow.state_space(setup.x0))
    locate = not options.fixed and _can_locate(flow, t0, setup.x0)
    watch = not options.fixed and measure and not flow.enclosed
    guard = excursions.guard(flow, t0, setup.x0) if watch else None
    stepper = Stepper(
        method,
        flow,
        measure,
        locate,
        guard,
        options.track_bounds,
        options.check_finite,
        (t0, t1),
        None,
        growth,
    )
    if options.fixed and stops.shape[0] == 2 and not method.is_rosenbrock:
        length = (t1 - t0) / step_count(t1 - t0, setup.number("dt"))
        return dataclasses.replace(stepper, uniform=stepper.propagators(length))
    return stepper


_FIELD, _LARGE_LAW = 64, 256
"""Entries of the law beyond which a state of as many is taken for a field, whose kinks are everywhere;
and entries of a law beyond which its kinks are never located. A market of 102 units and one price takes
4 times fewer steps with its kinks located; a field of 128 points takes up to 2 times more."""


def _can_locate(flow: Flow, t0: jax.Array, x0: Any) -> bool:
    like = flow.problem.zero_control(x0)
    law, state = (sum(leaf.size for leaf in jtu.tree_leaves(v)) for v in (like, x0))
    if law > _LARGE_LAW or min(law, state) > _FIELD:
        return False
    known = flow.switches(t0, x0, like)
    return known is not None and known.size > 0


def _solution(
    setup: Setup,
    flow: Flow,
    controller: AbstractController,
    saved: Saved | None,
    end: State,
    ts: jax.Array | None,
    options: Options,
) -> Solution:
    t1 = controller.stops[-1]
    complete = end.t >= t1
    result = RESULTS.where(
        (end.result == RESULTS.successful) & ~complete, RESULTS.max_steps, end.result
    )
    result = RESULTS.where(
        (result == RESULTS.successful) & ~_tree.all_finite(end.x), RESULTS.nonfinite, result
    )
    rows = _end_alone(end, complete, t1, options.measure) if saved is None else saved
    ends = lax.stop_gradient((controller.stops[0], t1))
    if options.adjoint == "forward" and controller.adapts:
        # States are those at times that stay where they are.
        if saved is None:
            rows, ts = rows._replace(t=lax.stop_gradient(rows.t)), t1[None]
        by = zero_with_tangent(jnp.where(end.steps > 0, end.t, 0.0))
        t = lax.stop_gradient(end.t)
        end = end._replace(x=transport(end.x, by, left_derivative, t, flow, ends))
    if ts is not None:
        rows = _carried(rows, ts, setup.x0, flow, ends, options.adjoint == "reverse")
    stats = {
        "steps": end.steps,
        "rejected": end.attempts - end.steps,
        "evaluations": end.evaluations,
        "t": end.t,
        "x": end.x,
        "next_dt": controller.next_size(end.control),
    }
    return _assembled(setup, flow, rows, stats, result, end.records)


def _carried(
    rows: Saved, ts: jax.Array, x0: Any, flow: Flow, ends: tuple[Any, Any], transposed: bool
) -> Saved:
    """`rows` with the states at the times `ts`: the two move apart where one is differentiated and the
    other is not. Times that were not reached have no state that could move."""
    reached = rows.t < jnp.inf
    t = jnp.where(reached, rows.t, ends[0])
    apart = zero_with_tangent(jnp.where(reached, ts, ends[0])) - zero_with_tangent(t)
    given = reached, lax.stop_gradient(x0), flow, ends
    x = transport(rows.x, apart, _arrived, t, *given, transposed=transposed)
    return rows._replace(t=rows.t + apart, x=x)


def _arrived(ts: jax.Array, xs: Any, reached: Any, x0: Any, flow: Flow, ends: Any) -> Any:
    """x' as the run came to those times that it reached; elsewhere 0, whatever there is."""
    there = lambda x, y: jnp.where(reached.reshape(-1, *(1,) * (x.ndim - 1)), x, y)  # noqa: E731
    found = left_derivatives(ts, jtu.tree_map(there, xs, x0), flow, ends)
    return jtu.tree_map(lambda leaf: there(leaf, 0.0), found)


def _assembled(
    setup: Setup,
    flow: Flow,
    rows: Saved,
    stats: dict[str, Any],
    result: RESULTS,
    records: Record | None,
) -> Solution:
    us, ys, residual, law_step, law_error = _responses(
        flow, (rows.t, rows.x, rows.guess), setup.problem.spaces(setup.x0)[1], setup.moduli
    )
    # f may not feel a response that is not finite, and the solution would hold it all the same.
    result = RESULTS.where(
        (result == RESULTS.successful) & ~_tree.all_finite(us), RESULTS.nonfinite, result
    )
    return Solution(
        ts=rows.t,
        xs=rows.x,
        us=us,
        ys=ys,
        law_residual=residual,
        law_step=law_step,
        law_error=law_error,
        defect=None if rows.impulse is None else rows.impulse[0],
        law_defect=None if rows.impulse is None else rows.impulse[1],
        settled=rows.settled,
        extent=rows.extent,
        stats=stats,
        result=result,
        records=records,
        enclosed=flow.enclosed,
        setup=setup,
    )


def _end_alone(end: State | picard.State, complete: Any, t1: Any, measured: bool) -> Saved:
    """The end as the one saved time."""
    x = jtu.tree_map(lambda leaf: jnp.where(complete, leaf, jnp.nan), end.x)
    impulse = end.impulse if measured else None
    one = Saved(jnp.where(complete, t1, jnp.inf), x, impulse, impulse, end.extent)
    return jtu.tree_map(lambda leaf: leaf[None], one)


_IN_TURN = 4096
"""Entries of the state from which laws that are solved by iteration are solved one saved time after
the other: each then stops at its own iteration, with the memory of one."""


def _responses(flow, rows, control, moduli):
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
