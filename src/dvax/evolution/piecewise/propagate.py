"""A solve by `PiecewiseLinear`, from its setup to its solution."""

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ... import _tree
from ...errors import DifferentiationError
from ...spaces import AbstractSpace
from ..bounds import Bounds
from ..results import RESULTS
from ..setup import Setup, as_arrays
from ..solution import Solution
from .inputs import Piece, Unresolved, pieces
from .radau import STAGES
from .records import Row
from .run import Run
from .system import Affine, affine, pivoted
from .trajectory import Trajectory

Array = np.ndarray


class Limits(NamedTuple):
    """The most steps, rejected ones included; whether to keep all of them, to bound x and u, and to
    print the percentage of the run that is done."""

    max_steps: int
    dense: bool
    track_bounds: bool
    progress: bool


def propagate(setup: Setup, ts: Any, limits: Limits) -> Solution:
    """The solution; where it fails, up to the last saved time that was reached.

    **Raises:** `dvax.InputError` where the problem is not affine in pieces; `dvax.DifferentiationError`
    under `jax.jit`, `jax.grad` and `jax.vmap`.
    """
    numbers = setup.problem, setup.x0, setup.args, setup.setting, ts
    if not _tree.is_concrete(*numbers):
        raise DifferentiationError(
            "dvax.PiecewiseLinear runs on the host and cannot be traced: no jax.jit, jax.grad, jax.jvp "
            "or jax.vmap around it. Use method=dvax.ExpRosenbrock() there: it solves the same systems, "
            "as long as they are not too stiff."
        )
    begun = time.perf_counter()
    problem, x0, args = setup.problem, jnp.asarray(setup.x0), as_arrays(setup.args)
    t0, t1, rtol, atol = (float(setup.setting[name]) for name in ("t0", "t1", "rtol", "atol"))
    problem.check(t0, x0, args)
    knots = np.asarray(problem.knots(t0, t1, x0, args), float)
    stops = np.concatenate([[t0], knots, [t1]])
    given = affine(problem, t0, x0, args)
    state, control = problem.spaces(x0)
    weights = np.asarray(jax.vmap(lambda v: state.norm(v.reshape(x0.shape)))(jnp.eye(x0.size)))
    times = np.array([t1]) if ts is None else np.asarray(ts, float)
    try:
        found = pieces(problem, stops, x0, args, limits.max_steps)
    except Unresolved as error:
        nothing = [Piece(t0, t1 - t0, np.zeros((1, 1)), np.zeros(1), np.zeros(1))]
        run = Run(
            given, given, nothing, np.asarray(x0, float).ravel(), weights, (rtol, atol),
            *limits_of(limits, times),
        )  # fmt: skip
        run.t, run.result = error.t, error.result
        if run.result == "max_steps":
            run.rejected = limits.max_steps  # a step for each piece is too many
        prepared = time.perf_counter()
    else:
        run = Run(
            given, pivoted(given), found, np.asarray(x0, float).ravel(), weights, (rtol, atol),
            *limits_of(limits, times),
        )  # fmt: skip
        prepared = time.perf_counter()
        run.go()
    timing = {"compile_time": prepared - begun, "run_time": time.perf_counter() - prepared}
    return _solution(setup, x0, run, given, (state, control), limits, timing)


def limits_of(limits: Limits, times: Array) -> tuple[int, Array, bool, bool, bool]:
    """The last arguments of a `Run`."""
    return limits.max_steps, times, limits.dense, limits.track_bounds, limits.progress


