"""`dvax.solve`: the mild solution of a coupled system."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree, _user_code
from .._captured import current
from .._jax.messages import is_reverse_only
from .._tree import Tree
from ..errors import DifferentiationError, InputError, input_error
from ..generators import AbstractGenerator
from ..generators.sharded import place
from ..problem import Problem
from ..vi import AbstractSolver, Auto
from .arguments import (
    ADAPTIVE_STEPS,
    FIRST_GROWTH,
    MAX_EVENTS,
    Arguments,
    bound_steps,
    check,
    check_memory,
    first_step,
    warn_precision,
)
from .auto import Choice, choose
from .certified import certified, of_region
from .closures import closure_convert
from .compiled import compiled
from .control import MAX_GROWTH
from .diagnose import failure
from .event import Event
from .event_arguments import check_events
from .first_run import check_before_first_run, key_of_first_run, warn_after_first_run
from .implicit import Implicit
from .method import AbstractMethod
from .nonfinite import nonfinite_data
from .picard import Picard
from .piecewise.method import PiecewiseLinear
from .results import RESULTS, is_success
from .rows import cut
from .setup import Options, Setup
from .signature import flat
from .solution import Solution
from .streaming import check_save, stream

_FIRST_ROOM = 2**12
"""Steps that a run with `dense=True` has room for at first, with few entries of the state."""

_LEAST_ROOM, _FIRST_ENTRIES = 64, 10**8
"""The same with many entries: as many as make `_FIRST_ENTRIES` entries in all, and at least 64."""

_VI_SOLVER = Auto()
"""Constructing the default at every call would cost a part of a short run."""


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
    method: AbstractMethod | Implicit | Picard | PiecewiseLinear | None = None,
    vi_solver: AbstractSolver | None = None,
    progress: bool = False,
    *,
    constants: Any = None,
    certified_tol: Any = None,
    measure: bool | None = None,
    dense: bool = False,
    dt0: Any = None,
    dt_max: Any = None,
    horizon: Any = None,
    max_steps: int | None = None,
    adjoint: str = "reverse",
    throw: bool = True,
    events: Sequence[Event] = (),
    max_events: int = MAX_EVENTS,
    save: Any = None,
) -> Solution:
    """Solve x' = Ax + f(t, x, u), u ∈ h(t, x, u) − N_{K(t)}(P u) from x(t0) = x0 up to t1.

    **Arguments:**

    - `ts`: times to save at, increasing, in [t0, t1]; None saves t1 alone. They are differentiated
      as t0 and t1 are;
    - `dt`: fixed steps, no longer than this (the fewest equal ones between knots of the data);
      without it, steps adapt;
    - `rtol`, `atol`: the error of x is meant to be below atol + rtol|x| where trajectories do not
      separate. With `ETD1` and `ETD2RK`, or with `constants`, the integral of the norm of the defect is
      at most twice that. Other methods let the square of an estimate of the error of x grow evenly
      over the run;
    - `method`: None chooses one from the structure and the size of the problem, and another one where
      stability limits its steps (not under `jax.jit` and `jax.vmap`); `stats["method"]` names it, with
      the reason. With `dt` or `constants` it is `dvax.ETD2RK()`. `vi_solver`: `dvax.vi.Auto()` by
      default;
    - `constants`: `dvax.Constants` (or any object with `gamma`, `L_F`, `norm_P_inv`): lets the law be
      solved to a tolerance on its true error, and certifies every saved u;
    - `certified_tol`: the largest error of x in the norm of the state space that is allowed at any
      saved time, for the exact x0: steps are chosen, in a few runs, until `dvax.bound_error` with
      these `constants` says so (`rtol` and `atol` are then not used). The bound that was reached is
      in `stats["certified_bound"]`, or in `stats["estimated_bound"]` where the defect was sampled and
      not enclosed (`sol.enclosed`): methods of order above 2, and sets whose motion has no rule. A
      tolerance out of reach is refused after one cheap run, with the least bound in reach and what
      limits it.
      Constants of a region hold while x and u stay in it. This is checked at 256 more times;
      between them you must check it yourself;
    - `measure`: whether to sample the defect inside steps. Adaptive steps always do; fixed steps, and
      `PiecewiseLinear`, only when asked or with `constants`, since it doubles their cost;
    - `dense`: keep every step, for `Solution.evaluate`. Under `jax.jit` there is room for `max_steps`
      of them, and else for as many as the run needs;
    - `dt0`, `horizon`: first step and length of the whole run, to continue a run in pieces. Without
      `dt0` the first step is 10⁻⁶ of the run, and its error estimate chooses the second one;
    - `dt_max`: the longest adaptive step, for data with features that no sample may miss;
    - `max_steps`: the most steps, 2²⁰ by default for adaptive ones; with fixed steps, counted;
    - `adjoint`: "reverse" serves `jax.grad` and `jax.vjp`, "forward" serves `jax.jvp` and
      `jax.jacfwd`: one loop cannot serve both;
    - `events`: a list of `dvax.Event`: functions of (t, x, u) whose zeros are recorded, end the run, or
      reset the state; `max_events`: the largest number of zeros, of all events together;
    - `save`: a `dvax.ZarrStore` for the rows of `ts`: they are written while the run goes on, so that
      its memory does not grow with their number. The solution that is returned has the last row alone;
    - `throw`: raise where the solve fails, inside `jax.grad` too; otherwise look at `result`. Under
      `jax.jit` and `jax.vmap` nothing can raise: times that were not reached are infinite there, their
      states NaN, and all derivatives NaN.

    **Kinks.** Where u enters or leaves the boundary of K its slope jumps, and with it that of f̃. With
    at most 64 unknowns in the law, and a K that has `switches`, adaptive steps end there, and each
    method has its order back (with at most 256 at tolerances of 1e-7 and below, if f̃ acts entry by
    entry). In a larger field some point has a kink at any time: expect order 2.

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
    if save is not None:
        others = dense, bool(events), certified_tol is not None
        check_save(save, ts, x0, args, others)
    check_events(events, max_events, method, dt, certified_tol is not None)
    problem, x0 = current(problem), _state(problem, x0)
    own = tuple(map(current, events))
    call = Arguments(
        problem, x0, t0, t1, args, ts, dt, rtol, atol, method, vi_solver, progress, constants,
        certified_tol, measure, dense, dt0, dt_max, horizon, max_steps, adjoint, throw, own,
        max_events, save,
    )  # fmt: skip
    if certified_tol is not None:
        _only_adaptive(dt, method)
        # The tolerances of its runs follow from the constants.
        call = call._replace(rtol=0.0, atol=1.0, horizon=None)
    check(call)
    _user_code.check_args(args, "dvax.solve")
    if save is not None:
        whole = call._replace(
            horizon=t1 - t0 if horizon is None else horizon, throw=False, progress=False, save=None
        )

        def piece(x: Tree, start: float, end: float, times: np.ndarray, step: Any) -> Solution:
            own = whole._replace(x0=x, t0=start, t1=end, ts=times, dt0=step)
            return solve(**own._asdict())

        return stream(
            piece, x0, float(t0), float(t1), np.asarray(ts, float), dt0, save, dt is not None, throw,
            progress,
        )  # fmt: skip
    if dt is None:
        warn_precision(x0, call.rtol)
    call, choice = _chosen(call)
    setup, options = arranged(call, choice.method)
    first = key_of_first_run(problem, t0, x0, args)
    if first is not None:
        check_before_first_run(problem, t0, t1, x0, args)
    times = None if ts is None else _times(ts)
    if certified_tol is None:
        solution = _run(choice, setup, times, options, throw)
    else:

        def run(ts: Any, atol: float) -> Solution:
            own = setup._replace(setting={**setup.setting, "atol": atol})
            return _run(choice, own, ts, options, throw)

        most = options.max_steps
        solution = certified(run, times, setup, constants, certified_tol, most, throw)
    if first is not None:
        adaptive = dt is None and not isinstance(choice.method, PiecewiseLinear)
        saved = (solution.ts, solution.xs) if adaptive else None
        warn_after_first_run(
            first, problem, t0, x0, args, constants, saved, solution.setup.setting["atol"]
        )
    return solution


