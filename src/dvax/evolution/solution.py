"""What a solve returns."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from .bounds import Bounds
from .diagnose import failure
from .flow import Flow
from .implicit import Implicit
from .outcome import Record
from .piecewise.method import PiecewiseLinear
from .piecewise.trajectory import Trajectory, signs
from .plan import Plan
from .regimes import Regimes, regimes
from .results import RESULTS
from .setup import Setup
from .stepper import interpolate, local

if TYPE_CHECKING:
    import xarray


class Solution(eqx.Module):
    """A trajectory with its response, its errors and how it was computed.

    - `ts`: the saved times; `xs`, `us`, `ys`: states, responses u and y = P u there, each with a
      leading time axis;
    - `law_error`: a certified bound on ‖u − u*‖ of the frozen law at each saved time (C0 of
      `dvax.vi.certificate`), or None where γ was not given (`constants=`), ‖P⁻¹‖(‖w‖/γ + ‖ȳ − y‖)
      with `law_residual` = ‖w‖ and `law_step` = ‖ȳ − y‖ of one projection step from y;
    - `defect`: ∫ ‖p − f̃(·, x_h)‖ ds up to each saved time, where x_h is the computed trajectory: it is
      the exact solution of the system with a disturbance p − f̃ of that size. `law_defect` is the same
      integral of ‖w‖ over the frozen solves. Both None where not measured (fixed steps, unless
      `measure=True`). `dvax.bound_error` turns them into error bounds;
    - `completed_defect`: (defect, law_defect) at the start of the step that each saved time lies in;
    - `bounds`: between what x_h and u_h stayed from t0 to the end of that step, where `constants=` of a
      region were given;
    - `enclosed`: whether the defect, and the bounds, are enclosures over every step
      (`dvax.programs.enclosure`) or estimates from samples;
    - `stats`: steps accepted and rejected, `evaluations` of F in them (without those that look for
      kinks or read u at saved times), and where the run stands: t, x and the next step; with
      `compile_time` and `run_time` in seconds, unless the solve is part of a larger compiled program;
    - `result`: `dvax.RESULTS.successful`, or what went wrong;
    - `plan`: what the code of f, h and K proved about the law (None with `PiecewiseLinear`);
    - `setup`: the arguments; `records`: the steps, where `dense=True` kept them.

    ```python
    >>> import dvax
    >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
    ...                             kappa0=0.5, g=1.0, ell=3.0)
    >>> sol = dvax.solve(model.problem, -1.0, 0.0, 2.0, ts=[0.0, 1.0, 2.0], dense=True,
    ...                  max_steps=10_000)
    >>> sol.xs.shape, sol.enclosed
    ((3,), True)
    >>> x, u = sol.evaluate(0.4)
    >>> print(f"{float(u):.3f}")
    0.288

    ```
    """

    ts: jax.Array
    xs: Tree
    us: Tree
    ys: Tree
    law_residual: jax.Array
    law_step: jax.Array
    law_error: jax.Array | None
    defect: jax.Array | None
    law_defect: jax.Array | None
    completed_defect: tuple[jax.Array, jax.Array] | None
    bounds: Bounds | None
    stats: dict[str, Any]
    result: RESULTS
    records: Record | Trajectory | None
    enclosed: bool = eqx.field(static=True)
    plan: Plan | None = eqx.field(static=True)
    setup: Setup

    @property
    def flow(self) -> Flow:
        """The reduced map f̃ of the run, by what its plan proved."""
        plan = Plan.of(self.setup) if self.plan is None else self.plan
        return plan.flow(self.setup)

    def evaluate(self, t: Any) -> tuple[Tree, Tree]:
        """(x(t), u(t)) at any time of a solve made with `dense=True`.

        x is the step's own polynomial propagated exactly in A; u is solved from the law at (t, x).

        **Raises:** `dvax.InputError` where the steps were not kept, or t lies outside them.
        """
        if self.records is None:
            raise InputError(
                InputProblem(
                    "Solution.evaluate",
                    f"t = {t}",
                    "the steps were not kept, so nothing is known between the saved times",
                    "Solve with dense=True, or name the times in ts=",
                )
            )
        if isinstance(self.records, Trajectory):
            records = self.records
            self._check_inside(t, records.start[0], records.end)
            x, y = records.evaluate(t)
            x0, u0 = self.setup.x0, self.us[0]
            u = self.flow.operator.inverse(y.reshape(u0.shape).astype(u0.dtype))
            return x.reshape(jnp.shape(x0)).astype(self.xs.dtype), u
        if _tree.is_concrete(t):
            return self._within_step(t)

        # A call by name: a step in data that is the trajectory of another run needs no enclosure.
        def dvax_evaluate(t: Any) -> tuple[Tree, Tree]:
            return self._within_step(t)

        return jax.jit(dvax_evaluate)(t)

    def _within_step(self, t: Any) -> tuple[Tree, Tree]:
        """x and u at t, from the record of the step that t lies in."""
        flow, records = self.flow, self.records
        assert isinstance(records, Record)
        t = jnp.asarray(t, records.start.dtype)
        starts = records.start
        first, last = starts[0], jnp.max(jnp.where(jnp.isfinite(starts), starts, -jnp.inf))
        i = jnp.clip(jnp.searchsorted(starts, t, side="right") - 1, 0)
        step = jax.tree_util.tree_map(lambda leaf: leaf[i], records)
        end = last + records.length[jnp.searchsorted(starts, last)]
        self._check_inside(t, first, end)
        theta = (t - step.start) / step.length
        run = self.setup.number("t0"), self.setup.number("t1")
        method = self.setup.method
        assert not isinstance(method, Implicit | PiecewiseLinear)
        own, _ = local(
            method, flow, step.start, step.start + step.length, step.x0,
            flow.guess(step.x0), run,
        )  # fmt: skip
        x = interpolate(own, step.length, theta, step.x0, step.coefficients)
        rate = flow.rate(t, x, None)
        return x, flow.operator.inverse(rate.y)

    def _check_inside(self, t: Any, first: Any, end: Any) -> None:
        if _tree.is_concrete(t, first, end) and not first <= t <= end:
            raise InputError(
                InputProblem(
                    "Solution.evaluate",
                    f"t = {float(t):g}",
                    f"the solve covers [{float(first):g}, {float(end):g}]",
                    "Solve further, or ask for a time inside",
                )
            )

    def regimes(self) -> Regimes:
        """The times at which the response enters or leaves the boundary of K, and on what side of which
        bound it is between them, for a solve made with `dense=True`.

        **Raises:** `dvax.InputError` where the steps were not kept, or K does not say where its
        projection has kinks.

        ```python
        >>> import dvax
        >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
        ...                             kappa0=0.5, g=1.0, ell=3.0)
        >>> sol = dvax.solve(model.problem, -1.0, 0.0, 2.0, rtol=1e-8, dense=True, max_steps=20_000)
        >>> times, positive = sol.regimes()
        >>> [f"{t:.6f}" for t in times]                        # held above, free, held at 0
        ['0.000000', '0.313336', '0.524057', '2.000000']
        >>> positive.tolist()
        [[True, False], [True, True], [False, True]]

        ```
        """
        if self.records is None or int(self.stats["steps"]) == 0:
            raise InputError(
                InputProblem(
                    "Solution.regimes",
                    "a solution without its steps" if self.records is None else "no step at all",
                    "changes between the saved times are found on the steps themselves",
                    "Solve with dense=True",
                )
            )
        if isinstance(self.records, Trajectory):
            return Regimes(*signs(self.records))
        flow = self.flow
        x0, t0 = self.setup.x0, self.setup.number("t0")
        if flow.switches(t0, x0, flow.problem.zero_control(x0)) is None:
            raise InputError(
                InputProblem(
                    "Solution.regimes",
                    f"a {type(flow.problem.set_at(t0, flow.args)).__name__}",
                    "the set must say where its projection has kinks (dvax.sets.AbstractSet.switches)",
                    "Give the set as one that does, a dvax.sets.Polyhedron, say",
                )
            )
        assert not isinstance(self.setup.method, Implicit | PiecewiseLinear)
        return regimes(flow, self.setup.method, self.records, int(self.stats["steps"]))

    def raise_if_failed(self) -> "Solution":
        """This solution, or a `dvax.SolveError` that carries it."""
        if self.result != RESULTS.successful:
            raise failure(self)
        return self

    def to_xarray(self) -> "xarray.Dataset":
        """The saved trajectory as an `xarray.Dataset` with dimension `time`.

        Parts of a tuple state become `x0`, `x1`, …; axes of an array become `x_dim0`, ….

        **Raises:** `ModuleNotFoundError` where xarray (the extra `dvax[app]`) is not installed.
        """
        import xarray

        variables: dict[str, Any] = {}
        for name, tree in (("x", self.xs), ("u", self.us), ("y", self.ys)):
            leaves = jax.tree_util.tree_leaves(tree)
            for k, leaf in enumerate(leaves):
                label = name if len(leaves) == 1 else f"{name}{k}"
                dims = ("time", *(f"{label}_dim{i}" for i in range(leaf.ndim - 1)))
                variables[label] = (dims, np.asarray(leaf))
        for name, series in (("law_error", self.law_error), ("defect", self.defect)):
            if series is not None:
                variables[name] = (("time",), np.asarray(series))
        return xarray.Dataset(variables, coords={"time": np.asarray(self.ts)})
