"""The result of `dvax.solve`."""

import dataclasses
import math
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._dataset import Names, required
from .._jax.traces import current_trace
from .._repr import last_text, table, value_text
from .._tree import Tree
from ..errors import Fix, SolveError, input_error
from .after_run import at_rows, steps_at
from .bounds import Bounds
from .dataset import solution_dataset
from .diagnose import failure
from .event import Events
from .flow import Flow
from .implicit import Implicit
from .outcome import Record
from .piecewise.method import PiecewiseLinear
from .piecewise.trajectory import Trajectory, signs
from .plan import Plan
from .regimes import Regimes, regimes, switch_count
from .responses import Responses
from .results import RESULTS, is_success
from .saved_responses import Saved, saved_responses
from .setup import Setup
from .stepper import dense_output

if TYPE_CHECKING:
    import xarray


_CACHE = "_computed_responses"
"""The name under which a solution keeps its responses, with the trace that they belong to. It is no
field, and so no part of the pytree."""


class Guesses(NamedTuple):
    """The initial guesses `ys` for the law at the saved times, from which responses are computed when
    they are read. None: zero, or the law has a closed form."""

    ys: Tree | None


class Solution(eqx.Module):
    """A trajectory with its response, its error measures and statistics of the run.

    - `ts`: the saved times; `xs`: the states there, with a leading time axis;
    - `us`, `ys`: the responses u and y = P u at the saved times. They and the next two are computed
      when one of them is first read (`responses`);
    - `law_error`: a certified bound on ‖u − u*‖ of the frozen law at each saved time (C0 of
      `dvax.vi.certificate`), ‖P⁻¹‖(‖w‖/γ + ‖ȳ − y‖); None if `constants=` does not give γ;
    - `law_residual`, `law_step`: ‖w‖ and ‖ȳ − y‖ of one projection step from y;
    - `defect`: ∫ ‖p − f̃(·, x_h)‖ ds up to each saved time. The computed trajectory x_h is the exact
      solution of the system with the disturbance p − f̃. `dvax.bound_error` computes error bounds from
      it. None if it is not measured (fixed steps and `PiecewiseLinear` without `measure=True`);
    - `law_defect`: the integral of ‖w‖ over the frozen solves, or of a bound on ‖w‖ for the line
      between the responses at the ends of each step, or None;
    - `completed_defect`: (defect, law_defect) at the start of the step that contains each saved time;
    - `bounds`: bounds on x_h and u_h since the saved time before, or t0, to the end of that step, if
      `constants=` hold in a region only, else None; of `Picard` since t0;
    - `enclosed`: True if the defect and `bounds` are enclosures over every step
      (`dvax.programs.enclosure`), False if samples estimate them;
    - `stats`: the `method`, with the reason where it was chosen; the numbers of accepted `steps`, of
      `rejected` steps and of `evaluations` of F in steps
      (without those for event location and for u at saved times); `t`, `x` and the next step size at
      the end of the run; `compile_time` and `run_time` in seconds, unless the solve is part of a larger
      compiled program;
    - `result`: `dvax.RESULTS.successful`, `dvax.RESULTS.terminal_event` where a terminal event ended
      the run, or the kind of failure;
    - `plan`: properties of the law proved from the code of f, h and K (None with `PiecewiseLinear`);
    - `setup`: the arguments; `records`: the steps, if `dense=True`; `law`: what the responses are
      computed from;
    - `events`: the events of `events=`, a `dvax.evolution.Events`, else None.

    ```python
    >>> import dvax
    >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
    ...                             kappa0=0.5, g=1.0, ell=3.0)
    >>> sol = dvax.solve(model.problem, -1.0, 0.0, 2.0, ts=[0.0, 1.0, 2.0], dense=True,
    ...                  method=dvax.ETD2RK(), max_steps=10_000)
    >>> sol.xs.shape, sol.enclosed
    ((3,), True)
    >>> x, u = sol.evaluate(0.4)
    >>> print(f"{float(u):.3f}")
    0.288

    ```
    """

    ts: jax.Array
    xs: Tree
    law: Guesses | Responses
    defect: jax.Array | None
    law_defect: jax.Array | None
    completed_defect: tuple[jax.Array, jax.Array] | None
    bounds: Bounds | None
    stats: dict[str, Any]
    result: RESULTS
    records: Record | Trajectory | None
    events: Events | None
    enclosed: bool = eqx.field(static=True)
    plan: Plan | None = eqx.field(static=True)
    setup: Setup

    def __repr__(self) -> str:
        stats, spent = self.stats, {"compile_time": "compiling", "run_time": "running"}
        seconds = [
            f"{value_text(stats[k], 3)} s {doing}" for k, doing in spent.items() if k in stats
        ]
        return table(
            f"Solution: {_message(self.result)}",
            [
                ("method", str(stats.get("method", type(self.setup.method).__name__))),
                ("ts", value_text(self.ts)),
                ("xs", value_text(self.xs)),
                *((k, value_text(stats[k])) for k in ("steps", "rejected", "t") if k in stats),
                ("time", ", ".join(seconds)),
                ("defect", _defect_text(self)),
                ("records", "" if self.records is None else "dense output: evaluate(t)"),
                ("events", "" if self.events is None else "located: events"),
            ],
        )

    @property
    def us(self) -> Tree:
        """The responses u at the saved times."""
        return _responses(self).us

    @property
    def ys(self) -> Tree:
        """y = P u at the saved times."""
        return _responses(self).ys

    @property
    def law_residual(self) -> jax.Array:
        """‖w‖ of one projection step from y, at the saved times."""
        return _responses(self).law_residual

    @property
    def law_step(self) -> jax.Array:
        """‖ȳ − y‖ of one projection step from y, at the saved times."""
        return _responses(self).law_step

    @property
    def law_error(self) -> jax.Array | None:
        """The certified bound on ‖u − u*‖ at the saved times, or None."""
        return _responses(self).law_error

    def responses(self) -> Responses:
        """Return u, y and their certificates at the saved times, as one named tuple.

        They are computed when they are first read, by one compiled program, and kept. A copy that a
        JAX transformation makes of this solution computes them again.

        **Raises:** `dvax.SolveError` if the run succeeded, and the law has no finite solution at a
        saved time. Where it is traced, values and derivatives are NaN instead.
        """
        return _responses(self)

    @property
    def flow(self) -> Flow:
        """The reduced map f̃ of the run, according to its plan."""
        plan = Plan.of(self.setup) if self.plan is None else self.plan
        return plan.flow(self.setup)

    def evaluate(self, t: Any) -> tuple[Tree, Tree]:
        """Return (x(t), u(t)) at any time of a solve with `dense=True`, or at each time of an array,
        whose axes then come first in x and u.

        x is the dense output of the step, exact in A; u is the solution of the law at (t, x).

        **Raises:** `dvax.InputError` if the steps were not recorded, or if t lies outside them.
        """
        if self.records is None:
            raise input_error(
                "Solution.evaluate",
                f"t = {t}",
                "the steps were not recorded, so only the saved times are available",
                "Solve with dense=True, or list the times in ts=",
            )
        self._check_inside(t)
        records, are_concrete = self.records, _tree.is_concrete(t, self.records)
        if isinstance(records, Record) and are_concrete and not _tree.is_sharded(records.start):
            return self._from_records(records, np.asarray(t, records.start.dtype))
        if not jnp.ndim(t):
            return self._at(t)
        times = jnp.ravel(jnp.asarray(t, self.ts.dtype))
        if isinstance(self.records, Trajectory):
            each = [self._at(t) for t in np.asarray(times)]
            rows = jax.tree_util.tree_map(lambda *leaves: jnp.stack(leaves), *each)
        else:
            rows = jax.vmap(self._at)(times)
        axes = jnp.shape(t)
        return jax.tree_util.tree_map(lambda leaf: leaf.reshape(axes + leaf.shape[1:]), rows)

    def _from_records(self, records: Record, times: np.ndarray) -> tuple[Tree, Tree]:
        """Return x and u at concrete times, by a compiled program that is kept."""
        flat = times.ravel()
        if not flat.size:
            return jax.vmap(self._at)(times)
        which = np.searchsorted(np.asarray(records.start), flat, side="right") - 1
        steps = steps_at(records, np.maximum(which, 0))
        assert self.plan is not None
        rows = at_rows(_inside_steps, self.setup, self.plan, (flat, steps))
        return jax.tree_util.tree_map(
            lambda leaf: jnp.asarray(leaf.reshape(times.shape + leaf.shape[1:])), rows
        )

    def _at(self, t: Any) -> tuple[Tree, Tree]:
        """Return x and u at one time."""
        if isinstance(self.records, Trajectory):
            records = self.records
            x, y = records.evaluate(t)
            x0, u0 = self.setup.x0, self.us[0]
            u = self.flow.operator.inverse(y.reshape(u0.shape).astype(u0.dtype))
            return x.reshape(jnp.shape(x0)).astype(self.xs.dtype), u
        assert isinstance(self.records, Record)
        flow, records, setup = self.flow, self.records, self.setup

        # Outline the call under a name: if f uses the trajectory of another run as data, enclosures
        # recognise this name and skip the call.
        def dvax_evaluate(t: Any) -> tuple[Tree, Tree]:
            t = jnp.asarray(t, records.start.dtype)
            i = jnp.clip(jnp.searchsorted(records.start, t, side="right") - 1, 0)
            return _inside_step(
                flow, setup, t, jax.tree_util.tree_map(lambda leaf: leaf[i], records)
            )

        return jax.jit(dvax_evaluate)(t)

    def _check_inside(self, t: Any) -> None:
        records = self.records
        assert records is not None
        if not _tree.is_concrete(t, records.start):
            return
        starts, times = np.asarray(records.start), np.asarray(t)
        last = int(np.isfinite(starts).sum()) - 1
        first = starts[0]
        if isinstance(records, Trajectory):
            end = records.end
        else:
            end = starts[last] + np.asarray(records.length)[last]
        outside = times[~((first <= times) & (times <= end))]
        if outside.size:
            raise input_error(
                "Solution.evaluate",
                f"t = {float(outside.flat[0]):g}",
                f"t must lie in [{float(first):g}, {float(end):g}], which the solve covers",
                "Solve on a longer interval, or choose a time inside",
            )

    def regimes(self) -> Regimes:
        """Return the times at which active constraints change, and the active constraints between them.

        They are located on the steps of a solve with `dense=True`; without it the run is made once more
        with it.

        **Raises:** `dvax.InputError` if the run took no steps, if its method records none
        (`dvax.Implicit`), if it is part of a compiled program, or if K has no switch functions.

        ```python
        >>> import dvax
        >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
        ...                             kappa0=0.5, g=1.0, ell=3.0)
        >>> sol = dvax.solve(model.problem, -1.0, 0.0, 2.0, rtol=1e-8)
        >>> times, positive = sol.regimes()
        >>> [f"{t:.6f}" for t in times]                        # held above, free, held at 0
        ['0.000000', '0.313336', '0.524057', '2.000000']
        >>> positive.tolist()
        [[True, False], [True, True], [False, True]]

        ```
        """
        if not _tree.is_concrete(self.ts, self.xs, self.setup.setting):
            raise input_error(
                "Solution.regimes", "a solution inside a compiled program",
                "their number, and with it the shape of the result, depends on values",
                "Call it outside of jax.jit, jax.vmap and jax.grad",
            )  # fmt: skip
        if int(self.stats["steps"]) == 0:
            raise input_error(
                "Solution.regimes", "a run without steps", "the changes are located on its steps",
                "Look at why the run failed: its result and stats",
            )  # fmt: skip
        if isinstance(self.records, Trajectory):
            return signs(self.records)
        if switch_count(self.setup) is None:
            K = self.setup.problem.set_at(self.setup.number("t0"), _tree.as_arrays(self.setup.args))
            raise input_error(
                "Solution.regimes",
                f"K of type {type(K).__name__}",
                "the set must have switch functions (dvax.sets.AbstractSet.switches)",
                "Write K as a set that has them, such as dvax.sets.Polyhedron",
            )
        if self.records is None:
            # Here, since this module is below `solve`.
            from .solve import run_again

            return run_again(self, None, dense=True).regimes()
        assert self.plan is not None
        return regimes(self.setup, self.plan, self.records, int(self.stats["steps"]))

    def raise_if_failed(self) -> "Solution":
        """Return this solution if the run succeeded, else raise a `dvax.SolveError` that contains
        it."""
        if not is_success(self.result):
            raise failure(self)
        return self

    def to_xarray(
        self,
        states: Names = None,
        responses: Names = None,
        *,
        time_unit: str = "",
        bound: Any = None,
    ) -> "xarray.Dataset":
        """Return the saved trajectory as an `xarray.Dataset` with dimension `time`.

        Variables are `x`, `u` and `y` = P u; parts of a tuple are `x0`, `x1`, …, and further axes
        `x_dim0`, …. `law_error` and `defect` follow where they are known. Attributes say how the run
        ended, by which method and in how many steps.

        **Arguments:** `states`, `responses`: a name for each entry of x (of u) or for each part of a
        tuple, with its unit: {"position": "m", "velocity": "m/s"}, or a list of names; `time_unit`;
        `bound`: a `dvax.Bound` of this solution, whose `error_bound_x` and `error_bound_u` are joined.

        **Raises:** `ModuleNotFoundError` if xarray (the extra `dvax[app]`) is not installed;
        `dvax.InputError` if names or bound do not fit, or if the solution is traced or a batch.

        ```python
        >>> import dvax
        >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
        ...                             kappa0=0.5, g=1.0, ell=3.0)
        >>> sol = dvax.solve(model.problem, -1.0, 0.0, 2.0, ts=[0.0, 1.0, 2.0])
        >>> data = sol.to_xarray({"depth": "mm"}, {"force": "N"}, time_unit="s")
        >>> list(data), data.depth.attrs["units"], data.attrs["result"]
        (['depth', 'force', 'y', 'defect'], 'mm', 'The end time was reached.')

        ```
        """
        return solution_dataset(self, states, responses, time_unit, bound)

    def plot(
        self,
        states: Names = None,
        responses: Names = None,
        *,
        time_unit: str = "",
        bound: Any = None,
        title: str | None = None,
        backend: str = "matplotlib",
        axes: Any = None,
    ) -> Any:
        """Return a figure of the states, the responses, the active constraints and the error bound.

        A panel for each part of x and u has up to six entries as curves, more entries of a vector as a
        map over time, and those of an array with several axes as bands. Where K is a box its bounds are
        dashed; y = P u has a panel of its own if it differs from u. The constraints are active in the
        spans of `regimes` if `dense=True` recorded the steps, else at the saved times. Events are
        vertical lines. Where fewer than two times were saved, the recorded steps are drawn.

        **Arguments:** `states`, `responses`, `time_unit`: names and units as in `to_xarray`; entries
        of one unit share a panel; `bound`: a `dvax.Bound` of this solution; `title`: by default the
        method and the steps, or where a run stopped and why; `backend`: "matplotlib" or "plotly";
        `axes`: Matplotlib axes to draw into, one for each panel.

        **Returns:** a `matplotlib.figure.Figure` (`figure.savefig("a.png")`; `plt.show()` shows it if
        `matplotlib.pyplot` was imported before), or a Plotly figure (`figure.write_html("a.html")`).

        **Raises:** `ModuleNotFoundError` if Matplotlib or Plotly (the extra `dvax[app]`) is missing;
        `dvax.InputError` if there is nothing to draw, or names, bound or axes do not fit.

        ```python
        >>> import dvax
        >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
        ...                             kappa0=0.5, g=1.0, ell=3.0)
        >>> sol = dvax.solve(model.problem, -1.0, 0.0, 2.0, dense=True)
        >>> figure = sol.plot({"depth": "mm"}, {"force": "N"}, time_unit="s")
        >>> [axes.get_ylabel().split()[0] for axes in figure.axes]
        ['depth', 'force', 'constraints']

        ```
        """
        for module in ("matplotlib", "plotly"):
            required(module, "Solution.plot")
        # Upward, since pictures belong to the application.
        from ..app.plots.solution import plot_solution

        return plot_solution(
            self, states, responses, time_unit=time_unit, bound=bound, title=title, backend=backend,
            axes=axes,
        )  # fmt: skip


