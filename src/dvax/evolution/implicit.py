"""The fallback: an implicit method of Diffrax on x' = Ax + f̃(t, x) as a whole."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from .flow import Flow
from .outcome import Outcome, Saved
from .results import RESULTS
from .setup import Options, Setup
from .stepper import one_sided_time
from .time_derivatives import zero_with_tangent

_SPLIT = (diffrax.KenCarp3, diffrax.KenCarp4, diffrax.KenCarp5)


class Implicit(eqx.Module):
    """An implicit Runge–Kutta method of Diffrax, by default Kvaerno's of order 5, for what no
    exponential method should solve: an f̃ that is stiff and couples more unknowns than
    `ExpRosenbrock` takes, or an A whose exponential costs too much.

    A is only applied. Each step solves equations as large as the state by Newton's method, which by
    default forms their matrix: some thousand unknowns. `rtol` and `atol` then mean what Diffrax means
    by them, the error of one step; nothing is certified (`Solution.defect` is None), kinks are not
    looked for (derivatives of a run that crosses some are as good as the steps there are short), and
    steps are not kept: name the times in `ts=`. Steps end on the knots of data.

    **Arguments:** `solver`: any implicit solver of Diffrax, with root finder and linear solver of its
    own if need be. To its KenCarp methods A is the implicit part and the law the explicit one.

    **Raises:** `dvax.InputError` where the solver is not implicit, or where `dvax.solve` is asked for
    `dt`, `dense=True` or `measure=True`.

    Source: Kværnø, BIT 44 (2004); Diffrax, https://docs.kidger.site/diffrax.

    ```python
    >>> import dvax
    >>> stiff = dvax.Problem(
    ...     A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 9.0),
    ...     f=lambda t, x, u, args: 1.0 - x + u, h=lambda t, x, u, args: -1e4 * (x - 2.0) - u,
    ... )                              # a spring of 5000 holds x above 2, nearly
    >>> sol = dvax.solve(stiff, 4.0, 0.0, 4.0, method=dvax.Implicit())
    >>> print(f"{float(sol.xs[0]):.6f}")
    1.999800

    ```
    """

    solver: diffrax.AbstractSolver = eqx.field(default_factory=diffrax.Kvaerno5)

    def __check_init__(self) -> None:
        if not isinstance(self.solver, diffrax.AbstractImplicitSolver):
            raise InputError(
                InputProblem(
                    "dvax.Implicit(solver)",
                    f"{type(self.solver).__name__}",
                    "it must be an implicit solver of Diffrax",
                    "diffrax.Kvaerno5(), Kvaerno3() or KenCarp4(), say; leave it out for the first",
                )
            )


def by_implicit_steps(
    setup: Setup,
    method: Implicit,
    flow: Flow,
    stops: jax.Array,
    ts: jax.Array | None,
    options: Options,
) -> Outcome:
    """Run implicit steps from the first stop to the last."""
    clock, x0, first_step = _Clock(stops), setup.x0, setup.number("dt0")
    begin, end = clock.stops[0], clock.stops[-1]
    first, last = (one_sided_time(begin, end, theta, (begin, end)) for theta in (0.0, 1.0))

    def law(s: Any, x: Tree, _: Any) -> Tree:
        t, pace = clock.time(jnp.clip(s, first, last))
        found = flow.rate(t, x, flow.guess(x))
        # A law that is not solved gives no rate: a shorter step is tried.
        return jtu.tree_map(lambda v: jnp.where(found.solved, pace * v, jnp.nan), found.value)

    def linear(s: Any, x: Tree, _: Any) -> Tree:
        return _tree.scale(clock.time(s)[1], flow.generator.apply(x))

    if isinstance(method.solver, _SPLIT):
        terms = diffrax.MultiTerm(diffrax.ODETerm(law), diffrax.ODETerm(linear))
    else:
        terms = diffrax.ODETerm(lambda t, x, _: _tree.add(linear(t, x, _), law(t, x, _)))

    found = diffrax.diffeqsolve(
        terms,
        method.solver,
        begin,
        end,
        first_step,
        x0,
        saveat=diffrax.SaveAt(t1=True) if ts is None else diffrax.SaveAt(ts=clock.inverse(ts)),
        stepsize_controller=_controller(setup.number("rtol"), setup.number("atol"), clock.stops),
        adjoint=diffrax.ForwardMode()
        if options.adjoint == "forward"
        else diffrax.RecursiveCheckpointAdjoint(),
        max_steps=options.max_steps,
        throw=False,
        progress_meter=diffrax.TextProgressMeter()
        if options.progress
        else diffrax.NoProgressMeter(),
    )
    assert found.ts is not None
    # An end that is no number has no steps before it.
    fine = (found.result == diffrax.RESULTS.successful) & (end > begin)
    # Without ts the one time is that of the last good step.
    reached = jnp.isfinite(found.ts) & (fine if ts is None else True)
    xs = jtu.tree_map(
        lambda leaf: jnp.where(reached.reshape(-1, *(1,) * (leaf.ndim - 1)), leaf, jnp.nan),
        found.ys,
    )
    out_of_steps = found.result == diffrax.RESULTS.max_steps_reached
    result = RESULTS.where(out_of_steps, RESULTS.max_steps, RESULTS.implicit_unsolved)
    result = RESULTS.where(fine, RESULTS.successful, result)
    times = jnp.where(reached, stops[-1:] if ts is None else ts, jnp.inf)
    # What is known of a run that failed is the last saved time that it reached.
    count = jnp.sum(reached)
    row = jnp.maximum(count - 1, 0)
    stats = {
        "steps": found.stats["num_accepted_steps"],
        "rejected": found.stats["num_rejected_steps"],
        "t": jnp.where(count > 0, times[row], begin),
        "x": jtu.tree_map(lambda leaf, x: jnp.where(count > 0, leaf[row], x), xs, x0),
        "next_dt": first_step,
    }
    return Outcome(Saved(times, xs), stats, result, None)


class _Clock:
    """A map s ↦ t of the time of the solver to that of the problem: the identity in value, and between
    two stops the affine function that maps their values to the stops themselves.

    Times in s are constants. So Diffrax chooses and differentiates its steps as where no time is
    differentiated, and all tangents of the stops enter by x' = dt/ds (Ax + f̃(t, x)).
    """

    def __init__(self, stops: jax.Array) -> None:
        self.stops = lax.stop_gradient(stops)
        shift = zero_with_tangent(stops)
        self._slope = jnp.diff(shift) / jnp.diff(self.stops)
        self._shift = shift[:-1] - self._slope * self.stops[:-1]

    def time(self, s: Any) -> tuple[Any, Any]:
        """Return t and dt/ds."""
        shift, slope = self._at(s)
        return s + (shift + slope * s), 1.0 + slope

    def inverse(self, t: Any) -> Any:
        """Return s."""
        shift, slope = self._at(lax.stop_gradient(t))
        return (t - shift) / (1.0 + slope)

    def _at(self, s: Any) -> tuple[Any, Any]:
        piece = jnp.searchsorted(self.stops[1:-1], s, side="left")
        return self._shift[piece], self._slope[piece]


def _controller(rtol: Any, atol: Any, stops: jax.Array) -> diffrax.AbstractStepSizeController:
    """Steps that adapt and end on the stops."""
    # The error of a stiff step says little about the next one: Diffrax's advice.
    shortest = 8 * jnp.finfo(stops.dtype).eps * jnp.max(jnp.abs(stops))
    adaptive = diffrax.PIDController(
        rtol, atol, pcoeff=0.3, icoeff=0.4, dtmin=shortest, force_dtmin=False
    )
    if stops.shape[0] == 2:
        return adaptive
    return diffrax.ClipStepSizeController(adaptive, jump_ts=stops[1:-1])
