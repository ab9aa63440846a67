"""The events of a run: recorded after each accepted step, and the resets.

An event that neither ends the run nor resets the state is located on the dense output of the step, like
a saved time, and changes no step. A step that contains another event is repeated and ends a little
behind it, at a time t. The event is at t + s with g(t + s, Φ_s(x)) = 0, where Φ is the flow. Newton's
method finds s < 0, and the run continues at t with

    x⁺ = Φ_{−s} R Φ_s(x),      s = s(x),

where R is the reset. The derivative of this map is the saltation matrix (Aizerman and Gantmakher 1958):
the time of the event depends on x, and t is a constant. Every derivative of a run with events follows.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._batch import any_lane
from .._failure import nan_derivatives_if_used
from .._tree import Tree
from .event import Event, Events
from .event_search import RESTART, Walk, arrives, next_event, touches
from .flow import Flow
from .outcome import Record
from .results import RESULTS
from .stepper import Stepper, dense_output, one_sided_time
from .time_derivatives import midpoint, velocity

_WINDOW, _SMALLEST_WINDOW = 1e-6, 1e-12
"""Largest and smallest distance of an event from the end of the step that ends behind it, in lengths of
the step. Behind a reset g must differ from zero by more than its rounding. Everything else wants it
small: the flow over it, in which A may be stiff, and the order of events."""

_BRACKET = 1e-13
"""Length of the interval in which an event is located, in lengths of the step."""

_MIN_ULPS, _BRACKET_ULPS = 16, 4
"""The smallest values of these, in roundings of t."""

_LEFT = 1e-2
"""Distance from an event, in widths, at which g is taken to have its slope before the event."""

_TOUCH = 2.0
"""An extremum of g counts as zero within this many tolerances."""

_ROUNDINGS = 1024.0
"""Roundings of the largest value of a function, below which its value is not told from zero."""

_ROUNDINGS_OF_U = 8.0
"""Roundoff of u, in roundings of its largest entry."""

_FEW_ENTRIES = 32
"""Number of entries of u up to which slopes in u are derivatives by forward mode."""

_LAW_WINDOW, _LAW_ERRORS = 4.0, 300.0
"""Errors of the law, in its tolerances, by which an event may lie before the end of a step that ends
behind it, and within which its time is found again."""

_ACCUMULATION = 8
"""Stops that follow each other by less than this many smallest distances are taken to accumulate."""

_STRAIGHT = 0.75
"""Ratio of g to its slope times the time since a reset below which g was reset to another slope."""


class Rows(NamedTuple):
    """A table of the events.

    - `time`: close to the event, a constant under differentiation; `index`: of the event in the list;
    - `step`: the number of the step, −1 at the start of the run; `at_end`: whether the step ends there;
    - `width`: the largest distance of the event from `time`, 0 where g only touches zero;
    - `x`: the state at `time`, before all resets.
    """

    time: Any
    index: Any
    step: Any
    at_end: Any
    width: Any
    x: Tree


class Watched(NamedTuple):
    """The state of the watch after a step.

    - `values`, `slopes` (per unit of time) of the functions; `sizes`: their largest values so far;
    - `reach`: the length over which the functions are resolved;
    - `rows`, `count`: the events so far; `stop`: the time of the last step that ended at an event.
    """

    values: jax.Array
    slopes: jax.Array
    sizes: jax.Array
    reach: Any
    rows: Rows
    count: Any
    stop: Any


class Observation(NamedTuple):
    """The result of watching a step.

    - `event`, `margin`: the time of the event for which the step must be repeated, ∞ if it stands, and
      how far behind the event the step must end;
    - `jumped`, `x`: whether the state was reset at the end of the step, and the state there;
    - `result`: `RESULTS.successful`, or the reason for which the run ends here.
    """

    watched: Watched
    event: Any
    margin: Any
    jumped: Any
    x: Tree
    result: RESULTS


class EventWatch(eqx.Module):
    """The events of a run; `at_start` says which of them happen at its start."""

    events: tuple[Event, ...]
    rtol: Any
    atol: Any
    at_start: jax.Array
    max_events: int = eqx.field(static=True)

    @property
    def _directions(self) -> jax.Array:
        return jnp.asarray([event.direction for event in self.events])

    @property
    def _stops(self) -> jax.Array:
        return jnp.asarray([event.stops for event in self.events])

    @property
    def _resets(self) -> list[int]:
        return [k for k, event in enumerate(self.events) if event.reset is not None]

    def _noise(self, sizes: jax.Array) -> jax.Array:
        """Return the values of the functions, given their largest ones, that are not told from zero: 0
        for an event that ends a step, since none of those may be missed."""
        return jnp.where(self._stops, 0.0, self._rounding(sizes))

    @staticmethod
    def _rounding(sizes: jax.Array) -> jax.Array:
        return _ROUNDINGS * jnp.finfo(sizes.dtype).eps * sizes

    def values(
        self, flow: Flow, t: Any, x: Tree, guess: Tree | None, inset: Any = 0.0
    ) -> jax.Array:
        """Return the values of all functions at t, with the response at t − `inset`."""
        return self._at(t, x, _response(flow, t - inset, x, guess), flow.args)

    def _at(self, t: Any, x: Tree, u: Tree, args: Any) -> jax.Array:
        """Return the values of all functions for the response u."""
        dtype = jnp.result_type(*jtu.tree_leaves(x))
        return jnp.stack(
            [jnp.asarray(e.function(t, x, u, args), dtype).reshape(()) for e in self.events]
        )

    def _law_error(self, flow: Flow, t: Any, x: Tree, guess: Tree | None) -> jax.Array:
        """Return by how much values differ with responses that all count as solved, up to roundoff, if
        each entry has the largest error."""
        y = flow.rate(t, x, None).y if guess is None else guess
        size = jnp.max(jnp.stack([jnp.max(jnp.abs(v), initial=0.0) for v in jtu.tree_leaves(y)]))
        error = _ROUNDINGS_OF_U * jnp.finfo(size.dtype).eps * size
        if flow.iterates:
            error += flow.law_tol(t, x, y)
        values = lambda y: self._at(t, x, flow.operator.inverse(y), flow.args)  # noqa: E731
        is_short = sum(leaf.size for leaf in jtu.tree_leaves(y)) <= _FEW_ENTRIES
        rows = jtu.tree_leaves((jax.jacfwd if is_short else jax.jacrev)(values)(y))
        return error * sum(jnp.sum(jnp.abs(row.reshape(len(row), -1)), axis=1) for row in rows)

    def along_flow(
        self, flow: Flow, t: Any, x: Tree, guess: Tree | None
    ) -> tuple[jax.Array, jax.Array]:
        """Return values and slopes on the solution through (t, x)."""
        found, solved = flow.rate(t, x, guess), flow.with_known_response()
        velocity = _tree.add(flow.generator.apply(x), found.value)
        value = lambda t, x: self.values(solved, t, x, found.y)  # noqa: E731
        return jax.jvp(value, (t, x), (jnp.ones_like(t), velocity))

    def start(self, flow: Flow, t0: Any, x0: Tree) -> tuple["EventWatch", Tree]:
        """Return the watch with the events at t0, those whose functions are zero there and leave zero
        in their direction, and the state behind their resets."""
        guess = flow.guess(x0)
        own, there, t, x = jtu.tree_map(_constant, (self, flow, t0, x0))
        values, slopes = own.along_flow(there, t, x, guess)
        direction = jnp.sign(slopes).astype(self._directions.dtype)
        counts = (self._directions == 0) | (self._directions == direction)
        fired = (values == 0) & counts
        x0, _ = self.jump(flow, t0, x0, fired, jnp.full(len(fired), jnp.inf), guess)
        return eqx.tree_at(lambda w: w.at_start, self, fired), x0

    def begin(self, flow: Flow, t0: Any, x0: Tree) -> Watched:
        """Return the state of the watch before the first step from x0, behind the resets at t0."""
        own, there, t, x = jtu.tree_map(_constant, (self, flow, t0, x0))
        guess = there.guess(x)
        values, slopes = own.along_flow(there, t, x, guess)
        values = _beyond(own._law_error(there, t, x, guess), values)
        many, dtype = self.max_events, t0.dtype
        rows = Rows(
            jnp.full(many, jnp.inf, dtype),
            jnp.full(many, -1),
            jnp.full(many, -1),
            jnp.zeros(many, bool),
            jnp.zeros(many, dtype),
            jtu.tree_map(lambda leaf: jnp.zeros((many, *leaf.shape), leaf.dtype), x0),
        )
        first = Rows(t0, -1, -1, True, jnp.full(len(self.events), jnp.inf), x0)
        rows, count = self._put(rows, self.at_start, jnp.asarray(0), first)
        # A function that is zero at the start, and stays unchanged, is not at a sign that it changes.
        unchanged = self.at_start & ~jnp.any(self.at_start & self._stops)
        values = jnp.where(unchanged, 0.0, values)
        infinite = jnp.full_like(t0, jnp.inf)
        return Watched(values, slopes, jnp.abs(values), infinite, rows, count, -infinite)

    def first_result(self) -> RESULTS:
        """Return the result before the first step: `RESULTS.terminal_event` if a terminal event happens
        at the start."""
        return self._result(jnp.sum(self.at_start), self.at_start, jnp.asarray(False))

    def _result(self, count: Any, fired: jax.Array, accumulates: Any) -> RESULTS:
        terminal = jnp.asarray([event.terminal for event in self.events])
        ends = jnp.any(fired & terminal)
        result = RESULTS.where(ends, RESULTS.terminal_event, RESULTS.successful)
        most = (count > self.max_events) | accumulates
        return RESULTS.where(most, RESULTS.max_events, result)

    def observe(
        self,
        stepper: Stepper,
        watched: Watched,
        step: Record,
        end: Any,
        x1: Tree,
        guess: Tree | None,
        number: Any,
        active: Any,
    ) -> Observation:
        """Watch the accepted step number `number`, to `end` and x1, if the lane is `active`."""
        search: Any = partial(EventWatch._search, active=active)
        walk, fired, widths, window, table, count = search(
            *jtu.tree_map(_constant, (self, stepper, watched, step, end, guess))
        )
        h, before, rows = end - step.start, watched.count, watched.rows
        time = lax.stop_gradient(step.start + walk.b * h)
        stops = jnp.any(fired & self._stops)
        at_end = stops & (end - time <= window)
        event, margin = jnp.where(stops & ~at_end, time, jnp.inf), 0.5 * window
        numbers = jnp.arange(self.max_events)
        new = (numbers >= before) & (numbers < count)
        rows = Rows(
            time=table.time,
            index=table.index,
            step=jnp.where(new, number, rows.step),
            at_end=rows.at_end & ~new,
            width=table.width,
            x=self._fill(stepper, rows.x, table.time, before, count, step, end, guess),
        )
        inside = Watched(
            values=walk.va,
            slopes=walk.da / h,
            sizes=jnp.maximum(watched.sizes, jnp.abs(walk.vb)),
            reach=walk.reach * h * jnp.where(at_end, RESTART, 1.0),
            rows=rows,
            count=count,
            stop=watched.stop,
        )
        own, flow, t, x = jtu.tree_map(_constant, (self, stepper.flow, end, x1))

        def stop() -> Observation:
            # What changes its sign between the event and the end of the step happens with it.
            reached = own.values(flow, t, x, guess)
            now = at_end & (fired | arrives(walk.va, reached, self._directions))
            x_after, shifts = self.jump(stepper.flow, end, x1, now, widths, guess)
            new = jtu.tree_map(_constant, x_after)
            values, slopes = own.along_flow(flow, t, new, guess)
            values = _beyond(own._law_error(flow, t, new, guess), values)
            end_row = Rows(t, -1, number, True, widths, x1)
            table, total = self._put(rows, now, count, end_row)
            accumulates = at_end & (t - watched.stop <= _ACCUMULATION * _MIN_ULPS * _ulp(t))
            # After the reset g returned through zero at once, instead of passing it at constant slope.
            crossed = now & (values != 0) & (jnp.sign(values) == jnp.sign(reached))
            bent = jnp.abs(values) < _STRAIGHT * jnp.abs(slopes * shifts)
            accumulates |= jnp.any(crossed & bent)
            # Where g is zero up to its rounding, its sign is that of its slope: 0 behind a reset to
            # rest, so that the event does not happen again where g goes on.
            is_zero = now & (jnp.abs(values) <= self._rounding(watched.sizes))
            values = jnp.where(is_zero, jnp.sign(slopes) * jnp.abs(values), values)
            after = inside._replace(
                values=jnp.where(at_end, values, inside.values),
                slopes=jnp.where(at_end, slopes, inside.slopes),
                rows=table,
                count=total,
                stop=jnp.where(at_end, t, watched.stop),
            )
            jumped = jnp.any(now & jnp.asarray([k in self._resets for k in range(len(now))]))
            result = self._result(total, now, accumulates)
            return Observation(after, event, margin, jumped, x_after, result)

        def go_on() -> Observation:
            none = jnp.zeros_like(fired)
            result = self._result(count, none, jnp.asarray(False))
            return Observation(inside, event, margin, jnp.asarray(False), x1, result)

        seen = lax.cond(any_lane(at_end), stop, go_on)
        finite = (
            jnp.all(jnp.isfinite(walk.vb)) & (~seen.jumped | _tree.all_finite(seen.x)) | ~active
        )
        return seen._replace(result=RESULTS.where(finite, seen.result, RESULTS.event_nonfinite))

    def _search(
        self,
        stepper: Stepper,
        watched: Watched,
        step: Record,
        end: Any,
        guess: Tree | None,
        active: Any,
    ) -> tuple[Walk, jax.Array, jax.Array, Any, Rows, Any]:
        """Walk along a step to its end, or to the first event at which it must end. Return the walk,
        which events happen where it stops, their widths, the largest distance of an event from the end
        of a step that ends there, a table with the times, indices and widths of the others, and the
        number of its rows."""
        t0, h, *_ = step
        at_x = dense_output(stepper.method, stepper.flow, step, guess, stepper.ends, end)
        inset = end - one_sided_time(t0, end, 1.0, stepper.ends)
        # No step follows the last one, which has the events at t1.
        is_last = end >= stepper.ends[1]

        def values(theta: Any) -> jax.Array:
            at_end = theta >= 1.0
            before = jnp.where(at_end, inset, 0.0)
            t = jnp.where(at_end & is_last, end, t0 + theta * h - before)
            inside = jnp.where(is_last, before, 0.0)
            return self.values(stepper.flow, t, at_x(theta), guess, inside)

        law_error = self._law_error(stepper.flow, end, at_x(1.0), guess)

        def at(theta: Any) -> tuple[jax.Array, jax.Array]:
            value, slope = jax.jvp(values, (theta,), (jnp.ones_like(theta),))
            return _beyond(law_error, value), slope

        touch = _TOUCH * (self.atol + self.rtol * watched.sizes)
        ulp = jnp.maximum(_ulp(t0), _ulp(end)) / h + jnp.finfo(t0.dtype).eps
        shortest = jnp.maximum(_BRACKET, _BRACKET_ULPS * ulp)
        limits = self._directions, touch, self._noise(watched.sizes), shortest
        width, rounding = _width(t0, end), self._rounding(watched.sizes)

        def happens(walk: Walk) -> tuple[jax.Array, jax.Array, Any]:
            arrived = arrives(walk.va, walk.vb, self._directions)
            near = touches(walk.va, walk.da, walk.vb, walk.db, walk.b - walk.a, *limits[:2])
            fired = walk.found & walk.above & (arrived | near)
            # In a short step, as from a kink to the next, g is rounded by more than it changes in it.
            flattest, steepest = (
                of(jnp.abs(walk.da), jnp.abs(walk.db)) / h for of in (jnp.minimum, jnp.maximum)
            )
            time_of = lambda error, slope: error / jnp.where(slope == 0, jnp.inf, slope)  # noqa: E731
            farthest = lambda times: jnp.max(jnp.where(fired & self._stops, times, 0.0))  # noqa: E731
            window = jnp.clip(
                farthest(time_of(rounding, flattest)), _width(t0, end, _SMALLEST_WINDOW), width
            )
            # Where g is constant behind the event, its slope is that before it.
            of_law = time_of(law_error, steepest)
            window = jnp.maximum(window, farthest(_LAW_WINDOW * of_law))
            widths = jnp.minimum(width + time_of(rounding, steepest) + _LAW_ERRORS * of_law, h)
            return fired, jnp.where(near & ~arrived, 0.0, widths), window

        def one(carry: tuple[Walk, Rows, Any]) -> tuple[Walk, Rows, Any]:
            walk, table, count = carry
            walk = next_event(walk, at, *limits)
            fired, widths, _ = happens(walk)
            onward = walk.found & ~jnp.any(fired & self._stops)
            row = Rows(t0 + walk.b * h, -1, None, None, widths, None)
            table, count = self._put(table, fired & onward, count, row)
            return _tree.where(onward, walk.onward(shortest), walk), table, count

        def goes_on(carry: tuple[Walk, Rows, Any]) -> Any:
            walk, _, count = carry
            return ~(walk.found | walk.ended) & (count <= self.max_events)

        reach = jnp.minimum(watched.reach / h, 1.0)
        first = Walk.at(jnp.zeros_like(t0), watched.values, watched.slopes * h, reach, shortest)
        first = first._replace(ended=~active)
        table = watched.rows._replace(step=None, at_end=None, x=None)
        carry = first, table, watched.count
        walk, table, count = lax.while_loop(goes_on, one, carry)
        return walk, *happens(walk), table, count

    def _fill(
        self,
        stepper: Stepper,
        table: Tree,
        times: jax.Array,
        before: Any,
        count: Any,
        step: Record,
        end: Any,
        guess: Tree | None,
    ) -> Tree:
        """Return the table with the states of the events inside a step."""
        at_x = dense_output(stepper.method, stepper.flow, step, guess, stepper.ends, end)
        last = jnp.minimum(count, self.max_events)

        def one(carry: tuple[Any, Tree]) -> tuple[Any, Tree]:
            k, table = carry
            row = jnp.minimum(k, self.max_events - 1)
            theta = (times[row] - step.start) / step.length
            return k + 1, _tree.put_if(k < last, table, row, at_x(theta))

        return lax.while_loop(lambda carry: any_lane(carry[0] < last), one, (before, table))[1]

    def _put(self, rows: Rows, fired: jax.Array, count: Any, row: Rows) -> tuple[Rows, Any]:
        """Return the table with a row for each event that fired at one time, as far as there is room,
        and the number of events."""
        like = jtu.tree_map(lambda new, table: jnp.asarray(new, table.dtype), row, rows)
        # `index` and `width` differ from event to event.

        def put(k: Any, carry: tuple[Rows, Any]) -> tuple[Rows, Any]:
            rows, count = carry
            new = like._replace(index=k.astype(rows.index.dtype), width=like.width[k])
            place = jnp.minimum(count, self.max_events - 1)
            rows = _tree.put_if(fired[k] & (count < self.max_events), rows, place, new)
            return rows, jnp.where(fired[k], count + 1, count)

        return lax.fori_loop(0, len(self.events), put, (rows, count))

    def jump(
        self, flow: Flow, t: Any, x: Tree, fired: jax.Array, widths: jax.Array, guess: Tree | None
    ) -> tuple[Tree, jax.Array]:
        """Return the state at t after the resets of the events that fired at most `widths` before t, in
        the order of the list, given the state x without these resets; and s ≤ 0 for each event."""
        resets, none = jnp.asarray(self._resets, int), jnp.zeros(len(self.events), t.dtype)
        if not self._resets:
            return x, none

        def shift(k: Any) -> Any:
            find = partial(self._shift, flow, t, x, k, fired[k], widths[k], guess)
            return lax.cond(any_lane(fired[k]), find, lambda: jnp.zeros_like(t))

        shifts = none.at[resets].set(lax.map(shift, resets))

        def change(x: Tree, k: Any) -> tuple[Tree, None]:
            """Apply Φ_{−s} R Φ_s for the reset R of event k and its s."""

            def changed(x: Tree) -> Tree:
                then = t + shifts[k]
                after = self._behind(flow, then, _flow_by(flow, t, x, shifts[k]), k, guess)
                return _flow_by(flow, then, after, -shifts[k])

            new = lax.cond(any_lane(fired[k]), changed, lambda x: x, x)
            return _tree.where(fired[k], new, x), None

        return lax.scan(change, x, resets)[0], shifts

    def _behind(self, flow: Flow, t: Any, x: Tree, k: Any, guess: Tree | None) -> Tree:
        """Return the state behind event number k at (t, x)."""
        if not self._resets:
            return x
        u = _response(flow, t, x, guess)

        def of(event: Event, x: Tree) -> Tree:
            if event.reset is None:
                return x
            # A reset may return whole numbers.
            after = event.reset(t, x, u, flow.args)
            return jtu.tree_map(lambda a, b: jnp.asarray(a, b.dtype), after, x)

        return lax.switch(k, [partial(of, event) for event in self.events], x)

    def _shift(
        self, flow: Flow, t: Any, x: Tree, k: Any, fired: Any, width: Any, guess: Tree | None
    ) -> Any:
        """Return s with g(t + s, Φ_s(x)) = 0 for event k: three steps of Newton's method, all from the
        left of the event, since g may be constant behind it, as where the law saturates.

        At an extremum that touches zero, and where g jumps, s is 0 and its derivatives are NaN.
        """

        reach = jnp.where(jnp.isfinite(width), width, 0.0)

        def newton(number: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            s = carry[0] - lefts[number]
            values, slopes = self.along_flow(flow, t + s, _flow_by(flow, t, x, s), guess)
            slope = slopes[k]
            return s - values[k] / jnp.where(slope == 0, 1.0, slope), slope != 0

        # The derivatives of two steps from the zero are those of the zero, up to the second.
        start = jnp.zeros_like(t), jnp.asarray(True)
        lefts = reach * jnp.asarray([1.0, _LEFT, _LEFT], t.dtype)
        s, exists = lax.fori_loop(0, 3, newton, start)
        exists &= jnp.abs(s) <= 2.0 * width
        s = jnp.where(fired & exists, s, 0.0)
        (s,) = nan_derivatives_if_used(fired & ~exists, [s], (flow, t, x))
        return s

    def fired(self, rows: Rows, count: Any, step: Any) -> tuple[jax.Array, jax.Array]:
        """Return which events happened at the end of a step, and their widths."""
        own = (jnp.arange(self.max_events) < count) & rows.at_end & (rows.step == step)
        of_event = [own & (rows.index == k) for k in range(len(self.events))]
        widths = [jnp.max(jnp.where(mine, rows.width, 0.0)) for mine in of_event]
        return jnp.stack([jnp.any(mine) for mine in of_event]), jnp.stack(widths)

    def finish(self, flow: Flow, rows: Rows, count: Any, t0: Any, x0: Tree) -> Events:
        """Return the events of a run from (t0, x0), the state before the resets at t0."""
        at_start = rows.step < 0
        rows = rows._replace(
            time=jnp.where(at_start & (rows.index >= 0), t0, rows.time),
            x=jtu.tree_map(lambda a, b: jnp.where(_tree.wide(at_start, a), b, a), rows.x, x0),
        )
        valid = jnp.arange(self.max_events) < count
        guess = flow.guess(x0)

        def one(before: tuple[Any, Tree], given: tuple[Any, Rows]) -> tuple[Any, Any]:
            valid, row = given

            def happen() -> tuple[Any, Any, Tree, Tree, Tree]:
                step, x = before
                # Events at the end of one step see the states that the earlier ones left.
                x = _tree.where(row.at_end & (step == row.step), x, row.x)
                s = self._shift(flow, row.time, row.x, row.index, valid, row.width, guess)
                seen = _flow_by(flow, row.time, x, s)
                after = self._behind(flow, row.time + s, seen, row.index, guess)
                kept = _flow_by(flow, row.time + s, after, -s) if self._resets else x
                step = jnp.where(row.at_end, row.step, -2)
                return step, row.time + s, seen, after, kept

            def skip() -> tuple[Any, Any, Tree, Tree, Tree]:
                nan = jtu.tree_map(lambda leaf: jnp.full_like(leaf, jnp.nan), row.x)
                return before[0], jnp.full_like(row.time, jnp.inf), nan, nan, before[1]

            step, time, seen, after, kept = lax.cond(valid, happen, skip)
            return (step, kept), (time, seen, after)

        first = jnp.full_like(count, -2), jtu.tree_map(lambda leaf: leaf[0], rows.x)
        _, (times, seen, after) = lax.scan(one, first, (valid, rows))
        index = jnp.where(valid, rows.index, -1)
        return Events(times, index, seen, after, tuple(event.name for event in self.events))


def _constant(leaf: Any) -> Any:
    return lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf


def _response(flow: Flow, t: Any, x: Tree, guess: Tree | None) -> Tree:
    return flow.operator.inverse(flow.rate(t, x, guess).y)


def _beyond(error: Any, values: jax.Array) -> jax.Array:
    """Return the values, and 0 within their error: there they have no sign, as those of a response that
    stays at a bound."""
    return jnp.where(jnp.abs(values) <= error, 0.0, values)


def _flow_by(flow: Flow, t: Any, x: Tree, s: Any) -> Tree:
    """Return Φ_s(x) up to O(s³)."""
    return midpoint(x, s, velocity, t, flow)


def _ulp(t: Any) -> Any:
    return jnp.finfo(t.dtype).eps * jnp.abs(t)


def _width(t0: Any, t1: Any, window: float = _WINDOW) -> Any:
    """Return a distance of an event from the end of a step that ends behind it."""
    ulp = jnp.maximum(_ulp(t0), _ulp(t1))
    eps = jnp.finfo(t0.dtype).eps
    return jnp.maximum(jnp.maximum(window, _MIN_ULPS * eps) * (t1 - t0), _MIN_ULPS * ulp)
