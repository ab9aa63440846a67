"""`dvax.solve`: the mild solution of a coupled system."""

import math
import warnings
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import DifferentiationError, InputError, InputProblem, SolveError
from ..problem import Problem
from ..vi import AbstractSolver, Auto, analyse, certify, independent
from .control import Adaptive, Fixed, root_mean_squares, step_count
from .diagnose import diagnose
from .flow import Flow, slope
from .method import ETD2RK, AbstractMethod
from .solution import RESULTS, Solution
from .stepper import Carry, MildTerm, Record, Stepper

_ADAPTIVE_STEPS = 2**20
_CHECKPOINT_BYTES = 2**30


def solve(
    problem: Problem,
    x0: Tree,
    t0: Any,
    t1: Any,
    args: Any = None,
    ts: Any = None,
    dt: Any = None,
    rtol: Any = 1e-6,
    atol: Any = 1e-9,
    method: AbstractMethod | None = None,
    vi_solver: AbstractSolver | None = None,
    progress: bool = False,
    *,
    constants: Any = None,
    measure: bool | None = None,
    dense: bool = False,
    dt0: Any = None,
    horizon: Any = None,
    max_steps: int | None = None,
    adjoint: str = "reverse",
    throw: bool = True,
) -> Solution:
    """Solve x' = Ax + f(t, x, u), u ∈ h(t, x, u) − N_{K(t)}(P u) from x(t0) = x0 up to t1.

    **Arguments:**

    - `ts`: times to save at, increasing, in [t0, t1]; None saves t1 alone;
    - `dt`: fixed steps, no longer than this (the fewest equal ones between knots of the data);
      without it, steps adapt;
    - `rtol`, `atol`: the disturbance that the computed trajectory may amount to, integrated over the
      run and relative to |x|: the defect is kept below (atol + rtol|x|)/horizon. For a system whose
      trajectories do not separate, that is a bound on the error;
    - `method`: `dvax.ETD2RK()` by default; `vi_solver`: `dvax.vi.Auto()` by default;
    - `constants`: `dvax.Constants` (or any object with `gamma`, `L_F`, `norm_P_inv`): lets the law be
      solved to a tolerance on its true error, and certifies every saved u;
    - `measure`: whether to sample the defect inside steps. Adaptive steps always do; fixed steps only
      when asked, since it doubles their cost;
    - `dense`: keep every step, for `Solution.evaluate`; memory grows with `max_steps`;
    - `dt0`, `horizon`: first step and length of the whole run, to continue a run in pieces;
    - `max_steps`: the most steps, 2²⁰ by default for adaptive ones; with fixed steps, counted;
    - `adjoint`: "reverse" serves `jax.grad` and `jax.vjp`, "forward" serves `jax.jvp` and
      `jax.jacfwd`: one loop cannot serve both;
    - `throw`: raise where the solve fails; otherwise look at `result`.

    **Returns:** a `Solution`.

    **Raises:** `dvax.InputError` for arguments that break a rule, all of them at once;
    `dvax.SolveError`, with the partial `solution`, where the solve fails;
    `dvax.DifferentiationError` for the wrong `adjoint`.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> sol = dvax.solve(problem, -1.0, 0.0, 2.0, rtol=1e-8)
    >>> print(f"{float(sol.xs[0]):.6f}")
    1.836092

    ```
    """
    x0 = _tree.as_float(x0, "x0")
    method = ETD2RK() if method is None else method
    _check(problem, x0, t0, t1, ts, dt, rtol, atol, dt0, horizon, method, adjoint)
    dtype = jnp.result_type(*jax.tree_util.tree_leaves(x0))
    _warn_precision(dtype, dt, rtol)
    span = _subtract(t1, t0)
    setting = {
        "t0": t0,
        "t1": t1,
        "dt": math.nan if dt is None else dt,
        "rtol": rtol,
        "atol": atol,
        "dt0": span * 1e-3 if dt0 is None else dt0,
        "horizon": span if horizon is None else horizon,
    }
    # As arrays: a Python number would be compiled in, and every new tolerance compiled again.
    setting = {k: np.asarray(v) if _tree.is_concrete(v) else v for k, v in setting.items()}
    fixed = dt is not None
    steps = _bound_steps(max_steps, fixed, t0, t1, dt)
    run = {
        "fixed": fixed,
        "measure": (not fixed) if measure is None else bool(measure) or not fixed,
        "careful": not fixed,
        "dense": dense,
        "max_steps": steps,
        "adjoint": adjoint,
        "progress": progress,
    }
    call = (problem, x0, args, None if ts is None else _times(ts), setting)
    rest = (method, Auto() if vi_solver is None else vi_solver, _moduli(constants))
    solution = _differentiably(call, rest, run)
    if _tree.is_concrete(solution.result):
        solution = _trim(solution)
        if solution.result != RESULTS.successful:
            # Data that ends too early is NaN from there on: then that is what is wrong.
            problem.knots(t0, t1, x0, args)
            if fixed:
                # Once more, keeping the last good state, to say where it went wrong.
                solution = _trim(_integrate(*call, *rest, **{**run, "careful": True}))
            if throw:
                raise SolveError(_explain(solution), solution)
    return solution