def _solution(
    setup: Setup, x0: Any, run: Run, given: Affine, spaces: tuple[AbstractSpace, AbstractSpace],
    limits: Limits, timing: dict[str, float],
) -> Solution:  # fmt: skip
    rows, dtype, problem = run.rows, x0.dtype, setup.problem
    u0 = problem.zero_control(x0)
    P = problem.operator(as_arrays(setup.args))
    n, m = x0.size, u0.size
    array = lambda values, shape: jnp.asarray(  # noqa: E731
        np.reshape(np.array(values, float), (len(rows), *shape)), dtype
    )
    ys, w = (np.reshape(np.array([r[k] for r in rows]), (len(rows), m)) for k in (2, 3))
    tau = 1.0 / max(float(np.linalg.norm(given.M, 2)), np.finfo(float).tiny)
    # One projection step, as in `dvax.vi.certificate`; F is affine.
    moved = ys - np.clip(ys - tau * w, given.low, given.up)
    size = lambda v: jax.vmap(spaces[1].norm)(array(v, u0.shape))  # noqa: E731
    residual, step = size(moved / tau - moved @ given.M.T), size(moved)
    gamma, norm_P_inv = setup.moduli.get("gamma"), setup.moduli.get("norm_P_inv")
    error = None
    if gamma is not None and norm_P_inv is not None:
        error = norm_P_inv * (residual / gamma + step)
    defects = np.reshape([r.defect for r in rows], (len(rows), 2))
    completed_defect = np.reshape([r.completed_defect for r in rows], (len(rows), 2))
    y = array(ys, u0.shape)
    return Solution(
        ts=array([r.t for r in rows], ()),
        xs=array([r.x for r in rows], x0.shape),
        us=jax.vmap(P.inverse)(y) if rows else y,
        ys=y,
        law_residual=residual,
        law_step=step,
        law_error=error,
        defect=array(defects[:, 0], ()),
        law_defect=array(defects[:, 1], ()),
        completed_defect=(array(completed_defect[:, 0], ()), array(completed_defect[:, 1], ())),
        bounds=_bounds(rows, n, x0, u0, P) if limits.track_bounds and rows else None,
        stats={
            "steps": run.accepted, "rejected": run.rejected,
            "evaluations": run.accepted + run.rejected, "switchings": run.switchings,
            "t": run.t, "x": jnp.asarray(run.x.reshape(x0.shape), dtype),
            "next_dt": setup.setting["dt0"], **timing,
        },
        result=getattr(RESULTS, run.result),
        records=_trajectory(run) if limits.dense else None,
        enclosed=False,
        plan=None,
        setup=setup,
    )  # fmt: skip


def _bounds(rows: list[Row], n: int, x0: Any, u0: Any, P: Any) -> Bounds:
    """Bounds of x and of u = P⁻¹y, the latter by the sizes of the entries of P⁻¹."""
    values = np.array([r.bounds for r in rows])
    inverse = np.asarray(
        jax.vmap(lambda v: P.inverse(v.reshape(u0.shape)).ravel())(jnp.eye(u0.size))
    ).T
    low, high = values[:, 0, n:], values[:, 1, n:]
    up, down = np.maximum(inverse, 0.0), np.minimum(inverse, 0.0)
    of = lambda v, like: jnp.asarray(v.reshape(len(rows), *like.shape), like.dtype)  # noqa: E731
    with np.errstate(invalid="ignore"):
        u = low @ up.T + high @ down.T, high @ up.T + low @ down.T
    return Bounds(
        (of(values[:, 0, :n], x0), of(values[:, 1, :n], x0)), (of(u[0], u0), of(u[1], u0))
    )


def _trajectory(run: Run) -> Trajectory:
    steps, (n, m) = run.steps, run.given.B.shape
    count, most = len(steps), max((len(step.rings) for step in steps), default=0)
    stack = lambda name, *shape: np.reshape(  # noqa: E731
        [getattr(step, name) for step in steps], (count, *shape)
    )
    rates = np.zeros((count, most), complex)
    ring_x, ring_y = np.zeros((count, most, n), complex), np.zeros((count, most, m), complex)
    for k, step in enumerate(steps):
        for i, (rate, x, y) in enumerate(step.rings):
            rates[k, i], ring_x[k, i], ring_y[k, i] = rate, x, y
    return Trajectory(
        stack("start"), stack("length"), stack("used"), stack("x", STAGES + 1, n),
        stack("y", STAGES, m), rates, ring_x, ring_y,
        np.array([t for t, _ in run.events]), np.reshape([mode for _, mode in run.events], (-1, m)),
    )  # fmt: skip