def _run(choice: Choice, setup: Setup, times: Any, options: Options, throw: bool) -> Solution:
    """Run, and raise the explanation of a failure, or return the run up to there.

    **Raises:** `dvax.SolveError` if `throw`; `dvax.InputError` where the input explains the failure.
    """
    method, problem = choice.method, setup.problem
    if isinstance(method, PiecewiseLinear):
        from .piecewise.propagate import propagate  # SciPy is slow to import

        solution = propagate(setup, times, options)
        solution.stats["method"] = choice.text()
        if throw and solution.result != RESULTS.successful:
            raise failure(solution)
        return solution
    if options.dense and isinstance(method, AbstractMethod):
        solution, reached = _run_recorded(choice, setup, times, options)
    else:
        solution, reached = _run_chosen(choice, setup, times, options)
    setup = solution.setup
    if reached is True and not options.dense and not setup.events:
        return solution
    if _tree.is_concrete(solution.ts, solution.xs):
        solution = _trim(solution)
    if reached is False:
        traced = not _tree.is_concrete(solution.ts, solution.xs)
        if traced:
            # Inside of `jax.grad`, though not of `jax.jit` or `jax.vmap`, the values are known.
            args = _tree.as_arrays(setup.args)
            problem = closure_convert(problem, setup.number("t0"), setup.x0, args)
            setup = setup._replace(problem=problem, args=args)
            setup, times, ended = _tree.primal((setup, times, solution))
            ended = eqx.tree_at(lambda s: s.setup, ended, setup)
        else:
            ended = solution
        if _tree.is_concrete(setup, times, ended.ts, ended.xs):
            ended = _examined(setup, times, options, ended)
            if throw:
                raise failure(ended)
            return solution if traced else ended
    return solution


