"""Solve a problem by `PiecewiseLinear`, from `Setup` to `Solution`."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ... import _tree
from ..._once import once_per_object
from ...errors import DifferentiationError
from ...operators import AbstractOperator
from ...problem import Knots, Problem
from ...spaces import AbstractSpace
from ..bounds import Bounds
from ..responses import Responses
from ..results import RESULTS
from ..setup import Options, Setup
from ..solution import Solution
from .defect import Norms
from .inputs import Piece, UnresolvedInput, build_pieces
from .records import Row
from .run import Run
from .system import Affine, affine, pivoted
from .trajectory import Trajectory

Array = np.ndarray


def propagate(setup: Setup, ts: Any, options: Options) -> Solution:
    """Return the solution, up to the last saved time that was reached if the run fails. Of the options
    it uses `max_steps` (accepted and rejected ones), `measure`, `dense`, `track_bounds` and `progress`.

    **Raises:** `dvax.InputError` if the problem is not piecewise affine; `dvax.DifferentiationError`
    under `jax.jit`, `jax.grad` and `jax.vmap`.
    """
    numbers = setup.problem, setup.x0, setup.args, setup.setting, ts
    if not _tree.is_concrete(*numbers):
        raise DifferentiationError(
            "dvax.PiecewiseLinear runs on the host and cannot be traced by jax.jit, jax.grad, "
            "jax.jvp or jax.vmap. Use method=dvax.ExpRosenbrock() there: it solves the same systems "
            "if they are not too stiff."
        )
    setup_start = time.perf_counter()
    problem, x0, args = setup.problem, jnp.asarray(setup.x0), _tree.as_arrays(setup.args)
    t0, t1, rtol, atol = (float(setup.setting[name]) for name in ("t0", "t1", "rtol", "atol"))
    data = _data(problem, t0, x0, args)
    system, spaces = data.system, problem.spaces(x0)
    stops = np.concatenate([[t0], np.asarray(data.knots.within(t0, t1), float), [t1]])
    times = np.array([t1]) if ts is None else np.asarray(ts, float)
    unresolved = None
    try:
        pieces = build_pieces(problem, stops, x0, args, options.max_steps, options.measure)
    except UnresolvedInput as error:
        pieces = [Piece(t0, t1 - t0, np.zeros((1, 1)), np.zeros(1), np.zeros(1))]
        unresolved = error
    run = Run(
        system, data.pivoted, pieces, np.asarray(x0, float).ravel(), data.norms, (rtol, atol), times,
        options, float(jnp.finfo(x0.dtype).eps),
    )  # fmt: skip
    setup_end = time.perf_counter()
    if unresolved is None:
        run.advance()
    else:
        run.t, run.result = unresolved.t, unresolved.result
        if run.result == "max_steps":
            run.rejected = options.max_steps  # each piece needs at least one step
    timing = {
        "compile_time": setup_end - setup_start,
        "run_time": time.perf_counter() - setup_end,
    }
    return _solution(setup, x0, run, system, spaces, options, timing, pieces)


class _Data(NamedTuple):
    """What a run needs of a problem, and the arguments that it belongs to; `norms`: those of the
    unit vectors of both spaces."""

    like: tuple[Any, ...]
    args: Any
    knots: Knots
    system: Affine
    pivoted: Affine
    norms: Norms

    def serves(self, x0: jax.Array, args: Any) -> bool:
        """Return whether a run from x0 with these args has the same data."""
        return self.like == (x0.shape, x0.dtype) and _tree.same_values(self.args, args)


_cache: Callable[[Problem], list[_Data]] = once_per_object(lambda problem: [])
"""The data of the last run of each problem: a run in pieces traces its functions once."""


def _data(problem: Problem, t0: float, x0: jax.Array, args: Any) -> _Data:
    """Return the data of a run. **Raises:** `dvax.InputError`, as `propagate` does."""
    cache = _cache(problem)
    if not (cache and cache[0].serves(x0, args)):
        problem.check(t0, x0, args)
        knots, system = problem.data_knots(t0, x0, args), affine(problem, t0, x0, args)
        likes = x0, problem.zero_control(x0)
        norms = Norms(
            *(
                np.asarray(
                    _norms(space, jnp.eye(v.size, dtype=v.dtype).reshape(-1, *v.shape)), float
                )
                for space, v in zip(problem.spaces(x0), likes, strict=True)
            )
        )
        like = x0.shape, x0.dtype
        # A copy: an array of NumPy may be changed before the next run.
        args = jtu.tree_map(lambda v: np.array(v) if isinstance(v, np.ndarray) else v, args)
        cache[:] = [_Data(like, args, knots, system, pivoted(system), norms)]
    return cache[0]


@eqx.filter_jit
def _norms(space: AbstractSpace, rows: jax.Array) -> jax.Array:
    return jax.vmap(space.norm)(rows)


@eqx.filter_jit
def _inverses(operator: AbstractOperator, rows: jax.Array) -> jax.Array:
    return jax.vmap(operator.inverse)(rows)


def _solution(
    setup: Setup, x0: Any, run: Run, system: Affine, spaces: tuple[AbstractSpace, AbstractSpace],
    options: Options, timing: dict[str, float], pieces: list[Piece],
) -> Solution:  # fmt: skip
    rows, dtype, problem = run.rows, x0.dtype, setup.problem
    u0 = problem.zero_control(x0)
    P = problem.operator(_tree.as_arrays(setup.args))
    n, m = x0.size, u0.size
    array = lambda values, shape: jnp.asarray(  # noqa: E731
        np.reshape(np.array(values, float), (len(rows), *shape)), dtype
    )
    ys, w = (np.reshape(np.array([r[k] for r in rows]), (len(rows), m)) for k in (2, 3))
    tau = 1.0 / max(float(np.linalg.norm(system.M, 2)), np.finfo(float).tiny)
    # One projection step as in `dvax.vi.certificate`, simplified for affine F.
    projection_step = ys - np.clip(ys - tau * w, system.low, system.up)
    size = lambda v: _norms(spaces[1], array(v, u0.shape))  # noqa: E731
    of_w = np.reshape(np.array([r.of_w for r in rows]), (len(rows), m))
    residual = size(projection_step / tau - projection_step @ system.M.T) + size(of_w)
    step = size(projection_step)
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
        law=Responses(_inverses(P, y) if rows else y, y, residual, step, error),
        defect=array(defects[:, 0], ()) if options.measure else None,
        law_defect=array(defects[:, 1], ()) if options.measure else None,
        completed_defect=(
            (array(completed_defect[:, 0], ()), array(completed_defect[:, 1], ()))
            if options.measure
            else None
        ),
        bounds=_bounds(rows, n, x0, u0, P) if options.track_bounds and rows else None,
        stats={
            "steps": run.accepted, "rejected": run.rejected,
            "evaluations": run.accepted + run.rejected, "switchings": run.switchings,
            "t": run.t, "x": jnp.asarray(run.x.reshape(x0.shape), dtype),
            "next_dt": setup.setting["dt0"], **timing,
        },
        result=getattr(RESULTS, run.result),
        records=_trajectory(run) if options.dense else None,
        events=None,
        enclosed=options.measure and all(piece.is_proved for piece in pieces),
        plan=None,
        setup=setup,
    )  # fmt: skip


def _bounds(rows: list[Row], n: int, x0: Any, u0: Any, P: Any) -> Bounds:
    """Return bounds on x and on u = P⁻¹y, the latter by interval arithmetic with the matrix P⁻¹."""
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
    start, changes = (
        np.array([step.start for step in run.steps]),
        np.array([t for t, _ in run.events]),
    )
    modes = np.reshape([mode for _, mode in run.events], (-1, run.system.B.shape[1]))
    return Trajectory(start, tuple(run.steps), changes, modes)
