"""Steps of an exponential method, or of an explicit one, from the first stop to the last."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._jax import forward_only, outlined
from .._tree import Tree
from ..problem import Problem
from . import excursions, reverse
from .auto import FIELD, LARGE_LAW, TIGHT
from .control import (
    AbstractController,
    Adaptive,
    ErrorTest,
    Fixed,
    TangentLimit,
    step_count,
)
from .event import Events
from .event_watch import EventWatch
from .flow import Flow, is_pointwise
from .law_tolerance import RootMeanSquares
from .loop import Loop, State
from .method import AbstractMethod
from .outcome import Outcome, end_alone, ended, with_tangents
from .results import RESULTS
from .setup import Options, Setup
from .stepper import Stepper
from .time_derivatives import zero_with_tangent


def by_steps(
    setup: Setup,
    method: AbstractMethod,
    flow: Flow,
    stops: jax.Array,
    ts: jax.Array | None,
    options: Options,
) -> Outcome:
    """Run steps of a method from the first stop to the last."""
    controller, x0, t1 = _controller(setup, method, stops, options), setup.x0, stops[-1]
    watch = None
    if setup.events:
        watch, x0 = _watch(setup, flow, stops[0], options)
    loop = Loop(
        _stepper(setup, method, flow, stops, options),
        controller,
        max_steps=options.max_steps + (stops.shape[0] - 2 if options.fixed else 0),
        check_finite=options.check_finite,
        dense=options.dense,
        progress=options.progress,
        forward_mode=options.adjoint == "forward",
        watch=watch,
    )
    if options.adjoint == "forward":
        saved, end = forward_only(outlined(Loop.run, loop.for_derivatives(x0), x0, ts))
    else:
        saved, end = reverse.run(loop, x0, ts)
    complete = end.t >= t1
    result = ended(end.result, complete)
    result = RESULTS.where(
        (result == RESULTS.successful) & ~_tree.all_finite(end.x), RESULTS.nonfinite, result
    )
    events = None
    if watch is not None:
        assert end.watched is not None
        rows, count = end.watched.rows, end.watched.count
        events = outlined(EventWatch.finish, watch, flow, rows, count, stops[0], setup.x0)
        # A reset at t0 comes before the steps, which look for it.
        is_broken = _tree.all_finite(setup.x0) & ~_tree.all_finite(x0)
        result = RESULTS.where(is_broken, RESULTS.event_nonfinite, result)
        if saved is None:
            end, t1, complete = _to_event(end, events, t1, complete)
    guess = end.solver_state.guess
    rows = end_alone(end, complete, t1, options.measure, guess) if saved is None else saved
    ends = lax.stop_gradient((stops[0], t1))
    if ts is not None:
        assert saved is not None
        # The state at the end of a step has the tangent of that end.
        found = jax.vmap(controller.step_start)(saved.step, saved.t)
        found = zero_with_tangent(jnp.where(saved.step >= 0, found, 0.0))
        t = lax.stop_gradient(saved.t) + found
        rows = with_tangents(rows._replace(t=t), ts, x0, flow, ends)
    stats = {
        "steps": end.steps,
        "rejected": end.attempts - end.steps,
        "evaluations": end.evaluations,
        "t": end.t,
        "x": end.x,
        "next_dt": controller.next_size(end.control),
    }
    return Outcome(rows, stats, result, end.records, events)


def _watch(setup: Setup, flow: Flow, t0: jax.Array, options: Options) -> tuple[EventWatch, Tree]:
    """Return the watch of the events, and the state behind the events at t0."""
    at_start = jnp.zeros(len(setup.events), bool)
    rtol, atol = setup.number("rtol"), setup.number("atol")
    watch = EventWatch(setup.events, rtol, atol, at_start, options.max_events)
    return watch.start(flow, t0, setup.x0)


def _to_event(end: State, events: Events, t1: Any, complete: Any) -> tuple[State, Any, Any]:
    """Return the end of the run at the terminal event, if there was one."""
    assert end.watched is not None
    last = jnp.clip(end.watched.count - 1, 0, events.ts.shape[0] - 1)
    at_event = end.result == RESULTS.terminal_event
    t, x = jtu.tree_map(lambda leaf: leaf[last], (events.ts, events.xs_after))
    x = _tree.where(at_event, x, end.x)
    return end._replace(x=x), jnp.where(at_event, t, t1), complete | at_event


def _controller(
    setup: Setup, method: AbstractMethod, stops: jax.Array, options: Options
) -> AbstractController:
    if options.fixed:
        return Fixed(stops, setup.number("dt"))
    sizes = RootMeanSquares(setup.problem.spaces(setup.x0)[0])
    rtol, atol, horizon = map(setup.number, ("rtol", "atol", "horizon"))
    return Adaptive(
        stops,
        ErrorTest(
            rtol,
            atol,
            horizon,
            sizes,
            certify=bool(setup.moduli),
            knows_decay=method.is_rosenbrock,
        ),
        tangents=TangentLimit(
            rtol, stops[-1] - stops[0], method.order, method.stable, method.is_rosenbrock
        ),
        first=setup.number("dt0"),
        first_growth=setup.number("dt0_growth"),
        longest=setup.number("dt_max"),
        order=method.order,
        defect_order=method.degree + 1,
        locates=True
        if min(_sizes(setup.problem, setup.x0)) <= FIELD
        else jnp.maximum(rtol, atol) <= TIGHT,
        stiff_steps=setup.number("stiff_steps")
        if options.watch_stiffness and method.pair is not None
        else None,
    )


def _stepper(
    setup: Setup, method: AbstractMethod, flow: Flow, stops: jax.Array, options: Options
) -> Stepper:
    t0, t1, measure = stops[0], stops[-1], options.measure
    growth = None
    if measure and flow.enclosed:
        # Once a run: for a matrix it takes an eigenvalue.
        growth = flow.generator.growth(flow.state_space(setup.x0))
    if measure and not flow.enclosed:
        pointwise = is_pointwise(flow.problem, flow.operator, t0, setup.x0, flow.args)
        flow = dataclasses.replace(flow, pointwise=pointwise)
    locate = not options.fixed and _can_locate(flow, t0, setup.x0)
    flow = dataclasses.replace(flow, keeps_switches=locate and flow.iterates)
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
        _estimates(setup, method, flow, options),
        (t0, t1),
        None,
        growth,
    )
    if options.fixed and stops.shape[0] == 2 and not method.is_rosenbrock:
        length = (t1 - t0) / step_count(t0, t1, setup.number("dt"))
        return dataclasses.replace(stepper, uniform=stepper.propagators(length))
    return stepper


def _estimates(setup: Setup, method: AbstractMethod, flow: Flow, options: Options) -> bool:
    """Return whether steps may owe what decays: not for a certificate, and not by a method of order 2
    or less, whose steps meet kinks at any time."""
    return not options.fixed and not flow.enclosed and not setup.moduli and method.order > 2


def _can_locate(flow: Flow, t0: jax.Array, x0: Any) -> bool:
    like = flow.problem.zero_control(x0)
    law, state = _sizes(flow.problem, x0)
    if law > LARGE_LAW or (min(law, state) > FIELD and not flow.pointwise):
        return False
    known = flow.switches(t0, x0, like)
    return known is not None and known.size > 0


def _sizes(problem: Problem, x0: Any) -> tuple[int, int]:
    """Return the numbers of entries of the law and of the state."""
    law, state = (
        sum(leaf.size for leaf in jtu.tree_leaves(v)) for v in (problem.zero_control(x0), x0)
    )
    return law, state