def run_again(
    solution: Solution, ts: Any, *, dense: bool = False, constants: Any = None
) -> Solution:
    """Return the run of a solution made once more, with the same steps and other records.

    With `constants` it has a defect, and bounds where they hold in a region, and no events. A run that
    failed stops where it did.

    **Raises:** `dvax.InputError` with `dense`, if the method records no steps.
    """
    setting = {name: _number(value) for name, value in solution.setup.setting.items()}
    setup = solution.setup._replace(setting=setting)
    if constants is not None:
        setup = setup._replace(moduli=_moduli(constants), events=())
    t0, t1, dt = setting["t0"], setting["t1"], setting["dt"]
    adaptive = isinstance(dt, float) and math.isnan(dt)
    attempts, most = solution.stats["steps"] + solution.stats["rejected"], None
    if adaptive and _tree.is_concrete(attempts, solution.result):
        succeeded = bool(is_success(solution.result))
        most = max(ADAPTIVE_STEPS, int(attempts)) if succeeded else int(attempts)
    happened = 0 if solution.events is None else len(solution.events.index)
    call = Arguments(
        setup.problem, setup.x0, t0, t1, setup.args, dt=None if adaptive else dt, method=setup.method,
        constants=constants, measure=constants is not None or solution.defect is not None,
        dense=dense, max_steps=most, events=setup.events, max_events=max(MAX_EVENTS, happened),
    )  # fmt: skip
    if dense:
        check(call)
    _, options = arranged(call, setup.method)
    times = None if ts is None else _times(ts)
    return _run(Choice(setup.method), setup, times, options, False)


def arranged(call: Arguments, method: Any) -> tuple[Setup, Options]:
    """Return the setup and the options of a run by this method from arguments that are checked."""
    x0, t0, t1, dt, dt0, dt_max = call.x0, call.t0, call.t1, call.dt, call.dt0, call.dt_max
    fixed, span = dt is not None, t1 - t0
    setting = {
        "t0": t0,
        "t1": t1,
        "dt": math.nan if dt is None else _number(dt),
        "rtol": _number(call.rtol),
        "atol": _number(call.atol),
        "dt0": first_step(span, t0, t1, _tree.dtype(x0)) if dt0 is None else _number(dt0),
        "dt0_growth": FIRST_GROWTH if dt0 is None else MAX_GROWTH,
        "dt_max": math.inf if dt_max is None else _number(dt_max),
        "horizon": span if call.horizon is None else _number(call.horizon),
        "stiff_steps": math.inf,
    }
    if isinstance(method, PiecewiseLinear):
        # Its steps do not need their defect, which costs as much as they do.
        measured = bool(call.measure) or call.constants is not None
    else:
        measured = not isinstance(method, Implicit) and (bool(call.measure) or not fixed)
    options = Options(
        fixed=fixed,
        measure=measured,
        track_bounds=measured and of_region(call.constants),
        check_finite=not fixed,
        dense=call.dense,
        max_steps=bound_steps(call.max_steps, fixed, t0, t1, dt),
        adjoint=call.adjoint,
        progress=call.progress,
        max_events=call.max_events if call.events else 0,
    )
    solver = _VI_SOLVER if call.vi_solver is None else call.vi_solver
    moduli, events = _moduli(call.constants), tuple(call.events)
    return Setup(call.problem, x0, call.args, setting, method, solver, moduli, events), options


