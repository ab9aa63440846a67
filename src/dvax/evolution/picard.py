"""The paper's own fixed point, many times at once.

The mild solution is the fixed point of (Sx)(t) = e^{A(t−a)}x(a) + ∫ₐᵗ e^{A(t−s)} f̃(s, x(s)) ds, which
contracts in the norm sup e^{−λ(t−a)}‖x(t)‖ for λ large (paper, eq:Sop). Here S is applied to a
window of times as a whole: f̃ at all of them in one batch, p linear between them, and the integral
exactly, by propagators. The fixed point is the trapezoidal one, of order 2; how far the iterate is from
it shows in the defect p − f̃(·, x_h), which is sampled, or enclosed, as for any other method.
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
from ..errors import InputError, InputProblem
from ..generators import AbstractGenerator, AbstractPropagator
from .bounds import Bounds
from .control import clip_to_stop, root_mean_squares
from .flow import Flow
from .method import ETD2RK
from .outcome import Outcome, Record, Saved, end_alone, ended, with_tangents
from .results import RESULTS
from .setup import Options, Setup
from .stepper import Stepper, interpolate, one_sided_time
from .time_derivatives import zero_with_tangent


class Picard(eqx.Module):
    """Picard's iteration on windows of `nodes` steps, all of whose times are computed at once.

        X^{k+1}(t) = e^{A(t−a)}x(a) + ∫ₐᵗ e^{A(t−s)} p^k(s) ds,     p^k linear through f̃(tᵢ, X^k(tᵢ))

    Each sweep solves the frozen law at all times of the window as one batch; the integral takes as many
    turns as the logarithm of `nodes` on an accelerator, and one after the other on a CPU. The error
    falls as (M L̃ W)^k/k! for a window of length W, so windows of a few times 1/L̃ take some ten sweeps.
    Order 2, as `ETD2RK`, which on a CPU needs fewer evaluations: this is for many cores and few
    unknowns. Windows are as long as the defect integrated over them is at most its share of the
    tolerance; one that does not converge is shortened.

    `Solution.stats` has besides the usual: `windows`, `sweeps` (of all of them) and `contraction`, the
    largest ratio of two successive corrections in the largest norm over a window: an observation.
    `dvax.Constants.bielecki_factor` bounds it in the λ-norm. Every window has `nodes` equal steps, so
    fixed steps are shorter than `dt` on a short stretch.

    Forward derivatives only (`jax.jvp`, `jax.jacfwd`).

    **Arguments:** `nodes`: steps of a window; `max_sweeps`: the most in one window.

    **Raises:** `dvax.InputError` where these are no positive integers.

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
                raise InputError(
                    InputProblem(
                        f"dvax.Picard({name})", repr(given), "it must be a positive integer",
                        "64 nodes and 50 sweeps are the defaults",
                    )
                )  # fmt: skip


class Window(NamedTuple):
    """The steps of a window from a to b as one record, the states `after` each, the state at b, the
    defect of each step, the bounds of all, and how the sweeps went; `converged` says that the law was
    solved everywhere and the sweeps converged."""

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
    """Where the run stands: at t with x, after `steps` kept steps and `windows` attempted windows."""

    t: Any
    x: Tree
    length: Any
    stop: Any
    last: Record
    before: tuple[Any, Any]
    integrated_defect: tuple[Any, Any]
    bounds: Bounds | None
    records: Record | None
    steps: Any
    windows: Any
    refused: Any
    sweeps: Any
    contraction: Any
    result: RESULTS


