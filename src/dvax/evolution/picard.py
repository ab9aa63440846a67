"""Picard iteration for the fixed point of the paper, parallel in time.

The mild solution is the fixed point of (Sx)(t) = e^{A(t−a)}x(a) + ∫ₐᵗ e^{A(t−s)} f̃(s, x(s)) ds, which
contracts in the norm sup e^{−λ(t−a)}‖x(t)‖ for large λ (paper, eq:Sop). Each sweep applies S to a
window of times: it evaluates f̃ at all times in one batch, interpolates linearly between them (p), and
integrates p exactly by propagators. The fixed point is that of the exponential trapezoidal rule, of
order 2. The defect p − f̃(·, x_h) measures the distance of the iterate from the solution. It is
sampled, or enclosed, as for the other methods.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._jax import forward_only
from .._tree import Tree
from ..errors import input_error
from ..generators import AbstractGenerator, AbstractPropagator
from .bounds import Bounds
from .control import clip_to_stop
from .flow import Flow
from .law_tolerance import RootMeanSquares
from .method import ETD2RK
from .outcome import Outcome, Record, Saved, end_alone, ended, with_tangents
from .results import RESULTS
from .setup import Options, Setup
from .stepper import Stepper, interpolate, one_sided_time
from .time_derivatives import zero_with_tangent


class Picard(eqx.Module):
    """Picard iteration on windows of `nodes` steps, parallel over the times of a window.

        X^{k+1}(t) = e^{A(t−a)}x(a) + ∫ₐᵗ e^{A(t−s)} p^k(s) ds,     p^k linear through f̃(tᵢ, X^k(tᵢ))

    Each sweep solves the frozen law at all times of the window as one batch. The integrals take
    log₂(`nodes`) operations in sequence on an accelerator, and `nodes` operations on a CPU. The error
    decreases as (M L̃ W)^k/k! for a window of length W, so windows of a few times 1/L̃ take about ten
    sweeps. The order is 2, as for `ETD2RK`, which needs fewer evaluations on a CPU: this method is for
    many cores and few unknowns. The window length is adaptive: the integrated defect must be at most
    its share of the tolerance, and a window that does not converge is shortened.

    `Solution.stats` also has `windows`, the total number of `sweeps`, and `contraction`: the largest
    observed ratio of two successive corrections, in the maximum norm over a window.
    `dvax.Constants.bielecki_factor` bounds it in the λ-norm. Every window has `nodes` equal steps, so
    fixed steps are shorter than `dt` on a short interval between knots.

    It has forward derivatives only (`jax.jvp`, `jax.jacfwd`).

    **Arguments:** `nodes`: the number of steps of a window; `max_sweeps`: the largest number of sweeps
    in one window.

    **Raises:** `dvax.InputError` if these are not positive integers.

    Source: the paper, Section 4; in parallel: Wu and Chen, SIAM J. Sci. Comput. 42 (2020).

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> sol = dvax.solve(problem, -1.0, 0.0, 2.0, method=dvax.Picard(), rtol=1e-4)
    >>> print(f"{float(sol.xs[0]):.5f}", bool(sol.stats["contraction"] < 1))
    1.83609 True

    ```
    """

    nodes: int = 64
    max_sweeps: int = 50

    order: ClassVar[int] = 2
    degree: ClassVar[int] = 1
    is_rosenbrock: ClassVar[bool] = False

    def __check_init__(self) -> None:
        for name in ("nodes", "max_sweeps"):
            given = getattr(self, name)
            if not isinstance(given, int) or given < 1:
                raise input_error(
                    f"dvax.Picard({name})", repr(given), "it must be a positive integer",
                    "64 nodes and 50 sweeps are the defaults",
                )  # fmt: skip


class Window(NamedTuple):
    """The result of the sweeps on a window.

    - `record`: the steps; `after`: the states at their ends; `end`: the state at the end of the window;
    - `error`, `integrated_defect`: the error estimate and the defect of each step;
    - `bounds`: bounds on x_h and u_h, None if they are not tracked;
    - `converged`: the law was solved at all times, and the sweeps converged.
    """

    record: Record
    after: Tree
    end: Tree
    error: Tree
    integrated_defect: tuple[jax.Array, jax.Array]
    bounds: Bounds | None
    converged: jax.Array
    sweeps: jax.Array
    contraction: jax.Array


class State(NamedTuple):
    """The state of a run at time t, after `steps` accepted steps and `windows` attempted windows.

    `last` holds the steps of the last window, and `completed_defect` the defect up to its start.
    """

    t: Any
    x: Tree
    length: Any
    stop: Any
    last: Record
    completed_defect: tuple[Any, Any]
    integrated_defect: tuple[Any, Any]
    bounds: Bounds | None
    records: Record | None
    steps: Any
    windows: Any
    rejected: Any
    sweeps: Any
    contraction: Any
    result: RESULTS


class Run(eqx.Module):
    """A run over windows from the first stop to the last.

    With `fixed` steps their length is at most `first`. Otherwise `first` is the first length, and the
    control keeps the `size` of the defect below 1. A window has converged when the change of f̃ by a
    sweep is no longer `is_significant`.
    """

    method: Picard
    stepper: Stepper
    stops: jax.Array
    fixed: bool = eqx.field(static=True)
    first: Any
    size: Callable[[Tree, Tree, Tree], Any]
    is_significant: Callable[[Tree, Tree, Tree], Any]
    max_windows: int = eqx.field(static=True)
    dense: bool = eqx.field(static=True)

    def solve(self, x0: Tree, ts: jax.Array | None) -> tuple[Saved | None, State]:
        """Return the rows at the times `ts`, and the state at the end of the run."""
        state = self._start(x0)
        if ts is None:
            return None, self._advance_to(state, self.stops[-1])
        times, count = lax.stop_gradient(ts), ts.shape[0]
        blank = jax.eval_shape(lambda: self._row(state, times[0]))
        rows = jtu.tree_map(lambda s: jnp.zeros((count, *s.shape), s.dtype), blank)

        def visit(k: Any, carry: tuple[State, Saved]) -> tuple[State, Saved]:
            state, rows = carry
            state = self._advance_to(state, times[k])
            return state, _tree.put(rows, k, self._row(state, times[k]))

        state, rows = lax.fori_loop(0, count, visit, (state, rows))
        return rows, self._advance_to(state, self.stops[-1])

    def _start(self, x0: Tree) -> State:
        t0, nodes = self.stops[0], self.method.nodes
        zero = jnp.zeros_like(t0)
        blank = _tree.zeros_like(x0)
        one = Record(t0, zero, x0, (blank, blank))
        rows = lambda n: jtu.tree_map(  # noqa: E731
            lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), one
        )
        records = None
        if self.dense:
            records = rows(self.max_windows * nodes)
            records = records._replace(start=jnp.full_like(records.start, jnp.inf))
        nought = jnp.asarray(0)
        return State(
            t0, x0, nodes * self.first, jnp.asarray(1), rows(nodes), (zero, zero), (zero, zero),
            self.stepper.bounds(x0), records, nought, nought, nought, nought, zero, RESULTS.successful,
        )  # fmt: skip

    def _advance_to(self, state: State, time: Any) -> State:
        def should_continue(state: State) -> Any:
            is_successful = state.result == RESULTS.successful
            return (state.t < time) & is_successful & (state.windows < self.max_windows)

        return lax.while_loop(should_continue, lambda state: self._attempt(state), state)

    def _attempt(self, state: State) -> State:
        a, nodes, stop = state.t, self.method.nodes, self.stops[state.stop]
        if self.fixed:
            # Divide the rest of the interval into the smallest number of equal windows.
            count = jnp.maximum(jnp.ceil((stop - a) / state.length * (1 - 1e-12)), 1.0)
            b = jnp.where(count > 1, a + (stop - a) / count, stop)
        else:
            b = clip_to_stop(a, state.length, stop)
        window = self._window(a, b, state.x)
        ratio = self.size(window.error, window.record.x0, window.after)
        is_accepted = window.converged & _tree.all_finite(window.end)
        length = state.length
        has_failed = ~is_accepted
        if not self.fixed:
            is_accepted = is_accepted & (ratio <= 1.0)
            positive = jnp.where(ratio > 0.0, ratio, 1.0)
            factor = jnp.where(ratio > 0.0, jnp.sqrt(0.5 / positive), jnp.inf)
            factor = jnp.where(window.converged, jnp.clip(factor, 0.1, 4.0), 0.25)
            # A knot may have shortened this window, so an accepted window does not reduce the length.
            length = lax.stop_gradient(factor * (b - a))
            is_longer = is_accepted & (factor > 1.0)
            length = jnp.where(is_longer, jnp.maximum(length, state.length), length)
            floor = 8 * nodes * jnp.finfo(a.dtype).eps * jnp.maximum(jnp.abs(a), jnp.abs(b))
            has_failed = ~is_accepted & (b - a <= floor)
        unconverged = RESULTS.where(
            window.converged, RESULTS.step_too_small, RESULTS.picard_unconverged
        )
        unconverged = RESULTS.where(_tree.all_finite(window.end), unconverged, RESULTS.nonfinite)
        integrated_defect = jtu.tree_map(
            lambda v, w: v + jnp.sum(w), state.integrated_defect, window.integrated_defect
        )
        records = state.records
        if records is not None:
            indices = state.steps + jnp.arange(nodes)
            start = jnp.where(is_accepted, window.record.start, jnp.inf)
            steps = window.record._replace(start=start)
            records = jtu.tree_map(lambda leaf, new: leaf.at[indices].set(new), records, steps)
        last = self.stops.shape[0] - 1
        next_stop = jnp.where(is_accepted & (b == stop), state.stop + 1, state.stop)
        bounds = state.bounds
        if bounds is not None:
            assert window.bounds is not None
            bounds = bounds.hull(window.bounds)
        new = (b, window.end, window.record, state.integrated_defect, integrated_defect, bounds)
        old = (
            a, state.x, state.last, state.completed_defect, state.integrated_defect, state.bounds,
        )  # fmt: skip
        t, x, record, completed_defect, integrated_defect, bounds = _tree.where(
            is_accepted, new, old
        )
        return State(
            t, x, length, jnp.minimum(next_stop, last), record, completed_defect, integrated_defect,
            bounds, records,
            jnp.where(is_accepted, state.steps + nodes, state.steps), state.windows + 1,
            jnp.where(is_accepted, state.rejected, state.rejected + nodes),
            state.sweeps + window.sweeps,
            jnp.maximum(state.contraction, jnp.where(is_accepted, window.contraction, 0.0)),
            RESULTS.where(has_failed, unconverged, RESULTS.successful),
        )  # fmt: skip

    def _window(self, a: Any, b: Any, x: Tree) -> Window:
        stepper, nodes = self.stepper, self.method.nodes
        flow = stepper.flow
        h = (b - a) / nodes
        steps = jnp.arange(nodes + 1).astype(h.dtype)
        ends = (a + h * steps).at[-1].set(b)
        times = ends.at[0].set(one_sided_time(a, b, 0.0, stepper.ends))
        times = times.at[-1].set(one_sided_time(a, b, 1.0, stepper.ends))
        propagator = flow.propagator(h, 2)
        space = flow.state_space(x)
        norm = jax.vmap(space.norm)

        def trajectory(value: Tree) -> Tree:
            """Return the trajectory under p, which interpolates these values of f̃ linearly."""
            c = _linear_pieces(value)
            increments = jax.vmap(lambda *c: propagator.step(_tree.zeros_like(x), c))(*c)
            return _accumulate(flow.generator, propagator, h, x, increments)

        def rates(X: Tree, Y: Tree | None) -> Any:
            return jax.vmap(flow.rate)(times, X, Y)

        constant = jtu.tree_map(lambda leaf: jnp.broadcast_to(leaf, (nodes + 1, *leaf.shape)), x)
        guess = flow.guess(x)
        if guess is not None:
            guess = jtu.tree_map(
                lambda leaf: jnp.broadcast_to(leaf, (nodes + 1, *leaf.shape)), guess
            )
        first_rates = rates(constant, guess)
        X = trajectory(first_rates.value)
        first_change = jnp.max(norm(_tree.sub(X, constant)))
        zero, yes = jnp.zeros_like(first_change), jnp.asarray(True)

        def should_continue(carry: Any) -> Any:
            k, _, _, change, _, is_significant = carry
            return is_significant & (k < self.method.max_sweeps) & (change < jnp.inf)

        def sweep(carry: Any) -> Any:
            k, X, last, last_change, contraction, _ = carry
            new = rates(X, None if guess is None else last.y)
            new_X = trajectory(new.value)
            change = jnp.max(norm(_tree.sub(new_X, X)))
            ratio = change / jnp.where(last_change > 0.0, last_change, 1.0)
            # The ratio of corrections of the size of roundoff is meaningless.
            floor = 1e4 * jnp.finfo(h.dtype).eps * (1.0 + jnp.max(norm(new_X)))
            contraction = jnp.where(change > floor, jnp.maximum(contraction, ratio), contraction)
            rate_change = _tree.sub(new.value, last.value)
            is_significant = self.is_significant(rate_change, new_X, new.value)
            return k + 1, new_X, new, change, contraction, is_significant

        first = (jnp.asarray(1), X, first_rates, first_change, zero, yes)
        k, X, last, _, contraction, is_significant = lax.while_loop(should_continue, sweep, first)
        converged = jnp.all(last.solved) & ~is_significant
        c = _linear_pieces(last.value)
        start, end = _rows(X, slice(-1)), _rows(X, slice(1, None))
        ys = None if guess is None else _rows(last.y, slice(-1))
        sample, is_measured = jax.vmap(stepper.estimate_defect)(
            ends[:-1], ends[1:], start, end, c, ys
        )
        integrated_defect = sample.defect, sample.law_defect
        record = Record(ends[:-1], jnp.broadcast_to(h, (nodes,)), start, c)
        return Window(
            record, end, _rows(X, -1), sample.error, integrated_defect,
            sample.bounds.hull_of_rows() if stepper.track_bounds else None,
            converged & jnp.all(is_measured), k, contraction,
        )  # fmt: skip

    def _row(self, state: State, time: Any) -> Saved:
        """Return the trajectory at a time in the last window; t = ∞ if the run did not reach it."""
        record = state.last
        i = jnp.sum(record.start <= time) - 1
        step = jtu.tree_map(lambda leaf: leaf[jnp.maximum(i, 0)], record)
        theta = (time - step.start) / jnp.where(step.length > 0, step.length, 1)
        reached = state.t >= time
        is_end = time >= state.t
        x = lax.cond(
            is_end,
            lambda: state.x,
            lambda: interpolate(self.stepper.flow, step.length, theta, step.x0, step.coefficients),
        )
        x = jtu.tree_map(lambda leaf: jnp.where(reached, leaf, jnp.nan), x)
        is_inside = time > record.start[0]
        integrated_defect = _tree.where(is_inside, state.integrated_defect, state.completed_defect)
        completed_defect = _tree.where(
            time >= state.t, state.integrated_defect, state.completed_defect
        )
        # At the end of a window the row has the tangent of that time.
        time = time + zero_with_tangent(jnp.where(is_end, state.t, 0.0))
        return Saved(
            jnp.where(reached, time, jnp.inf), x, integrated_defect, completed_defect, state.bounds
        )


def solve_by_windows(
    setup: Setup,
    method: Picard,
    flow: Flow,
    stops: jax.Array,
    ts: jax.Array | None,
    options: Options,
) -> Outcome:
    """Solve by `Picard` from the first stop to the last."""
    x0 = setup.x0
    growth = flow.generator.growth(flow.state_space(x0)) if flow.enclosed else None
    ends = stops[0], stops[-1]
    stepper = Stepper(
        ETD2RK(), flow, True, False, None, options.track_bounds, True, False, ends, None, growth
    )
    rtol, atol, horizon = map(setup.number, ("rtol", "atol", "horizon"))
    sizes = jax.vmap(lambda *parts: jnp.stack(RootMeanSquares(setup.problem.spaces(x0)[0])(*parts)))

    def size(error: Any, completed_defect: Any, after: Any) -> Any:
        """Return the defect in units of the tolerance, averaged over the steps of the window.

        (The maximum would reject windows for an event in a single step.)
        """
        scale = atol + rtol * jnp.maximum(sizes(completed_defect), sizes(after))
        ratio = horizon * jnp.max(jnp.mean(sizes(error) / scale, axis=0))
        return jnp.where(jnp.isnan(ratio), jnp.inf, ratio)

    def is_significant(change: Any, X: Any, value: Any) -> Any:
        """Return whether a change of f̃ exceeds roundoff, and 0.01 of the tolerance if steps adapt."""
        largest = lambda v: jnp.max(sizes(v))  # noqa: E731
        # A law that is solved by iteration has the rounding of its solver.
        roundings = 20 if flow.direct else 1000
        rounding = roundings * jnp.finfo(setup.dtype).eps * largest(value)
        exceeds_rounding = ~(largest(change) <= rounding)
        return (
            exceeds_rounding if options.fixed else exceeds_rounding & ~(size(change, X, X) <= 0.01)
        )

    first = setup.number("dt") if options.fixed else setup.number("dt0")
    windows = max(1, -(-options.max_steps // method.nodes))
    if options.fixed:
        # The number of windows is rounded up on each interval between two knots.
        windows += stops.shape[0]
    run = Run(
        method, stepper, stops, options.fixed, first, size, is_significant,
        windows, options.dense,
    )  # fmt: skip
    saved, end = forward_only(run.solve(x0, ts))
    complete = end.t >= stops[-1]
    rows = end_alone(end, complete, stops[-1], True, None) if saved is None else saved
    if ts is not None:
        ends = lax.stop_gradient((stops[0], stops[-1]))
        rows = with_tangents(rows, ts, x0, flow, ends)
    stats = {
        "steps": end.steps, "rejected": end.rejected, "t": end.t, "x": end.x,
        "next_dt": end.length / method.nodes, "windows": end.windows, "sweeps": end.sweeps,
        "contraction": end.contraction,
    }  # fmt: skip
    return Outcome(rows, stats, ended(end.result, complete), end.records)


def _linear_pieces(value: Tree) -> tuple[Tree, Tree]:
    """Return (c₀, c₁) of each step from the values of f̃ at its ends."""
    left = _rows(value, slice(-1))
    return left, _tree.sub(_rows(value, slice(1, None)), left)


def _rows(tree: Tree, cut: Any) -> Tree:
    """Return the rows `cut` of each leaf."""
    return jtu.tree_map(lambda leaf: leaf[cut], tree)


def _accumulate(
    A: AbstractGenerator, propagator: AbstractPropagator, h: Any, x: Tree, increments: Tree
) -> Tree:
    """Return all states x₀ = x, xᵢ₊₁ = e^{hA}xᵢ + incrementsᵢ, stacked."""
    first = jtu.tree_map(lambda leaf: leaf[None], x)
    terms = jtu.tree_map(lambda a, b: jnp.concatenate([a, b]), first, increments)
    return lax.platform_dependent(
        terms,
        cpu=lambda terms: accumulate_sequentially(propagator, terms),
        default=lambda terms: accumulate_by_doubling(A, h, terms),
    )


def accumulate_sequentially(propagator: AbstractPropagator, terms: Tree) -> Tree:
    """Return all x₀ = terms₀, xᵢ = e^{hA}xᵢ₋₁ + termsᵢ, computed one after the other."""

    def advance(x: Tree, term: Tree) -> tuple[Tree, Tree]:
        new = _tree.add(propagator.step(x, ()), term)
        return new, new

    start = _rows(terms, 0)
    _, xs = lax.scan(advance, start, _rows(terms, slice(1, None)))
    return jtu.tree_map(lambda a, b: jnp.concatenate([a[None], b]), start, xs)


def accumulate_by_doubling(A: AbstractGenerator, h: Any, terms: Tree) -> Tree:
    """Return the states of `accumulate_sequentially` by a parallel prefix sum.

    After r of log₂(count) passes, entry i is the sum of e^{(i−j)hA}termsⱼ over the last 2ʳ entries
    j ≤ i.
    """
    count, distance = jtu.tree_leaves(terms)[0].shape[0], 1
    while distance < count:
        shifted = jax.vmap(lambda v, k=distance: A.semigroup(k * h, v))(
            _rows(terms, slice(-distance))
        )
        terms = jtu.tree_map(lambda leaf, m, k=distance: leaf.at[k:].add(m), terms, shifted)
        distance *= 2
    return terms