def _examined(setup: Setup, times: Any, options: Options, solution: Solution) -> Solution:
    """Return a failed run up to where it failed, unless the input explains the failure.

    **Raises:** `dvax.InputError`.
    """
    # Data that ends too early is NaN from there on: then that is what is wrong.
    problem, x0, args = setup.problem, setup.x0, setup.args
    t0, t1 = setup.setting["t0"], setup.setting["t1"]
    nonfinite_data(problem, args, "dvax.solve").raise_any()
    problem.knots(t0, t1, x0, _tree.as_arrays(args))
    problem.check_data(t0, t1, x0, args)
    if options.fixed:
        # Once more, keeping the last good state, to say where it went wrong.
        solution, _ = compiled(setup, times, options._replace(check_finite=True))
        solution = _tree.primal(solution)
    return _trim(solution)


def prepared(call: Arguments) -> tuple[Setup, Any, Options]:
    """Return what `solve` compiles for these arguments: the setup, the saved times and the options."""
    problem, x0 = current(call.problem), _state(call.problem, call.x0)
    call = call._replace(problem=problem, x0=x0, events=tuple(map(current, call.events)))
    check(call)
    call, choice = _chosen(call)
    setup, options = arranged(call, choice.method)
    if call.dense:
        options = options._replace(max_steps=min(options.max_steps, _FIRST_ROOM))
    watched = bool(choice.reason) and choice.fallback is not None
    options = options._replace(watch_stiffness=watched)
    return setup, None if call.ts is None else _times(call.ts), options


def _chosen(call: Arguments) -> tuple[Arguments, Choice]:
    """Return the arguments as numbers, with a generator for the sharding of x0, and the method."""
    problem, t0, t1 = _placed(call.problem, call.x0), _number(call.t0), _number(call.t1)
    call = call._replace(problem=problem, t0=t0, t1=t1)
    if call.method is not None:
        return call, Choice(call.method)
    tol = max(call.rtol, call.atol) if _tree.is_concrete(call.rtol, call.atol) else math.nan
    fixed, certified = call.dt is not None, call.constants is not None
    return call, choose(problem, call.x0, call.args, t0, t1 - t0, float(tol), fixed, certified)


def _placed(problem: Problem, x0: Tree) -> Problem:
    """Return the problem whose generator transforms states that are sharded as x0 is."""
    A = problem.A
    placed = place(A, _tree.primal(x0)) if isinstance(A, AbstractGenerator) else A
    return problem if placed is A else eqx.tree_at(lambda p: p.A, problem, placed)


def _state(problem: Any, x0: Any) -> Tree:
    """x0 as arrays. Where neither it nor the problem is one, the order of the two may be wrong."""
    try:
        return _tree.as_float(x0, "x0")
    except InputError:
        _tree.check_kind(
            problem, Problem, "dvax.solve(problem)",
            "it must be a dvax.Problem, which comes first: dvax.solve(problem, x0, t0, t1)",
            "Build one, or pass that of a model: model.problem",
        )  # fmt: skip
        raise


def _only_adaptive(dt: Any, method: Any) -> None:
    for name, given, why in (
        ("dt", dt, "fixed steps cannot be chosen"),
        ("method", method if isinstance(method, Implicit) else None, "its steps have no defect"),
    ):
        if given is not None:
            raise input_error(
                f"dvax.solve({name})", str(given), f"with certified_tol {why}",
                "Leave it out, or use dvax.bound_error on the solution",
            )  # fmt: skip