class Run(eqx.Module):
    """Windows from the first stop to the last. `fixed` steps are no longer than `first`; others adapt
    to keep the `size` of the defect below 1. A window has converged where a sweep changes f̃ by so
    little that it `matters` no more."""

    method: Picard
    stepper: Stepper
    stops: jax.Array
    fixed: bool = eqx.field(static=True)
    first: Any
    size: Callable[[Tree, Tree, Tree], Any]
    matters: Callable[[Tree, Tree, Tree], Any]
    max_windows: int = eqx.field(static=True)
    dense: bool = eqx.field(static=True)

    def solve(self, x0: Tree, ts: jax.Array | None) -> tuple[Saved | None, State]:
        """The states at the times `ts`, and where the run ended."""
        state = self._start(x0)
        if ts is None:
            return None, self._until(state, self.stops[-1])
        times, count = lax.stop_gradient(ts), ts.shape[0]
        blank = jax.eval_shape(lambda: self._read(state, times[0]))
        rows = jtu.tree_map(lambda s: jnp.zeros((count, *s.shape), s.dtype), blank)

        def visit(k: Any, carry: tuple[State, Saved]) -> tuple[State, Saved]:
            state, rows = carry
            state = self._until(state, times[k])
            found = self._read(state, times[k])
            return state, _tree.put(rows, k, found)

        state, rows = lax.fori_loop(0, count, visit, (state, rows))
        return rows, self._until(state, self.stops[-1])

    def _start(self, x0: Tree) -> State:
        t0, many = self.stops[0], self.method.nodes
        zero = jnp.zeros_like(t0)
        blank = _tree.zeros_like(x0)
        one = Record(t0, zero, x0, (blank, blank))
        rows = lambda n: jtu.tree_map(  # noqa: E731
            lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), one
        )
        records = None
        if self.dense:
            records = rows(self.max_windows * many)
            records = records._replace(start=jnp.full_like(records.start, jnp.inf))
        nought = jnp.asarray(0)
        return State(
            t0, x0, many * self.first, jnp.asarray(1), rows(many), (zero, zero), (zero, zero),
            self.stepper.bounds(x0), records, nought, nought, nought, nought, zero, RESULTS.successful,
        )  # fmt: skip

    def _until(self, state: State, time: Any) -> State:
        def goes_on(state: State) -> Any:
            going = state.result == RESULTS.successful
            return (state.t < time) & going & (state.windows < self.max_windows)

        return lax.while_loop(goes_on, lambda state: self._attempt(state), state)

    def _attempt(self, state: State) -> State:
        a, many, stop = state.t, self.method.nodes, self.stops[state.stop]
        if self.fixed:
            # As many whole windows as there must be, all alike.
            count = jnp.maximum(jnp.ceil((stop - a) / state.length * (1 - 1e-12)), 1.0)
            b = jnp.where(count > 1, a + (stop - a) / count, stop)
        else:
            b = clip_to_stop(a, state.length, stop)
        window = self._window(a, b, state.x)
        ratio = self.size(window.error, window.record.x0, window.after)
        kept = window.converged & _tree.all_finite(window.end)
        length = state.length
        stuck = ~kept
        if not self.fixed:
            kept = kept & (ratio <= 1.0)
            positive = jnp.where(ratio > 0.0, ratio, 1.0)
            factor = jnp.where(ratio > 0.0, jnp.sqrt(0.5 / positive), jnp.inf)
            factor = jnp.where(window.converged, jnp.clip(factor, 0.1, 4.0), 0.25)
            # A window cut short by a knot says little about the length that was planned.
            length = lax.stop_gradient(factor * (b - a))
            length = jnp.where(kept & (factor > 1.0), jnp.maximum(length, state.length), length)
            floor = 8 * many * jnp.finfo(a.dtype).eps * jnp.maximum(jnp.abs(a), jnp.abs(b))
            stuck = ~kept & (b - a <= floor)
        unconverged = RESULTS.where(
            window.converged, RESULTS.step_too_small, RESULTS.picard_unconverged
        )
        unconverged = RESULTS.where(_tree.all_finite(window.end), unconverged, RESULTS.nonfinite)
        integrated_defect = jtu.tree_map(
            lambda v, w: v + jnp.sum(w), state.integrated_defect, window.integrated_defect
        )
        records = state.records
        if records is not None:
            place = state.steps + jnp.arange(many)
            taken = window.record._replace(start=jnp.where(kept, window.record.start, jnp.inf))
            records = jtu.tree_map(lambda leaf, new: leaf.at[place].set(new), records, taken)
        last = self.stops.shape[0] - 1
        reached = jnp.where(kept & (b == stop), state.stop + 1, state.stop)
        bounds = state.bounds
        if bounds is not None:
            assert window.bounds is not None
            bounds = bounds.hull(window.bounds)
        new = (b, window.end, window.record, state.integrated_defect, integrated_defect, bounds)
        old = (a, state.x, state.last, state.before, state.integrated_defect, state.bounds)
        t, x, record, before, integrated_defect, bounds = _tree.where(kept, new, old)
        return State(
            t, x, length, jnp.minimum(reached, last), record, before, integrated_defect, bounds,
            records,
            jnp.where(kept, state.steps + many, state.steps), state.windows + 1,
            jnp.where(kept, state.refused, state.refused + many), state.sweeps + window.sweeps,
            jnp.maximum(state.contraction, jnp.where(kept, window.contraction, 0.0)),
            RESULTS.where(stuck, unconverged, RESULTS.successful),
        )  # fmt: skip

    def _window(self, a: Any, b: Any, x: Tree) -> Window:
        stepper, many = self.stepper, self.method.nodes
        flow = stepper.flow
        h = (b - a) / many
        steps = jnp.arange(many + 1).astype(h.dtype)
        ends = (a + h * steps).at[-1].set(b)
        times = ends.at[0].set(one_sided_time(a, b, 0.0, stepper.ends))
        times = times.at[-1].set(one_sided_time(a, b, 1.0, stepper.ends))
        flow_over = flow.propagator(h, 2)
        space = flow.state_space(x)
        norm = jax.vmap(space.norm)

        def swept(value: Tree) -> Tree:
            """The trajectory under p, linear through these values of f̃."""
            c = _pieces(value)
            pushed = jax.vmap(lambda *c: flow_over.step(_tree.zeros_like(x), c))(*c)
            return _accumulated(flow.generator, flow_over, h, x, pushed)

        def rates(X: Tree, Y: Tree | None) -> Any:
            return jax.vmap(flow.rate)(times, X, Y)

        constant = jtu.tree_map(lambda leaf: jnp.broadcast_to(leaf, (many + 1, *leaf.shape)), x)
        guess = flow.guess(x)
        if guess is not None:
            guess = jtu.tree_map(
                lambda leaf: jnp.broadcast_to(leaf, (many + 1, *leaf.shape)), guess
            )
        before = rates(constant, guess)
        X = swept(before.value)
        moved = jnp.max(norm(_tree.sub(X, constant)))
        zero, yes = jnp.zeros_like(moved), jnp.asarray(True)

        def goes_on(carry: Any) -> Any:
            k, _, _, moved, _, matters = carry
            return matters & (k < self.method.max_sweeps) & (moved < jnp.inf)

        def sweep(carry: Any) -> Any:
            k, X, known, moved, contraction, _ = carry
            found = rates(X, None if guess is None else known.y)
            new = swept(found.value)
            change = jnp.max(norm(_tree.sub(new, X)))
            ratio = change / jnp.where(moved > 0.0, moved, 1.0)
            # Corrections that are rounding have no ratio to speak of.
            told = change > 1e4 * jnp.finfo(h.dtype).eps * (1.0 + jnp.max(norm(new)))
            contraction = jnp.where(told, jnp.maximum(contraction, ratio), contraction)
            off = _tree.sub(found.value, known.value)
            return k + 1, new, found, change, contraction, self.matters(off, new, found.value)

        first = (jnp.asarray(1), X, before, moved, zero, yes)
        k, X, known, _, contraction, matters = lax.while_loop(goes_on, sweep, first)
        converged = jnp.all(known.solved) & ~matters
        c = _pieces(known.value)
        start, end = _rows(X, slice(-1)), _rows(X, slice(1, None))
        ys = None if guess is None else _rows(known.y, slice(-1))
        sample, looked = jax.vmap(stepper.estimate_defect)(ends[:-1], ends[1:], start, end, c, ys)
        integrated_defect = sample.defect, sample.law_defect
        record = Record(ends[:-1], jnp.broadcast_to(h, (many,)), start, c)
        return Window(
            record, end, _rows(X, -1), sample.error, integrated_defect,
            sample.bounds.hull_of_rows() if stepper.track_bounds else None,
            converged & jnp.all(looked), k, contraction,
        )  # fmt: skip

    def _read(self, state: State, time: Any) -> Saved:
        """The trajectory at a time in the last window; t = ∞ where the run did not get there."""
        record = state.last
        i = jnp.sum(record.start <= time) - 1
        step = jtu.tree_map(lambda leaf: leaf[jnp.maximum(i, 0)], record)
        theta = (time - step.start) / jnp.where(step.length > 0, step.length, 1)
        reached = state.t >= time
        met = time >= state.t
        x = lax.cond(
            met,
            lambda: state.x,
            lambda: interpolate(self.stepper.flow, step.length, theta, step.x0, step.coefficients),
        )
        x = jtu.tree_map(lambda leaf: jnp.where(reached, leaf, jnp.nan), x)
        started = time > record.start[0]
        integrated_defect = _tree.where(started, state.integrated_defect, state.before)
        completed_defect = _tree.where(time >= state.t, state.integrated_defect, state.before)
        # The state at the end of a window moves with it.
        time = time + zero_with_tangent(jnp.where(met, state.t, 0.0))
        return Saved(
            jnp.where(reached, time, jnp.inf), x, integrated_defect, completed_defect, state.bounds
        )


