"""The time loop: steps until every saved time and the end are reached.

One loop over the saved times holds one loop over steps, so that a step is compiled once, saving costs
nothing between saved times, and the lanes of a batch wait for each other no longer than they must.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._batch import any_lane, is_active
from .._tree import Tree
from ..vi import independent
from . import forcing, meter
from .bounds import Bounds
from .checkpoints import Checkpoints
from .control import AbstractController, Adaptive, StepDecision, slack
from .event_watch import EventWatch, Watched
from .outcome import Record, Saved
from .results import RESULTS
from .stepper import Propagators, SolverState, Step, Stepper, dense_output
from .time_derivatives import is_differentiated

STEP = "dvax_step"
"""The name of the operations of a step in the compiled program."""


class State(NamedTuple):
    """Where the loop stands: after `steps` accepted ones of `attempts`.

    `bounds` are those since the last saved time. `last` is the last step, what had disturbed the state
    before it, and the bounds in it, kept where saved times may lie inside steps that are already taken;
    `records` all of them, for dense output; `ends` the times at which they ended and `checkpoints` some
    of the states they began with, for the reverse pass.
    """

    t: Any
    x: Tree
    integrated_defect: tuple[Any, Any]
    solver_state: SolverState
    propagators: Propagators | None
    control: Any
    jumped: Any
    bounds: Bounds | None
    last: tuple[Record, tuple[Any, Any], Bounds | None] | None
    records: Record | None
    ends: jax.Array | None
    checkpoints: Checkpoints | None
    result: RESULTS
    steps: Any
    attempts: Any
    evaluations: Any
    meter: Any
    watched: Watched | None


class Loop(eqx.Module):
    """A stepper and a controller from the first stop to the last.

    - `check_finite`: keep the last good state where a step fails, which costs a choice between the two;
    - `dense`: keep every step; `progress`: say how far the run is;
    - `forward_mode`: tangents go along with the steps;
    - `watch`: the events of the user.

    A step that ends at a stop has the tangent of that stop; saved rows have those of constant times,
    or of the end of the step where they meet one (`time_derivatives`).
    """

    stepper: Stepper
    controller: AbstractController
    max_steps: int = eqx.field(static=True)
    check_finite: bool = eqx.field(static=True)
    dense: bool = eqx.field(static=True)
    progress: bool = eqx.field(static=True)
    forward_mode: bool = eqx.field(static=True)
    watch: EventWatch | None = None

    def for_derivatives(self, x0: Tree, chosen: Sequence[bool] | None = None) -> "Loop":
        """Return the loop from x0 whose steps a derivative can take as well: one in x0 and the `chosen`
        arrays of the problem and of args (None: in all)."""
        # Steps of a given size have no choice.
        if not self.controller.adapts:
            return self
        flow, t0 = self.stepper.flow, self.stepper.ends[0]
        varies = not independent(lambda t: flow.rate(t, x0, flow.guess(x0)).value, t0)
        forced_by = forcing.groups(flow, t0, x0, chosen) if varies else ()
        stepper = replace(self.stepper, for_derivatives=True, varies=varies, forced_by=forced_by)
        return replace(self, stepper=stepper)

    def run(
        self, x0: Tree, ts: jax.Array | None, checkpoints: Checkpoints | None = None
    ) -> tuple[Saved | None, State]:
        """The states at the times `ts`, and where the run ended."""
        state = self._start(x0, ts is not None, checkpoints)
        t1 = self.controller.stops[-1]
        if ts is None:
            return None, self._until(state, t1)
        times, count = lax.stop_gradient(ts), ts.shape[0]
        blank = jax.eval_shape(lambda: self._read(state, times[0]))
        rows = jtu.tree_map(lambda s: jnp.zeros((count, *s.shape), s.dtype), blank)

        def turn(carry: tuple[State, Saved, Any]) -> tuple[State, Saved, Any]:
            # One turn more than there are saved times, for the way from the last of them to the end.
            state, rows, row = self._through(*carry, times)
            rows = _put(rows, row, self._read(state, _at(times, row)))
            # The last step may reach over the saved time.
            bounds = state.bounds if state.last is None else state.last[2]
            return state._replace(bounds=bounds), rows, row + 1

        start = state, rows, jnp.asarray(0)
        state, rows, _ = lax.while_loop(lambda carry: carry[2] <= count, turn, start)
        return rows, state

    def _start(self, x0: Tree, saves: bool, checkpoints: Checkpoints | None) -> State:
        controller, stepper = self.controller, self.stepper
        t0, control = controller.stops[0], controller.init()
        zero = jnp.zeros_like(t0)
        measure = stepper.measure
        record = Record(t0, zero, x0, (_tree.zeros_like(x0),) * (stepper.method.degree + 1))
        bounds = stepper.bounds(x0)
        many = lambda leaf: jnp.zeros((self.max_steps, *leaf.shape), leaf.dtype)  # noqa: E731
        records = jtu.tree_map(many, record) if self.dense else None
        if records is not None:
            records = records._replace(start=jnp.full_like(records.start, jnp.inf))
        own = stepper.uniform is not None or stepper.method.is_rosenbrock
        return State(
            t=t0,
            x=x0,
            integrated_defect=(zero, zero),
            solver_state=stepper.begin(x0),
            propagators=None if own else stepper.propagators(controller.end(control) - t0),
            control=control,
            jumped=jnp.asarray(True),
            bounds=bounds,
            last=(record, (zero, zero), bounds) if saves and measure else None,
            records=records,
            ends=jnp.zeros(self.max_steps, t0.dtype)
            if checkpoints is not None and controller.adapts
            else None,
            checkpoints=checkpoints,
            result=RESULTS.successful if self.watch is None else self.watch.first_result(),
            steps=jnp.asarray(0),
            attempts=jnp.asarray(0),
            evaluations=jnp.asarray(0),
            meter=meter.begin() if self.progress else None,
            watched=None if self.watch is None else self.watch.begin(stepper.flow, t0, x0),
        )

    def _until(self, state: State, time: Any) -> State:
        """Steps until `time` has been reached, or lies in the next step where none is kept."""

        def turn(carry: tuple[State]) -> tuple[State]:
            (state,) = carry
            return (self._attempt(state, is_active(self._goes_on(state, time))),)

        return self._repeat(lambda carry: self._goes_on(carry[0], time), turn, (state,))[0]

    def _through(
        self, state: State, rows: Saved, row: Any, times: jax.Array
    ) -> tuple[State, Saved, Any]:
        """Steps until the saved time at hand has been reached or lies in the next one; past those
        that steps end at, whose rows are written here. Behind the last row, to the end."""
        t1, count = self.controller.stops[-1], times.shape[0]
        ahead = lambda row: jnp.where(row < count, _at(times, row), t1)  # noqa: E731
        if state.last is not None:
            return self._until(state, ahead(row)), rows, row

        def goes_on(carry: tuple[State, Saved, Any]) -> Any:
            return self._goes_on(carry[0], ahead(carry[2]))

        def turn(carry: tuple[State, Saved, Any]) -> tuple[State, Saved, Any]:
            state, rows, row = carry
            state = self._attempt(state, is_active(goes_on(carry)))
            time = _at(times, row)
            met = time <= state.t + slack(state.t)
            # Problems of a batch wait for each other at every saved time.
            over = (row < count) & ~any_lane(~met & (state.result == RESULTS.successful))
            put = lambda: _put(rows, row, self._row(state, time, state.x, met, met))  # noqa: E731
            rows = lax.cond(over, put, lambda: rows)
            return state, rows, jnp.where(over, row + 1, row)

        return self._repeat(goes_on, turn, (state, rows, row))

    def _repeat(self, goes_on: Callable[[Any], Any], turn: Callable[[Any], Any], carry: Any) -> Any:
        """One turn after the other, on a carry that begins with the state. Steps of one length are a
        loop of their own, in which propagators stand still."""
        ahead = lambda carry: any_lane(goes_on(carry))  # noqa: E731
        if not self._refits(carry[0]):
            return lax.while_loop(ahead, turn, carry)
        moves = self._must_rebuild()

        def same(carry: Any) -> Any:
            is_same = self.stepper.match(*self._ahead(carry[0])) & ~moves
            # Problems of a batch get new propagators together, as soon as one of them needs some.
            return ~any_lane(goes_on(carry) & ~is_same)

        def of_one_length(carry: Any) -> Any:
            state, *rest = carry
            propagators = self.stepper.reuse_or_build(*self._ahead(state), moves)
            carry = (state._replace(propagators=propagators), *rest)
            one = lambda c: (turn(c[0]), jnp.asarray(False))  # noqa: E731
            # One in any case: what is not a number fits nothing.
            more = lambda c: ahead(c[0]) & (c[1] | same(c[0]))  # noqa: E731
            return lax.while_loop(more, one, (carry, jnp.asarray(True)))[0]

        return lax.while_loop(ahead, of_one_length, carry)

    def _refits(self, state: State) -> bool:
        """Whether propagators are made between loops, not within them: where lengths are not known
        beforehand and do not move."""
        return (
            state.propagators is not None and not self.forward_mode and self.stepper.uniform is None
        )

    def _ahead(self, state: State) -> tuple[Propagators, Any, Any]:
        """What fits the next step, if it does, and where that one begins and ends."""
        assert state.propagators is not None
        return state.propagators, state.t, self.controller.end(state.control)

    def _goes_on(self, state: State, time: Any) -> Any:
        """Whether a step is to be taken before `time`."""
        before = state.t < time
        if state.last is None:
            before = before & (self.controller.end(state.control) <= time + slack(time))
        going = state.result == RESULTS.successful
        return before & going & (state.attempts < self.max_steps)

    def _attempt(self, state: State, own: Any) -> State:
        """The state after one more attempt, where that is its `own`."""
        with jax.named_scope(STEP):
            return self._attempt_in_scope(state, own)

    def _attempt_in_scope(self, state: State, own: Any) -> State:
        t0, t1, x0 = state.t, self.controller.end(state.control), state.x
        propagators = state.propagators if self._refits(state) else self._propagators(state, t0, t1)
        step = self.stepper.step(t0, t1, x0, state.solver_state, propagators, state.jumped)
        decision = self.controller.decide(t0, t1, x0, step, state.control)
        taken = Record(t0, t1 - t0, x0, step.c)
        watched = state.watched
        if self.watch is not None:
            active = own & decision.accepted
            step, decision, watched = self._observe(state, step, decision, taken, t1, active)
        integrated_defect = jtu.tree_map(jnp.add, state.integrated_defect, step.integrated_defect)
        # `last` and `records` of a step that is not kept are written over by the next one, or never
        # looked at: nothing ends inside a step that was not kept.
        bounds = state.bounds
        if bounds is not None:
            assert step.bounds is not None
            bounds = bounds.hull(step.bounds)
        ahead = (t1, step.x1, integrated_defect, step.solver_state, decision.jumped, bounds)
        last = None if state.last is None else (taken, state.integrated_defect, step.bounds)
        if self.check_finite:
            behind = (
                t0,
                x0,
                state.integrated_defect,
                state.solver_state,
                state.jumped,
                state.bounds,
            )
            ahead, last = _tree.where(decision.accepted, (ahead, last), (behind, state.last))
        checkpoints = state.checkpoints
        if checkpoints is not None:
            checkpoints = checkpoints.put(state.steps, state.x, own)
        shown = state.meter
        if self.progress:
            stops = self.controller.stops
            share = (ahead[0] - stops[0]) / (stops[-1] - stops[0])
            name = type(self.stepper.method).__name__
            shown = meter.advance(shown, share, state.steps, name)
        t, x, integrated_defect, solver_state, jumped, bounds = ahead
        put = lambda table, row: _tree.put_if(own, table, state.steps, row)  # noqa: E731
        after = State(
            t=t,
            x=x,
            integrated_defect=integrated_defect,
            solver_state=solver_state,
            propagators=None if state.propagators is None else propagators,
            control=decision.state,
            jumped=jumped,
            bounds=bounds,
            last=last,
            records=None,
            ends=None,
            checkpoints=None,
            result=decision.result,
            steps=jnp.where(decision.accepted, state.steps + 1, state.steps),
            attempts=state.attempts + 1,
            evaluations=state.evaluations + step.evaluations,
            meter=shown,
            watched=watched,
        )
        # Tables are not chosen as a whole but written, or not.
        bare = state._replace(records=None, ends=None, checkpoints=None)
        if watched is not None and state.watched is not None:
            bare = bare._replace(watched=state.watched._replace(rows=watched.rows))
        after = _tree.where(own, after, bare)
        return after._replace(
            records=None if state.records is None else put(state.records, taken),
            ends=None if state.ends is None else put(state.ends, t1),
            checkpoints=checkpoints,
        )

    def _observe(
        self, state: State, step: Step, decision: StepDecision, taken: Record, t1: Any, active: Any
    ) -> tuple[Step, StepDecision, Watched]:
        """Return the step, the decision and the events after watching an accepted step: it is rejected
        where it must end at an event, and its last state is that behind the resets."""
        assert self.watch is not None and state.watched is not None
        guess = step.solver_state.guess
        seen = self.watch.observe(
            self.stepper, state.watched, taken, t1, step.x1, guess, state.steps, active
        )
        repeated = active & (seen.event < jnp.inf)
        # Events behind the count are written over.
        old = state.watched._replace(rows=seen.watched.rows)
        watched = _tree.where(active & ~repeated, seen.watched, old)
        jumped, solver_state = seen.jumped & active, step.solver_state
        restarted = lax.cond(
            any_lane(jumped),
            lambda: self.stepper.restart(solver_state, seen.x),
            lambda: solver_state,
        )
        step = step._replace(
            x1=_tree.where(jumped, seen.x, step.x1),
            solver_state=_tree.where(jumped, restarted, solver_state),
        )
        assert isinstance(self.controller, Adaptive)  # `check_events` refuses fixed steps
        shortened = self.controller.shorten(state.control, seen.event, seen.margin)
        ends = active & (seen.result != RESULTS.successful)
        result = RESULTS.where(ends, seen.result, decision.result)
        return (
            step,
            StepDecision(
                accepted=decision.accepted & ~repeated,
                state=_tree.where(repeated, shortened, decision.state),
                jumped=decision.jumped | jumped,
                result=RESULTS.where(repeated, RESULTS.successful, result),
            ),
            watched,
        )

    def _read(self, state: State, time: Any) -> Saved:
        """The trajectory at a time that the loop has run up to; t = ∞ where it did not get there."""
        if state.last is None:
            t0, t1 = state.t, self.controller.end(state.control)

            def between() -> Tree:
                guess = state.solver_state.guess
                propagators = self._propagators(state, t0, t1)
                _, c, _ = self.stepper.advance(t0, t1, state.x, propagators, guess)
                record = Record(t0, t1 - t0, state.x, c)
                return self._interpolate(record, (time - t0) / (t1 - t0), guess)

            met = time <= t0 + slack(t0)
            reached = met | ((t1 > time) & (state.result == RESULTS.successful))
            return self._row(state, time, lax.cond(met, lambda: state.x, between), reached, met)
        record, before, _ = state.last
        theta = (time - record.start) / jnp.where(record.length > 0, record.length, 1)
        reached, met = state.t >= time, time >= state.t
        guess = state.solver_state.guess
        x = lax.cond(met, lambda: state.x, lambda: self._interpolate(record, theta, guess))
        row = self._row(state, time, x, reached, met)
        # Inside a step the bound of the whole step is charged: it can only be too large.
        return row._replace(
            integrated_defect=_tree.where(theta > 0.0, state.integrated_defect, before),
            completed_defect=_tree.where(time >= state.t, state.integrated_defect, before),
        )

    def _row(self, state: State, time: Any, x: Tree, reached: Any, met: Any) -> Saved:
        """What is kept of the state x at a saved time, which may not have been `reached`; where it was
        `met`, by the end of a step."""
        x = jtu.tree_map(lambda leaf: jnp.where(reached, leaf, jnp.nan), x)
        integrated_defect = state.integrated_defect if self.stepper.measure else None
        return Saved(
            jnp.where(reached, time, jnp.inf),
            x,
            integrated_defect,
            integrated_defect,
            state.bounds,
            state.solver_state.guess,
            jnp.where(reached & met, state.steps, -1),
        )

    def _propagators(self, state: State, t0: Any, t1: Any) -> Propagators | None:
        """The propagators of a step, None where it makes its own."""
        uniform = self.stepper.uniform
        if uniform is not None or state.propagators is None:
            return uniform
        return self.stepper.reuse_or_build(state.propagators, t0, t1, self._must_rebuild())

    def _must_rebuild(self) -> Any:
        """Whether steps of one length need propagators of their own: their tangents may differ."""
        return is_differentiated(self.controller.stops)

    def _interpolate(self, record: Record, theta: Any, guess: Tree | None) -> Tree:
        """x_h inside a step."""
        stepper = self.stepper
        return dense_output(stepper.method, stepper.flow, record, guess, stepper.ends)(theta)


def _at(times: jax.Array, row: Any) -> Any:
    """The saved time at hand, or the last one."""
    return times[jnp.minimum(row, times.shape[0] - 1)]


def _put(rows: Saved, row: Any, found: Saved) -> Saved:
    """The table with this row, if it has one."""
    last = rows.t.shape[0] - 1
    return _tree.put_if(row <= last, rows, jnp.minimum(row, last), found)