def _message(result: RESULTS) -> str:
    """Return what a result says; of a batch or a traced one, that it is one."""
    if not _tree.is_concrete(result):
        return "a traced run"
    failed = np.asarray(~is_success(result))
    if failed.ndim == 0:
        return str(RESULTS[result])
    return f"{failed.size} runs, {int(failed.sum())} failed"


def _inside_step(flow: Flow, setup: Setup, t: Any, step: Record) -> tuple[Tree, Tree]:
    """Return x and u at a time in a step."""
    assert not isinstance(setup.method, Implicit | PiecewiseLinear)
    run = setup.number("t0"), setup.number("t1")
    theta = (t - step.start) / step.length
    x = dense_output(setup.method, flow, step, flow.guess(step.x0), run)(theta)
    return x, flow.operator.inverse(flow.rate(t, x, None).y)


def _inside_steps(setup: Setup, plan: Plan, rows: tuple[jax.Array, Record]) -> tuple[Tree, Tree]:
    """Return x and u at each of several times, each of them with its step."""
    return jax.vmap(partial(_inside_step, plan.flow(setup), setup))(*rows)


def _defect_text(solution: Solution) -> str:
    if solution.defect is None:
        return ""
    how = "enclosed over every step" if solution.enclosed else "sampled"
    return f"{last_text(solution.defect)}, {how}"


def _responses(solution: Solution) -> Responses:
    """`Solution.responses`, without the module that Equinox makes at each call of a method (15 µs)."""
    if isinstance(solution.law, Responses):
        return solution.law
    assert solution.plan is not None
    trace, found = solution.__dict__.get(_CACHE, (None, None))
    if found is not None and (trace is None or trace == current_trace()):
        return found
    rows = Saved(solution.ts, solution.xs, solution.law.ys, solution.result)
    found, missing = saved_responses(solution.setup, solution.plan, rows)
    concrete = _tree.is_concrete(found, missing)
    if concrete and (first := float(np.asarray(missing).min())) < math.inf:
        raise _without_response(solution, first, found)
    # The fields of the module are frozen, and this is none.
    object.__setattr__(solution, _CACHE, (None if concrete else current_trace(), found))
    return found


def _without_response(solution: Solution, t: float, found: Responses) -> SolveError:
    fields = {"law": found, "result": RESULTS.nonfinite}
    return SolveError(
        f"The law has no finite solution at the saved time t = {t:.17g}, though all steps "
        "were made.",
        dataclasses.replace(solution, **fields),
        (Fix("", "", f"Solve the law alone there: dvax.Problem.law({t:g}, x, args)"),),
    )
