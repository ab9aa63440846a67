"""The public call for error bounds: by given constants, or by constants along the trajectory."""

import dataclasses
from typing import Any

import numpy as np

from .. import _tree
from .._captured import current
from ..errors import input_error
from ..evolution import Solution
from ..evolution.certified import knot_near_end
from ..problem import Problem
from .along import bound_along
from .certificate import Bound, bound_by_constants, check_bounded
from .constants import Constants
from .status import weakest


def bound_error(
    problem: Problem, sol: Solution, constants: Constants | None = None, *,
    initial_error: Any = 0.0, max_steps: int = 5_000_000,
) -> Bound:  # fmt: skip
    """Bound the error of a computed trajectory at its saved times.

    **Arguments:** `problem` and `sol`, the solution of it; `constants`, its moduli; `initial_error`,
    a bound on ‖x_h(t0) − x(t0)‖, or the `Bound` of the run that this one continues from its last
    saved state. (With M > 1 every piece multiplies the bound by M.) `max_steps`, without constants,
    limits the steps of the run below, and so the time of the call: where they are used up the bound
    becomes infinite.

    **Without constants** the bound is proved along the trajectory, in tubes around pieces of it, from
    the code of f and h: no region has to be given, and errors grow in the bound as those of the
    linearised system do. The problem is solved once more for this, and the distance of `sol` from this
    run is added: `sol` may be of any method. The run is one of `PiecewiseLinear` where that solved
    `sol`, or can solve the problem and x and u have at most 16 unknowns; otherwise it is one of
    `ETD2RK` with tolerances of 10⁻⁹ to 10⁻⁵, which become up to 100 times larger where it would take
    more than `max_steps`.
    `x_paper` is then the bound that the constants of each piece give with the bound at its start, and
    `x_sharp` is `x`. With more than 128 unknowns errors grow at the rates of these constants. Where
    `ETD2RK` samples its defect, as for a set whose motion has no rule, the bound is an estimate.

    If the solve did not record its defect (fixed steps), or the bounds of its trajectory (for constants
    of a region that were not passed to it), the problem is solved again with the same steps, and the
    distance of the two runs is added.

    Constants that `dvax.verify` found for a region of x or u hold while the trajectory stays in it.
    If the enclosure of the trajectory up to a saved time, enlarged by its bound, is not inside the
    region, the bounds are infinite from there on. (Between two saved times the enlargement uses the
    bound at the earlier one and all disturbances since, so more saved times make it sharper.) For
    times or `args` other than those verified the status is "declared". With a region of u, the
    bounds concern the solution whose response stays in it; a law that is monotone only there may
    have other solutions.

    Events that are only recorded change no step, and no bound. A run that a terminal event ended has
    bounds at its saved times, its last one included: they compare the two trajectories at the same
    time, and the exact one may meet its own event a little earlier or later. Events with a reset are
    refused.

    The bound is proved where the defect of `sol` is enclosed: solve with these `constants=`, or, for a
    law in closed form on a box, name `method=dvax.ETD2RK()`. Where the defect was sampled, it is an
    estimate.

    **Raises:** `dvax.InputError` if `sol` is not a solution of `problem`, has events with a
    reset, `initial_error` is not a number ≥ 0, or `max_steps` no integer ≥ 1;
    without constants, if none are proved around the
    initial state, or values are traced.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
    ...                             kappa0=0.5, g=1.0, ell=3.0)
    >>> sol = dvax.solve(model.problem, -1.0, 0.0, 2.0, rtol=1e-6, constants=model.constants)
    >>> bound = dvax.bound_error(model.problem, sol, model.constants)
    >>> bool(bound.x[-1] >= abs(sol.xs[-1] - 1.8360919559905713)), bound.status
    (True, 'proved')
    >>> spring = dvax.Problem(               # van der Pol's oscillator, with a limited force
    ...     A=dvax.generators.Scalar(0.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-0.5, 0.5),
    ...     f=lambda t, x, u, args: jnp.stack([x[1], (1.0 - x[0] ** 2) * x[1] - x[0] + u]),
    ...     h=lambda t, x, u, args: -x[1], control_space=dvax.spaces.Euclidean(()),
    ... )
    >>> sol = dvax.solve(spring, jnp.array([1.0, 0.0]), 0.0, 1.0)
    >>> bound = dvax.bound_error(spring, sol)
    >>> bool(bound.x[-1] < 1e-5), bound.status
    (True, 'proved')

    ```
    """
    if constants is not None:
        return _checked(bound_by_constants(problem, sol, constants, initial_error), sol)
    problem = current(problem)
    check_bounded(problem, sol, initial_error)
    if isinstance(max_steps, bool) or not isinstance(max_steps, int | np.integer) or max_steps < 1:
        raise input_error(
            "dvax.bound_error(max_steps)", repr(max_steps), "it must be an integer ≥ 1",
            "Omit it for 5000000",
        )  # fmt: skip
    error = initial_error.x[-1] if isinstance(initial_error, Bound) else initial_error
    if not _tree.is_concrete(sol.ts, sol.xs, sol.us, sol.setup.setting, sol.setup.args, error):
        raise input_error(
            "dvax.bound_error(constants)", "None", "constants are proved from values, which are traced",
            "Call it outside of jax.jit, jax.vmap and jax.grad, or pass constants",
        )  # fmt: skip
    if len(sol.ts) == 0:
        raise input_error(
            "dvax.bound_error(sol)", "no saved time", "a bound exists at saved times only",
            "Save the end of the run: ts=[t1]",
        )  # fmt: skip
    return _checked(bound_along(problem, sol, float(np.asarray(error)), max_steps), sol)


def _checked(bound: Bound, sol: Solution) -> Bound:
    """Return the bound, which is estimated if steps do not end at all knots of the data."""
    setup = sol.setup
    if not _tree.is_concrete(setup.problem, setup.setting, setup.x0, setup.args):
        return bound
    near = knot_near_end(setup)
    if not np.isfinite(near):
        return bound
    why = (
        f"the data may jump at t = {near:.17g}, some roundings of t from an end of the run, where "
        "no step ends. A run from there, or to there, has a proved bound"
    )
    return dataclasses.replace(
        bound, status=weakest(bound.status, "estimated"), why=bound.why or why
    )