def _run_recorded(
    choice: Choice, setup: Setup, times: Any, options: Options
) -> tuple[Solution, bool | jax.Array]:
    """Run with room for few steps first, and with more where the run needs them: `max_steps` bounds the
    work, and not the size of the records."""
    most, room = options.max_steps, options.max_steps
    entries = sum(leaf.size for leaf in jax.tree_util.tree_leaves(setup.x0))
    if not options.fixed and _tree.is_concrete(_tree.primal((setup, times))):
        room = min(most, _FIRST_ROOM, max(_LEAST_ROOM, _FIRST_ENTRIES // max(1, entries)))
    while True:
        check_memory(entries, jnp.dtype(setup.dtype).itemsize, room, setup.method.degree)
        solution, reached = _run_chosen(choice, setup, times, options._replace(max_steps=room))
        if reached is not False or solution.result != RESULTS.max_steps or room == most:
            return solution, reached
        room = min(most, 16 * room)


def _run_chosen(
    choice: Choice, setup: Setup, times: Any, options: Options
) -> tuple[Solution, bool | jax.Array]:
    """Run the method that was chosen, or another one where stability or rounding limits its steps."""
    text = choice.text()
    if choice.reason and _has_values(setup, times):
        # A number of its own, so that one program serves every tolerance.
        guarded = setup._replace(setting={**setup.setting, "stiff_steps": choice.least})
        solution, reached = _differentiably(
            guarded, times, options._replace(watch_stiffness=choice.fallback is not None)
        )
        if isinstance(reached, bool):
            t = float(_tree.primal(solution.stats["t"]))
            for other in [] if reached else choice.after(solution.result):
                again = setup._replace(method=other.method)
                second, reached = _differentiably(again, times, options)
                # Of a run that stability limited, another failure is the one to report: that of too
                # many steps, or of the method that was chosen.
                is_last = second.result == RESULTS.max_steps or other.method is choice.method
                if reached or (solution.result == RESULTS.stiff and is_last):
                    text, solution = other.text(f" at t = {t:.6g}"), second
                    break
            solution.stats["method"] = text
            return solution, reached
        # f, h or K closes over what is traced, so that no other method can follow this one.
    solution, reached = _differentiably(setup, times, options)
    solution.stats["method"] = text
    return solution, reached


def _has_values(setup: Setup, times: Any) -> bool:
    """Return whether no argument is traced, except for derivatives."""
    given = setup.x0, setup.args, setup.setting, times
    if flat(setup.problem).is_concrete and _tree.is_concrete(given):
        return True
    return _tree.is_concrete(_tree.primal((setup.problem, given)))


def _differentiably(
    setup: Setup, times: Any, options: Options
) -> tuple[Solution, bool | jax.Array]:
    try:
        return compiled(setup, times, options)
    except jax.errors.UnexpectedTracerError as error:
        raise _user_code.leaked_tracer_error(error) from error
    except (TypeError, ValueError) as error:
        if options.adjoint == "reverse" and is_reverse_only(error):
            raise DifferentiationError(
                'dvax.solve(adjoint="reverse") cannot be differentiated forward (jax.jvp, '
                'jax.jacfwd). Pass adjoint="forward": the loop that stores steps for the reverse '
                "pass is not the one that carries tangents along."
            ) from error
        raise


def _moduli(constants: Any) -> dict[str, Any]:
    """γ, L_F, ‖P⁻¹‖ and the gain β_f‖P⁻¹‖ of the law in f̃, of whatever object declares them."""
    if constants is None:
        return {}
    names = ("gamma", "L_F", "norm_P_inv", "beta_f")
    known = {name: getattr(constants, name, None) for name in names}
    moduli = {name: _number(v) for name, v in known.items() if v is not None}
    beta_f = moduli.pop("beta_f", None)
    if beta_f is not None and "norm_P_inv" in moduli:
        gain = beta_f * moduli["norm_P_inv"]
        if not _tree.is_concrete(gain) or np.isfinite(gain):
            moduli["law_gain"] = gain
    return moduli


def _times(ts: Any) -> Any:
    return np.asarray(ts, float) if _tree.is_concrete(ts) else ts


def _number(v: Any) -> Any:
    """What has a value as a Python number, the cheapest to hand over and at home in any precision."""
    return float(v) if _tree.is_concrete(v) else v


def _trim(solution: Solution) -> Solution:
    """Only the times that were reached, and the events that happened: the others are infinite."""
    if solution.events is not None:
        count = int((np.asarray(solution.events.index) >= 0).sum())
        solution = eqx.tree_at(lambda s: s.events, solution, solution.events.rows(slice(count)))
    reached = np.isfinite(np.asarray(solution.ts))
    if reached.all() and solution.records is None:
        return solution
    return cut(solution, slice(int(reached.sum())))
