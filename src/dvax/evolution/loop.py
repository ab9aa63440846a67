"""The time loop: steps until every saved time and the end are reached.

One loop over the saved times holds one loop over steps, so that a step is compiled once, saving costs
nothing between saved times, and the lanes of a batch wait for each other no longer than they must.
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._tree import Tree
from .checkpoints import Checkpoints
from .control import AbstractController
from .extent import Extent
from .flow import Flow
from .moving import arriving, moved, still, velocity
from .results import RESULTS
from .stepper import Factors, Memory, Stepper, inside, local, within


class Record(NamedTuple):
    """What is needed to evaluate a step anywhere inside: x₀ and the stage polynomial."""

    start: jax.Array
    length: jax.Array
    x0: Tree
    coefficients: tuple[Tree, ...]


class Saved(NamedTuple):
    """The state at a saved time, and what has disturbed it.

    `impulse` = (∫ ‖p − f̃(·, x_h)‖ ds, ∫ ‖w‖ ds) up to the end of the step that the time lies in, so
    that x_h is the exact solution of the system with a disturbance of that size; `settled` is what
    both were at the start of that step: what has surely acted by then. `extent` says where x_h and u_h
    have been from the beginning to the end of that step, where it was asked for.
    """

    t: Any
    x: Tree
    impulse: tuple[Any, Any]
    settled: tuple[Any, Any]
    extent: Extent | None = None


class State(NamedTuple):
    """Where the loop stands: after `steps` accepted ones of `attempts`.

    `last` is the last step and what had disturbed the state before it, kept where saved times may lie
    inside steps that are already taken; `records` all of them, for dense output; `ends` the times at
    which they ended and `checkpoints` some of the states they began with, for the reverse pass.
    """

    t: Any
    x: Tree
    impulse: tuple[Any, Any]
    memory: Memory
    factors: Factors | None
    control: Any
    jumped: Any
    extent: Extent | None
    last: tuple[Record, tuple[Any, Any]] | None
    records: Record | None
    ends: jax.Array | None
    checkpoints: Checkpoints | None
    result: RESULTS
    steps: Any
    attempts: Any
    evaluations: Any
    meter: Any


class Loop(eqx.Module):
    """A stepper and a controller from the first stop to the last.

    - `guarded`: keep the last good state where a step fails, which costs a choice between the two;
    - `dense`: keep every step; `progress`: say how far the run is;
    - `carries`: tangents go along with the steps.

    Where steps adapt, tangents are those of the state at times that stand still: a stop that moves
    carries the jump of x' over it, and what asks for the state at a moving time adds x' (`moving`).
    Fixed steps move with the stops, and so do their states.
    """

    stepper: Stepper
    controller: AbstractController
    max_steps: int = eqx.field(static=True)
    guarded: bool = eqx.field(static=True)
    dense: bool = eqx.field(static=True)
    progress: bool = eqx.field(static=True)
    carries: bool = eqx.field(static=True)

    def run(
        self, x0: Tree, ts: jax.Array | None, checkpoints: Checkpoints | None = None
    ) -> tuple[Saved | None, State]:
        """The states at the times `ts`, and where the run ended."""
        state = self._start(x0, ts is not None, checkpoints)
        t1 = self.controller.stops[-1]
        if ts is None:
            return None, self._until(state, t1)
        times, count = still(ts), ts.shape[0]
        blank = jax.eval_shape(lambda: self._read(state, times[0]))
        rows = jtu.tree_map(lambda s: jnp.zeros((count, *s.shape), s.dtype), blank)

        def visit(k: Any, carry: tuple[State, Saved]) -> tuple[State, Saved]:
            # One turn more than there are saved times, for the way from the last of them to the end:
            # it writes the last row once more.
            state, rows = carry
            row = jnp.minimum(k, count - 1)
            state = self._until(state, jnp.where(k < count, times[row], t1))
            found = _tree.where(
                k < count, self._read(state, times[row]), jtu.tree_map(lambda leaf: leaf[row], rows)
            )
            return state, _tree.put(rows, row, found)

        state, rows = lax.fori_loop(0, count + 1, visit, (state, rows))
        return rows, state

    def _start(self, x0: Tree, saves: bool, checkpoints: Checkpoints | None) -> State:
        controller, stepper = self.controller, self.stepper
        t0, control = controller.stops[0], controller.init()
        zero = jnp.zeros_like(t0)
        measure = stepper.measure
        record = Record(t0, zero, x0, (_tree.zeros_like(x0),) * (stepper.method.degree + 1))
        many = lambda leaf: jnp.zeros((self.max_steps, *leaf.shape), leaf.dtype)  # noqa: E731
        records = jtu.tree_map(many, record) if self.dense else None
        if records is not None:
            records = records._replace(start=jnp.full_like(records.start, jnp.inf))
        own = stepper.uniform is not None or stepper.method.linearises
        return State(
            t=t0,
            x=x0,
            impulse=(zero, zero),
            memory=stepper.begin(x0),
            factors=None if own else stepper.factors(self._end(control) - self._held(t0)),
            control=control,
            jumped=jnp.asarray(True),
            extent=stepper.extent(x0),
            last=(record, (zero, zero)) if saves and measure else None,
            records=records,
            ends=jnp.zeros(self.max_steps, t0.dtype)
            if checkpoints is not None and controller.adapts
            else None,
            checkpoints=checkpoints,
            result=RESULTS.successful,
            steps=jnp.asarray(0),
            attempts=jnp.asarray(0),
            evaluations=jnp.asarray(0),
            meter=diffrax.TextProgressMeter().init() if self.progress else None,
        )

    def _until(self, state: State, time: Any) -> State:
        """Steps until `time` has been reached, or lies in the next step where none is kept."""

        def goes_on(state: State) -> Any:
            before = state.t < time
            if state.last is None:
                before = before & (self.controller.end(state.control) <= time + slack(time))
            going = state.result == RESULTS.successful
            return before & going & (state.attempts < self.max_steps)

        return lax.while_loop(goes_on, lambda state: self._attempt(state), state)

    def _attempt(self, state: State) -> State:
        begin, end = state.t, self.controller.end(state.control)
        t0, t1, x0 = self._held(begin), self._held(end), self._begun(state, end)
        factors = self._factors(state, t0, t1)
        step = self.stepper.step(t0, t1, x0, state.memory, factors, state.jumped)
        verdict = self.controller.judge(begin, end, x0, step, state.control)
        impulse = jtu.tree_map(jnp.add, state.impulse, step.impulse)
        taken = Record(t0, t1 - t0, x0, step.c)
        # `last` and `records` of a step that is not kept are written over by the next one, or never
        # looked at: nothing ends inside a step that was not kept.
        extent = state.extent
        if extent is not None:
            assert step.extent is not None
            extent = extent.joined(step.extent)
        ahead = (end, step.x1, impulse, step.memory, verdict.jumped, extent)
        last = None if state.last is None else (taken, state.impulse)
        if self.guarded:
            behind = (begin, state.x, state.impulse, state.memory, state.jumped, state.extent)
            ahead, last = _tree.where(verdict.kept, (ahead, last), (behind, state.last))
        checkpoints = state.checkpoints
        if checkpoints is not None:
            checkpoints = checkpoints.put(state.steps, state.x)
        meter = state.meter
        if self.progress:
            stops = self.controller.stops
            meter = diffrax.TextProgressMeter().step(
                meter, (ahead[0] - stops[0]) / (stops[-1] - stops[0])
            )
        t, x, impulse, memory, jumped, extent = ahead
        return State(
            t=t,
            x=x,
            impulse=impulse,
            memory=memory,
            factors=None if state.factors is None else factors,
            control=verdict.state,
            jumped=jumped,
            extent=extent,
            last=last,
            records=None if state.records is None else _tree.put(state.records, state.steps, taken),
            ends=None if state.ends is None else _tree.put(state.ends, state.steps, end),
            checkpoints=checkpoints,
            result=verdict.result,
            steps=jnp.where(verdict.kept, state.steps + 1, state.steps),
            attempts=state.attempts + 1,
            evaluations=state.evaluations + step.evaluations,
            meter=meter,
        )

    def _read(self, state: State, time: Any) -> Saved:
        """The trajectory at a time that the loop has run up to; t = ∞ where it did not get there."""
        now = self._held(state.t)
        if state.last is None:
            t0, t1 = now, self._end(state.control)

            def between() -> Tree:
                guess = state.memory.guess
                c = self.stepper.advance(t0, t1, state.x, self._factors(state, t0, t1), guess)[1]
                record = Record(t0, t1 - t0, state.x, c)
                return self._inside(record, (time - t0) / (t1 - t0), guess)

            met = time <= t0 + slack(t0)
            reached = met | ((t1 > time) & (state.result == RESULTS.successful))
            x = lax.cond(met, lambda: state.x, between)
            impulse = settled = state.impulse
        else:
            record, before = state.last
            theta = (time - record.start) / jnp.where(record.length > 0, record.length, 1)
            reached, met = state.t >= time, time >= state.t
            x = lax.cond(
                met,
                lambda: state.x,
                lambda: self._inside(record, theta, state.memory.guess),
            )
            # Inside a step the bound of the whole step is charged: it can only be too large.
            impulse = _tree.where(theta > 0.0, state.impulse, before)
            settled = _tree.where(time >= state.t, state.impulse, before)
        x = jtu.tree_map(lambda leaf: jnp.where(reached, leaf, jnp.nan), x)
        # The state at the end of a step moves with it; at the beginning of the run, always.
        end = jnp.where(state.steps == 0, state.t, now)
        time = time + jnp.where(met, end - still(end), 0.0)
        return Saved(jnp.where(reached, time, jnp.inf), x, impulse, settled, state.extent)

    def _held(self, t: Any) -> Any:
        """t, which stands still for the tangents of steps that adapt."""
        return still(t) if self.carries and self.controller.adapts else t

    def _end(self, control: Any) -> Any:
        return self._held(self.controller.end(control))

    def _begun(self, state: State, end: Any) -> Tree:
        """The state at a time that stands still, at the beginning of a step."""
        if not (self.carries and self.controller.adapts):
            return state.x
        t0, flow = still(state.t), self.stepper.flow
        ends, shift = jtu.tree_map(still, self.stepper.ends), state.t - t0
        x = moved(state.x, shift, before, t0, flow, ends, state.jumped)
        return moved(x, -shift, behind, t0 + shift, flow, still(end) - t0, ends, state.jumped)

    def _factors(self, state: State, t0: Any, t1: Any) -> Factors | None:
        """The propagators of a step, None where it makes its own."""
        uniform = self.stepper.uniform
        if uniform is not None or state.factors is None:
            return uniform
        # From one stop to the next, fixed steps move alike.
        anew = jnp.asarray(True) if self.controller.adapts else state.jumped
        return self.stepper.fitted(state.factors, t0, t1, anew)

    def _inside(self, record: Record, theta: Any, guess: Tree | None) -> Tree:
        """x_h inside a step."""
        t0, stepper = record.start, self.stepper
        end = t0 + record.length
        flow, _ = local(stepper.method, stepper.flow, t0, end, record.x0, guess, stepper.ends)
        return inside(flow, record.length, theta, record.x0, record.coefficients)


def before(t: Any, x: Tree, flow: Flow, ends: tuple[Any, Any], jumped: Any) -> Tree:
    """x' before a stop; before the run nothing moves."""
    return lax.cond(
        jumped & (t > ends[0]),
        lambda: arriving(t, x, flow, ends),
        lambda: _tree.zeros_like(x),
    )


def behind(t: Any, x: Tree, flow: Flow, length: Any, ends: tuple[Any, Any], jumped: Any) -> Tree:
    """x' behind a stop, where a step of this length begins."""
    return lax.cond(
        jumped,
        lambda: velocity(flow, within(t, t + length, 0.0, ends), x),
        lambda: _tree.zeros_like(x),
    )


def slack(t: Any) -> Any:
    """How far a saved time may lie from the end of a step and still be it: both are rounded."""
    return 4 * jnp.finfo(t.dtype).eps * jnp.abs(t)