@eqx.filter_jit
def _integrate(
    problem: Problem,
    x0: Tree,
    args: Any,
    ts: Any,
    setting: dict[str, Any],
    method: AbstractMethod,
    vi_solver: AbstractSolver,
    moduli: dict[str, Any],
    *,
    fixed: bool,
    measure: bool,
    careful: bool,
    dense: bool,
    max_steps: int,
    adjoint: str,
    progress: bool,
) -> Solution:
    dtype = jnp.result_type(*jax.tree_util.tree_leaves(x0))
    s = {name: jnp.asarray(value, dtype) for name, value in setting.items()}
    t0, t1 = s["t0"], s["t1"]
    # Shapes and knots are looked at here, while tracing: a call that is compiled pays nothing.
    problem.check(t0, x0, args)
    knots = jnp.asarray(problem.knots(t0, t1, x0, args), dtype)
    if fixed:
        max_steps += knots.shape[0]
    state, control = problem.spaces(x0)
    generator = problem.generator(args)
    flow = _flow(problem, x0, args, t0, generator, vi_solver, moduli, s, dtype)

    uniform = None
    if fixed:
        stops = jnp.concatenate([t0[None], knots, t1[None]])
        controller = Fixed(s["dt"], stops)
        first = None
        if knots.shape[0] == 0:
            length = (t1 - t0) / step_count(t1 - t0, s["dt"])
            uniform = generator.propagator(length, method.degree + 1)
    else:
        sizes = root_mean_squares(state)
        controller = Adaptive(s["rtol"], s["atol"], sizes, s["horizon"], knots, t1)
        first = s["dt0"]
    stepper = Stepper(method, flow, measure, careful, uniform)

    zero = jnp.zeros((), dtype)
    record = _blank_record(x0, method, dtype) if dense else None
    saved = diffrax.SubSaveAt(
        ts=ts if ts is None else jnp.asarray(ts, dtype),
        t1=ts is None,
        fn=lambda t, y, args: (y.x, y.defect, y.law_defect),
    )
    last = diffrax.SubSaveAt(t1=True, fn=lambda t, y, args: (y.x, y.defect, y.law_defect))
    steps = diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: y.record) if dense else None
    out = diffrax.diffeqsolve(
        MildTerm(),
        stepper,
        t0,
        t1,
        first,
        Carry(x0, zero, zero, record),
        saveat=diffrax.SaveAt(subs=(saved, last, steps), controller_state=True),
        stepsize_controller=controller,
        adjoint=_adjoint(adjoint, max_steps, x0),
        max_steps=max_steps,
        throw=False,
        progress_meter=diffrax.TextProgressMeter() if progress else diffrax.NoProgressMeter(),
    )
    assert out.ts is not None and out.ys is not None
    times = out.ts[0]
    xs, defect, law_defect = out.ys[0]
    us, ys, residual, law_error = _responses(flow, times, xs, control, moduli)
    records = out.ys[2] if dense else None
    result = _translate(out.result)
    stats = {
        "steps": out.stats["num_accepted_steps"],
        "rejected": out.stats["num_rejected_steps"],
        "t": out.ts[1][0],
        "x": jax.tree_util.tree_map(lambda leaf: leaf[0], out.ys[1][0]),
        "defect": out.ys[1][1][0],
        "next_dt": out.controller_state.length if not fixed else s["dt"],
        "setting": setting,
        "x0": x0,
        "method": method,
    }
    return Solution(
        ts=times,
        xs=xs,
        us=us,
        ys=ys,
        law_residual=residual,
        law_error=law_error,
        defect=defect if measure else None,
        law_defect=law_defect if measure else None,
        stats=stats,
        result=RESULTS.where(
            (result == RESULTS.successful) & ~_tree.all_finite(out.ys[1][0]),
            RESULTS.nonfinite,
            result,
        ),
        flow=flow,
        records=records,
    )