def by_windows(
    setup: Setup,
    method: Picard,
    flow: Flow,
    stops: jax.Array,
    ts: jax.Array | None,
    options: Options,
) -> Outcome:
    """Run windows from the first stop to the last."""
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
    run = Run(
        method, stepper, stops, options.fixed, first, size, matters,
        windows, options.dense,
    )  # fmt: skip
    saved, end = forward_only(run.solve(x0, ts))
    complete = end.t >= stops[-1]
    rows = end_alone(end, complete, stops[-1], True) if saved is None else saved
    if ts is not None:
        ends = lax.stop_gradient((stops[0], stops[-1]))
        rows = with_tangents(rows, ts, x0, flow, ends)
    stats = {
        "steps": end.steps, "rejected": end.refused, "t": end.t, "x": end.x,
        "next_dt": end.length / method.nodes, "windows": end.windows, "sweeps": end.sweeps,
        "contraction": end.contraction,
    }  # fmt: skip
    return Outcome(rows, stats, ended(end.result, complete), end.records)


def _pieces(value: Tree) -> tuple[Tree, Tree]:
    """(c₀, c₁) of each step from the values at its ends."""
    left = _rows(value, slice(-1))
    return left, _tree.sub(_rows(value, slice(1, None)), left)


def _rows(tree: Tree, cut: Any) -> Tree:
    """The rows of each leaf."""
    return jtu.tree_map(lambda leaf: leaf[cut], tree)


