"""The steps of `Implicit`, which Diffrax makes."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix
from jax import lax

from .. import _tree
from .._tree import Tree
from .flow import Flow
from .implicit import Implicit
from .outcome import Outcome, Saved, with_tangents
from .results import RESULTS
from .setup import Options, Setup
from .stepper import one_sided_time
from .time_derivatives import zero_with_tangent

_SPLIT = (diffrax.KenCarp3, diffrax.KenCarp4, diffrax.KenCarp5)

_SMALL_CORRECTION = 1e-4
"""Size of a correction of the chord iteration, in tolerances, that ends it at once."""


def solve_by_implicit_steps(
    setup: Setup,
    method: Implicit,
    flow: Flow,
    stops: jax.Array,
    ts: jax.Array | None,
    options: Options,
) -> Outcome:
    """Solve by `Implicit` from the first stop to the last."""
    # The tangents of the ends enter through x' there, which is exact: a clock that stretched the first
    # and the last piece would differentiate the steps over kinks inside them.
    start, end = lax.stop_gradient((stops[0], stops[-1]))
    clock = _Clock(stops.at[0].set(start).at[-1].set(end))
    first_step = lax.stop_gradient(setup.number("dt0"))
    given = lax.stop_gradient(setup.x0), flow, (start, end)
    x0 = _from_start(setup.x0, stops[0], given)
    rtol, atol = setup.number("rtol"), setup.number("atol")
    first, last = (one_sided_time(start, end, theta, (start, end)) for theta in (0.0, 1.0))

    def law(s: Any, x: Tree, _: Any) -> Tree:
        t, dt_ds = clock.time(jnp.clip(s, first, last))
        rate = flow.rate(t, x, flow.guess(x))
        # If the law is not solved, NaN makes Diffrax try a shorter step.
        return jtu.tree_map(lambda v: jnp.where(rate.solved, dt_ds * v, jnp.nan), rate.value)

    def linear(s: Any, x: Tree, _: Any) -> Tree:
        # The last stage may lie a rounding behind the end, where the clock has no tangent.
        return _tree.scale(clock.time(jnp.clip(s, first, last))[1], flow.generator.apply(x))

    if isinstance(method.solver, _SPLIT):
        terms = diffrax.MultiTerm(diffrax.ODETerm(law), diffrax.ODETerm(linear))
    else:
        terms = diffrax.ODETerm(lambda t, x, _: _tree.add(linear(t, x, _), law(t, x, _)))

    solution = diffrax.diffeqsolve(
        terms,
        _with_chord(method.solver, rtol, atol),
        start,
        end,
        first_step,
        x0,
        saveat=diffrax.SaveAt(t1=True) if ts is None else diffrax.SaveAt(ts=lax.stop_gradient(ts)),
        stepsize_controller=_controller(rtol, atol, clock.stops),
        adjoint=diffrax.ForwardMode()
        if options.adjoint == "forward"
        else diffrax.RecursiveCheckpointAdjoint(),
        max_steps=options.max_steps,
        throw=False,
        progress_meter=diffrax.TextProgressMeter()
        if options.progress
        else diffrax.NoProgressMeter(),
    )
    assert solution.ts is not None
    # If the end is NaN, there are no steps.
    is_successful = (solution.result == diffrax.RESULTS.successful) & (end > start)
    # Without ts, the single time of a failed run is that of its last accepted step.
    reached = jnp.isfinite(solution.ts) & (is_successful if ts is None else True)
    xs = jtu.tree_map(
        lambda leaf: jnp.where(reached.reshape(-1, *(1,) * (leaf.ndim - 1)), leaf, jnp.nan),
        solution.ys,
    )
    is_out_of_steps = solution.result == diffrax.RESULTS.max_steps_reached
    result = RESULTS.where(is_out_of_steps, RESULTS.max_steps, RESULTS.implicit_unsolved)
    result = RESULTS.where(is_successful, RESULTS.successful, result)
    times = stops[-1:] if ts is None else ts
    at_rows = jax.vmap(lambda s: clock.time(s)[0])(lax.stop_gradient(times))
    rows = with_tangents(Saved(jnp.where(reached, at_rows, jnp.inf), xs), times, *given)
    # Of a failed run, report the last saved time that it reached.
    count = jnp.sum(reached)
    row = jnp.maximum(count - 1, 0)
    stats = {
        "steps": solution.stats["num_accepted_steps"],
        "rejected": solution.stats["num_rejected_steps"],
        "t": jnp.where(count > 0, rows.t[row], start),
        "x": jtu.tree_map(lambda leaf, x: jnp.where(count > 0, leaf[row], x), rows.x, x0),
        "next_dt": first_step,
    }
    return Outcome(rows, stats, result, None)


def _from_start(x0: Tree, t0: Any, given: tuple[Any, ...]) -> Tree:
    """Return x0 as the state at a constant t0: its tangent has the term −x'(t0) times that of t0."""
    row = Saved(t0[None], jtu.tree_map(lambda leaf: leaf[None], x0))
    row = with_tangents(row, lax.stop_gradient(row.t), *given)
    return jtu.tree_map(lambda leaf: leaf[0], row.x)