def _flow(problem, x0, args, t0, generator, vi_solver, moduli, s, dtype) -> Flow:
    like = problem.zero_control(x0)
    K = problem.set_at(t0, args)
    frozen = problem.frozen(t0, x0, args)
    structure = analyse(frozen, like)
    intervals = structure.pointwise and structure.affine and K.intervals(like) is not None
    closed = intervals or (structure.isotropic and not isinstance(like, tuple))
    solver = vi_solver
    if isinstance(vi_solver, Auto):
        solver = vi_solver.choose(frozen, K, like)
    direct = closed and isinstance(vi_solver, Auto)
    # A thousandth of what the defect may be, and no less than rounding allows.
    floor = 100 * jnp.finfo(dtype).eps
    tol = jnp.maximum(1e-3 * (s["atol"] + s["rtol"]) / jnp.maximum(1.0, s["horizon"]), floor)
    tol = jnp.where(jnp.isnan(s["dt"]), tol, jnp.maximum(1e-12, floor))
    operator = problem.operator(args)
    reciprocal = None
    if direct and independent(lambda t, x: slope(problem, operator, t, x, args), t0, x0):
        reciprocal = jax.tree_util.tree_map(
            jnp.reciprocal, slope(problem, operator, t0, x0, args)
        )
    return Flow(
        problem, args, generator, operator, solver, direct, reciprocal, tol,
        moduli.get("gamma"), moduli.get("L_F"),
    )  # fmt: skip


def _responses(flow: Flow, times, xs, control, moduli):
    """u, y and the certificate C0 of the law at the saved states."""
    gamma, norm_P_inv = moduli.get("gamma"), moduli.get("norm_P_inv")
    tau = 1.0 if moduli.get("L_F") is None else 1.0 / moduli["L_F"]

    def one(t, x):
        rate = flow.rate(t, x, None)
        K = flow.problem.set_at(t, flow.args)
        frozen = flow.problem.frozen(t, x, flow.args)
        checked = certify(frozen, K, control, rate.y, tau)
        step = control.norm(_tree.sub(checked.y, rate.y))
        u = flow.operator.inverse(rate.y)
        error = None
        if gamma is not None and norm_P_inv is not None:
            error = norm_P_inv * (checked.bound(gamma) + step)
        return u, rate.y, checked.norm, error

    return jax.vmap(one)(times, xs)