def _accumulated(
    A: AbstractGenerator, over: AbstractPropagator, h: Any, x: Tree, pushed: Tree
) -> Tree:
    """x₀ = x and xᵢ₊₁ = e^{hA}xᵢ + pushedᵢ, all of them."""
    first = jtu.tree_map(lambda leaf: leaf[None], x)
    joined = jtu.tree_map(lambda a, b: jnp.concatenate([a, b]), first, pushed)
    return lax.platform_dependent(
        joined,
        cpu=lambda joined: in_turn(over, joined),
        default=lambda joined: by_doubling(A, h, joined),
    )


def in_turn(over: AbstractPropagator, pushed: Tree) -> Tree:
    """xᵢ = e^{hA}xᵢ₋₁ + pushedᵢ from x₀ = pushed₀, one after the other."""

    def one(x: Tree, push: Tree) -> tuple[Tree, Tree]:
        new = _tree.add(over.step(x, ()), push)
        return new, new

    start = _rows(pushed, 0)
    _, xs = lax.scan(one, start, _rows(pushed, slice(1, None)))
    return jtu.tree_map(lambda a, b: jnp.concatenate([a[None], b]), start, xs)


def by_doubling(A: AbstractGenerator, h: Any, pushed: Tree) -> Tree:
    """The same in as many turns as the logarithm of their number: after r of them, entry i is the sum
    of e^{(i−j)hA}pushedⱼ over the 2ʳ entries j up to it."""
    count, apart = jtu.tree_leaves(pushed)[0].shape[0], 1
    while apart < count:
        moved = jax.vmap(lambda v, k=apart: A.semigroup(k * h, v))(_rows(pushed, slice(-apart)))
        pushed = jtu.tree_map(lambda leaf, m, k=apart: leaf.at[k:].add(m), pushed, moved)
        apart *= 2
    return pushed