class _Clock:
    """A map s ↦ t from the time of the solver to the time of the problem.

    Its value is the identity. Between two stops it is the affine function whose tangents at the ends
    are those of the stops. Times s are constants, so that Diffrax does not differentiate its steps,
    and the tangents of the stops enter only through x' = dt/ds (Ax + f̃(t, x)).
    """

    def __init__(self, stops: jax.Array) -> None:
        self.stops = lax.stop_gradient(stops)
        shift = zero_with_tangent(stops)
        # Knots outside of the run stand at its ends.
        lengths = jnp.diff(self.stops)
        self._slope = jnp.diff(shift) / jnp.where(lengths > 0, lengths, 1.0)
        self._shift = shift[:-1] - self._slope * self.stops[:-1]

    def time(self, s: Any) -> tuple[Any, Any]:
        """Return t and dt/ds."""
        shift, slope = self._at(s)
        return s + (shift + slope * s), 1.0 + slope

    def _at(self, s: Any) -> tuple[Any, Any]:
        piece = jnp.searchsorted(self.stops[1:-1], s, side="left")
        return self._shift[piece], self._slope[piece]


class _Chord(diffrax.VeryChord):
    """Diffrax's chord iteration, which also ends where a correction is far below the tolerance.

    Where the equations are linear, or affine up to the kinks, one iterate is exact. The rate of
    convergence that Diffrax 0.7.2 estimates from the next correction is then 0/0 or roundoff, and it
    rejects step after step.
    """

    # Diffrax declares floats; those of a run may be traced.
    rtol: Any
    atol: Any

    def terminate(self, fn, y, args, options, state, tags):
        done, result = super().terminate(fn, y, args, options, state, tags)
        solved = state.result == optimistix.RESULTS.successful
        small = (state.step >= 2) & (state.diffsize < _SMALL_CORRECTION) & solved
        return done | small, optimistix.RESULTS.where(small, optimistix.RESULTS.successful, result)


def _with_chord(solver: Any, rtol: Any, atol: Any) -> Any:
    """Return the solver with `_Chord` in the place of Diffrax's own root finder."""
    if not isinstance(solver.root_finder, diffrax.VeryChord):
        return solver
    chord = _Chord(rtol, atol, norm=optimistix.rms_norm)
    return eqx.tree_at(lambda s: s.root_finder, solver, chord)


def _controller(rtol: Any, atol: Any, stops: jax.Array) -> diffrax.AbstractStepSizeController:
    """Return an adaptive step size controller whose steps end at the stops."""
    # These coefficients are those that Diffrax recommends for stiff problems.
    shortest = 8 * jnp.finfo(stops.dtype).eps * jnp.max(jnp.abs(stops))
    adaptive = diffrax.PIDController(
        rtol, atol, pcoeff=0.3, icoeff=0.4, dtmin=shortest, force_dtmin=False
    )
    if stops.shape[0] == 2:
        return adaptive
    # Knots outside of the run stand at its ends, where Diffrax would add a step of length zero.
    first, knots, last = stops[0], stops[1:-1], stops[-1]
    knots = jnp.where(knots <= first, 2 * first - last, knots)
    knots = jnp.where(knots >= last, 2 * last - first, knots)
    return diffrax.ClipStepSizeController(adaptive, jump_ts=knots)