def _differentiably(call: tuple, rest: tuple, run: dict[str, Any]) -> Solution:
    try:
        return _integrate(*call, *rest, **run)
    except (TypeError, ValueError) as error:
        forward = "forward-mode autodiff" in str(error) or "custom_vjp" in str(error)
        reverse = "Reverse-mode differentiation does not work" in str(error)
        if run["adjoint"] == "reverse" and forward:
            raise DifferentiationError(
                'dvax.solve(adjoint="reverse") cannot be differentiated forward (jax.jvp, '
                'jax.jacfwd). Pass adjoint="forward": the loop that stores steps for the reverse '
                "pass is not the one that carries tangents along."
            ) from error
        if run["adjoint"] == "forward" and reverse:
            raise DifferentiationError(
                'dvax.solve(adjoint="forward") cannot be differentiated backward (jax.grad, '
                'jax.vjp). Pass adjoint="reverse", the default.'
            ) from error
        raise


def _adjoint(name: str, max_steps: int, x0: Tree) -> diffrax.AbstractAdjoint:
    if name == "forward":
        return diffrax.ForwardMode()
    # One checkpoint a step is the fast path (no step is computed twice more than once); larger
    # states get as many as fit the memory set aside, and recompute between them.
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree_util.tree_leaves(x0))
    affordable = max(64, _CHECKPOINT_BYTES // (8 * size + 512))
    return diffrax.RecursiveCheckpointAdjoint(checkpoints=min(max_steps, affordable))


def _bound_steps(max_steps: int | None, fixed: bool, t0, t1, dt) -> int:
    if max_steps is not None:
        return int(max_steps)
    if not fixed:
        return _ADAPTIVE_STEPS
    if not _tree.is_concrete(t0, t1, dt):
        raise InputError(
            InputProblem(
                "dvax.solve(max_steps)",
                "None, with t0, t1 or dt traced",
                "the number of fixed steps is then unknown when the loop is compiled",
                "Give max_steps, a bound on it",
            )
        )
    count = math.ceil((float(t1) - float(t0)) / float(dt)) + 1
    # The next power of two: runs of similar length share one compilation.
    return 2 ** max(4, math.ceil(math.log2(count + 1)))


def _check(problem, x0, t0, t1, ts, dt, rtol, atol, dt0, horizon, method, adjoint) -> None:
    wrong: list[InputProblem] = []

    def rule(holds: bool, name: str, given: Any, text: str, mend: str) -> None:
        if not holds:
            wrong.append(InputProblem(f"dvax.solve({name})", str(given), text, mend))

    rule(isinstance(problem, Problem), "problem", type(problem).__name__,
         "it must be a dvax.Problem", "Build one from A, P, K, f and h")  # fmt: skip
    rule(isinstance(method, AbstractMethod), "method", method,
         "it must be a method such as dvax.ETD2RK()", "Leave it out for the default")  # fmt: skip
    rule(adjoint in ("reverse", "forward"), "adjoint", repr(adjoint),
         "it must be 'reverse' or 'forward'", "'reverse' serves jax.grad, 'forward' jax.jvp")  # fmt: skip
    if _tree.is_concrete(x0):
        for leaf in jax.tree_util.tree_leaves(x0):
            bad = np.argwhere(~np.isfinite(np.asarray(leaf)))
            rule(bad.size == 0 and bad.shape[0] == 0, "x0",
                 f"{np.asarray(leaf)[tuple(bad[0])]} at index {tuple(map(int, bad[0]))}" if len(bad) else "",
                 "every entry must be finite", "Mend the initial state there")  # fmt: skip
    if _tree.is_concrete(t0, t1):
        rule(bool(math.isfinite(t0) and math.isfinite(t1) and t0 < t1), "t0, t1", f"{t0}, {t1}",
             "t0 < t1, both finite: a semigroup runs forward only", "Swap or mend them")  # fmt: skip
        if ts is not None and _tree.is_concrete(ts):
            times = np.asarray(ts, float)
            good = times.ndim == 1 and times.size > 0 and bool(np.all(np.diff(times) >= 0))
            inside = good and float(t0) <= times[0] and times[-1] <= float(t1)
            rule(bool(inside), "ts", _tree.short(times) if times.size else "nothing",
                 f"a vector of increasing times in [{float(t0):g}, {float(t1):g}]",
                 "Sort them, and drop those outside")  # fmt: skip
    for name, value, zero_allowed in (
        ("dt", dt, False), ("dt0", dt0, False), ("horizon", horizon, False),
        ("rtol", rtol, True), ("atol", atol, True),
    ):  # fmt: skip
        if value is not None and _tree.is_concrete(value):
            ok = math.isfinite(value) and (value >= 0 if zero_allowed else value > 0)
            rule(ok, name, value, "it must be positive and finite", "Give a positive number")
    if _tree.is_concrete(rtol, atol):
        rule(rtol > 0 or atol > 0, "rtol, atol", "0, 0", "one of them must be positive",
             "No finite step has defect zero")  # fmt: skip
    if wrong:
        raise InputError(*wrong)


def _warn_precision(dtype: Any, dt: Any, rtol: Any) -> None:
    eps = float(jnp.finfo(dtype).eps)
    if dt is None and _tree.is_concrete(rtol) and float(rtol) < 100 * eps:
        warnings.warn(
            f"rtol = {float(rtol):g} cannot be reached in {jnp.dtype(dtype).name}, whose rounding is "
            f"{eps:.1e} an operation. Set jax.config.update('jax_enable_x64', True) before anything "
            "else, or ask for less.",
            stacklevel=3,
        )


def _moduli(constants: Any) -> dict[str, Any]:
    """γ, L_F and ‖P⁻¹‖ of whatever object declares them."""
    if constants is None:
        return {}
    names = ("gamma", "L_F", "norm_P_inv")
    known = {name: getattr(constants, name, None) for name in names}
    return {name: jnp.asarray(v) for name, v in known.items() if v is not None}


def _blank_record(x0: Tree, method: AbstractMethod, dtype: Any) -> Record:
    zero = jnp.zeros((), dtype)
    return Record(zero, zero, x0, (_tree.zeros_like(x0),) * (method.degree + 1))


def _times(ts: Any) -> Any:
    return np.asarray(ts, float) if _tree.is_concrete(ts) else ts


def _subtract(t1: Any, t0: Any) -> Any:
    return float(t1) - float(t0) if _tree.is_concrete(t0, t1) else t1 - t0


def _translate(result: Any) -> RESULTS:
    known = (
        (diffrax.RESULTS.max_steps_reached, RESULTS.max_steps),
        (diffrax.RESULTS.dt_min_reached, RESULTS.step_too_small),
        (diffrax.RESULTS.nonfinite, RESULTS.nonfinite),
        (diffrax.RESULTS.nonlinear_max_steps_reached, RESULTS.law_unsolved),
    )
    out = RESULTS.successful
    for theirs, ours in known:
        out = RESULTS.where(result == theirs, ours, out)
    return out


def _trim(solution: Solution) -> Solution:
    """Only the times that were reached: Diffrax fills the rest with infinity."""
    reached = np.isfinite(np.asarray(solution.ts))
    if reached.all() and solution.records is None:
        return solution
    cut = lambda leaf: leaf[: int(reached.sum())]  # noqa: E731
    fields = ("ts", "xs", "us", "ys", "law_residual", "law_error", "defect", "law_defect")
    new = [jax.tree_util.tree_map(cut, getattr(solution, name)) for name in fields]
    return eqx.tree_at(
        lambda s: [getattr(s, name) for name in fields], solution, new, is_leaf=lambda x: x is None
    )


def _explain(solution: Solution) -> str:
    where = diagnose(solution.flow, solution.stats["t"], solution.stats["x"])
    sentence = RESULTS[solution.result]
    reached = f"Stopped at t = {float(solution.stats['t']):.17g} after "
    reached += f"{int(solution.stats['steps'])} steps."
    return " ".join(part for part in (sentence, where, reached) if part)
