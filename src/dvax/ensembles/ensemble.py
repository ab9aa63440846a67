"""`dvax.ensemble`: many runs of one problem."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree, _user_code
from .._captured import current
from .._tree import Tree
from ..errors import InputError, Problems
from ..evolution import RESULTS, Event, Implicit, PiecewiseLinear, Solution
from ..evolution.arguments import MAX_EVENTS, Arguments, bound_steps, check, warn_precision
from ..evolution.auto import Choice, choose
from ..evolution.event_arguments import check_events
from ..evolution.first_run import key_of_first_run, warn_after_first_run
from ..evolution.method import AbstractMethod
from ..evolution.picard import Picard
from ..problem import Problem
from ..vi import AbstractSolver, Auto
from .alone import Alone
from .collect import Collected, collect, fold_rows
from .inputs import Inputs
from .members import Program, Static
from .moments import Moments
from .result import Ensemble, Fold
from .workers import device_list

_LANES, _ENTRIES = 8192, 2**23
"""Members that an accelerator advances together, and the entries of all their states, at most:
fewer members of a scalar law leave most of a GPU idle."""


def ensemble(
    problem: Problem,
    x0s: Tree,
    t0: Any,
    t1: Any,
    args: Any = None,
    ts: Any = None,
    *,
    axes: tuple[Any, ...] = (0, 0),
    observe: Callable[[Solution], Tree] | None = None,
    keep: bool = True,
    folds: Mapping[str, Fold] | None = None,
    dt: Any = None,
    rtol: Any = 1e-6,
    atol: Any = 1e-9,
    method: AbstractMethod | Implicit | Picard | PiecewiseLinear | None = None,
    vi_solver: AbstractSolver | None = None,
    constants: Any = None,
    measure: bool | None = None,
    dt0: Any = None,
    dt_max: Any = None,
    horizon: Any = None,
    max_steps: int | None = None,
    adjoint: str = "reverse",
    events: Sequence[Event] = (),
    max_events: int = MAX_EVENTS,
    devices: Sequence[Any] | None = None,
    lanes: int | None = None,
    progress: bool = False,
) -> Ensemble:
    """Solve x' = Ax + f(t, x, u), u ∈ h(t, x, u) − N_{K(t)}(P u) for many x0 and args.

    One compiled program solves a member after the other, in a thread on each core, or on each local
    device: a slow member holds up no other one. A member that fails is reported; the others go on.

    **Arguments:** those of `dvax.solve`, and

    - `x0s`, `args`: axis 0 of each array counts the members; they share single numbers. `axes` says
      otherwise, as the `in_axes` of `jax.vmap` for (x0s, args) do: with `axes=(0, None)` they share
      all of `args`, with `axes=(None, 0)` one vector x0;
    - `t0`, `t1`: numbers, or one for each member; `ts`: a vector of times, or a row for each member;
    - `observe`: a JAX function of the `dvax.Solution` of a member, whose value, a tree of arrays, is
      kept; by default its states at `ts`, or that at t1;
    - `keep`: whether to keep these values of all members. Without it there are `mean`, `std` and what
      `folds` reduce: a dictionary of `dvax.Fold`;
    - `devices`: by default `jax.local_devices()`; `lanes`: how many members a device advances together,
      by default 1 on a processor, elsewhere 8192 or fewer, for large states. They wait for the slowest;
    - `progress`: print how many members are done.

    Under `jax.grad` and `jax.jit` all members run in one loop, and a derivative solves each once more.
    Where a member fails, its values and derivatives are NaN; `mean` and `std` are over the others.

    **Returns:** an `Ensemble`. Failed members are named in a warning.

    **Raises:** `dvax.InputError` for arguments that break a rule.

    ```python
    >>> import jax.numpy as jnp
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: args["load"] - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> loads = jnp.linspace(2.0, 4.0, 101)
    >>> found = dvax.ensemble(problem, -1.0, 0.0, 2.0, {"load": loads})
    >>> found.values.shape, int(found.failed.sum())
    ((101,), 0)
    >>> print(f"{float(found.mean):.4f} {float(found.std):.4f} {found.quantile(0.9):.4f}")
    1.8349 0.3758 2.3468

    ```
    """
    options: dict[str, Any] = dict(
        dt=dt, rtol=rtol, atol=atol, method=method, vi_solver=vi_solver, constants=constants,
        measure=measure, dt0=dt0, dt_max=dt_max, horizon=horizon, max_steps=max_steps,
        adjoint=adjoint, max_events=max_events,
    )  # fmt: skip
    check_events(events, max_events, method, dt, False)
    options["events"] = tuple(map(current, events))
    check_own(method, observe, folds, keep, lanes, axes)
    problem = current(problem)
    states, times = _tree.as_float(x0s, "x0s"), (_times(t0), _times(t1))
    inputs = Inputs.of(states, _tree.as_arrays(args), *times, _times(ts), axes)
    _check_times(inputs)
    # A member whose x0 is not finite fails alone.
    x0, own_args, begin, end, own_ts = inputs.member(inputs.examples()[0])
    check(Arguments(problem, x0, begin, end, own_args, own_ts, progress=progress, **options))
    _user_code.check_args(own_args, "dvax.ensemble")
    if dt is None:
        warn_precision(x0, rtol)
    choice = Choice(method)
    if method is None:
        tol = float(max(rtol, atol)) if _tree.is_concrete(rtol, atol) else math.nan
        certified = constants is not None
        choice = _chosen(problem, inputs, tol, dt is not None, certified)
    each = device_list(devices)
    if lanes is None:
        size = sum(np.size(leaf) for leaf in jtu.tree_leaves(x0))
        lanes = 1 if each[0].platform == "cpu" else max(1, min(_LANES, _ENTRIES // max(size, 1)))
    static = Static(
        measure, bound_steps(max_steps, dt is not None, *_longest(inputs), dt), adjoint, max_events,
        False, observe or (_end if ts is None else _states), lanes,
    )  # fmt: skip
    numbers = {
        name: options[name]
        for name in ("dt", "rtol", "atol", "dt0", "dt_max", "horizon")
        if options[name] is not None
    }

    def program(choice: Choice, watch: bool = False) -> Program:
        code = problem, choice.method, vi_solver or Auto(), options["events"], constants
        steps = {"stiff_steps": choice.least if watch else math.inf}
        return Program.of(code, inputs, numbers | steps, static._replace(watch_stiffness=watch))

    folds = {} if folds is None else dict(folds)
    first = program(choice, choice.fallback is not None)
    if _tree.is_concrete(inputs.leaves, first.shared):
        kept = Collected(inputs.count, keep, folds, progress)
        if collect(kept, first, inputs, np.arange(inputs.count), each):
            members = _ensemble(kept, choice, program, inputs, each, problem, options)
            # Data of the others may be invalid.
            if (solved := np.flatnonzero(~np.asarray(members.failed))).size:
                x0, own_args, begin, *_ = inputs.member(int(solved[0]))
                key = key_of_first_run(problem, begin, x0, own_args)
                if key is not None:
                    warn_after_first_run(key, problem, begin, x0, own_args, constants)
            return members
    # Within `jax.grad` or `jax.jit`.
    found = program(choice).traced(inputs.rows(slice(None)))
    valid = ~found.failed
    return Ensemble(
        found.observed if keep else None, found.failed, found.result, found.t, found.steps,
        found.rejected, jnp.zeros_like(found.failed), choice.text(),
        Moments.of(found.observed, valid),
        {name: fold_rows(f.add, f.start, found.observed, valid) for name, f in folds.items()},
    )  # fmt: skip


def _chosen(problem: Problem, inputs: Inputs, tol: float, fixed: bool, certified: bool) -> Choice:
    """Return a method for all members, chosen for the first one whose data are valid: a K that is
    empty, for example, is the failure of that member alone."""
    wrong: list[InputError] = []
    for number in inputs.examples():
        x0, args, begin, end, _ = inputs.member(number)
        try:
            return choose(problem, x0, args, begin, end - begin, tol, fixed, certified)
        except InputError as error:
            wrong.append(error)
    raise wrong[0]


def _ensemble(
    kept: Collected,
    choice: Choice,
    program: Callable[[Choice], Program],
    inputs: Inputs,
    devices: list[Any],
    problem: Problem,
    options: dict[str, Any],
) -> Ensemble:
    """Return the ensemble, after solving members by another method where stability or rounding limited
    the steps of the first."""
    text, switched = str(choice.text()), np.zeros(inputs.count, bool)
    others = [(r, c) for r in (RESULTS.stiff, RESULTS.step_too_small) for c in choice.after(r)]
    for result, other in others if choice.reason else []:
        assert kept.rows is not None
        members = np.flatnonzero(np.asarray(kept.rows.result == result))
        if not len(members):
            continue
        before = kept.take(members)
        collect(kept, program(other), inputs, members, devices)
        # Where the other method fails too, the first failure is reported, or another one is tried.
        solved = ~kept.rows.failed[members]
        if result == RESULTS.stiff:
            # A method that stability limits may need more steps than there may be.
            solved |= np.asarray(kept.rows.result == RESULTS.max_steps)[members]
            solved |= other.method is choice.method
        kept.put(members[~solved], jtu.tree_map(lambda rows, s=solved: rows[~s], before))
        if solved.any():
            switched[members[solved]] = True
            count = f"{solved.sum()} member" + ("" if solved.sum() == 1 else "s")
            text += f"; {count} by {other.text()}"
    rows, moments = kept.rows, kept.moments
    assert rows is not None and moments is not None
    found = Ensemble(
        rows.observed, rows.failed, rows.result, rows.t, rows.steps, rows.rejected, switched, text,
        moments, kept.folded, Alone(problem, inputs, options),
    )  # fmt: skip
    if failures := found.failures():
        first = next(iter(failures))
        warnings.warn(
            f"{len(failures)} of {inputs.count} members failed, the first of them number {first}: "
            f"{failures[first]} Ensemble.failures() lists them, and Ensemble.member({first}) raises "
            "the error with its cause.",
            stacklevel=3,
        )
    return found


def _end(solution: Solution) -> Tree:
    return jtu.tree_map(lambda leaf: leaf[-1], solution.xs)


def _states(solution: Solution) -> Tree:
    return solution.xs


def _times(t: Any) -> Any:
    """Return times as a float or an array of floats, where they have values."""
    if t is None or not _tree.is_concrete(t):
        return t
    if np.ndim(t) == 0:
        return float(t) if _tree.is_number(t) else t
    return np.asarray(t, float)


def _longest(inputs: Inputs) -> tuple[Any, Any]:
    """Return t0 and t1 of the longest run."""
    _, _, t0, t1, _ = inputs.tree.unflatten(inputs.leaves)
    if np.ndim(t0) == np.ndim(t1) == 0 or not _tree.is_concrete(t0, t1):
        return inputs.member(0)[2:4]
    return inputs.member(int(np.argmax(t1 - t0 + np.zeros(inputs.count))))[2:4]


def check_own(
    method: Any, observe: Any, folds: Any, keep: Any, lanes: Any, axes: Any = (0, 0)
) -> None:
    """Raise one `InputError` with everything that is wrong with the arguments of an ensemble alone."""
    wrong = Problems()
    if isinstance(method, PiecewiseLinear):
        wrong.add(
            "dvax.ensemble(method)", "PiecewiseLinear", "it runs in Python, one member at a time",
            "Leave it out, or use dvax.ExpRosenbrock()",
        )  # fmt: skip
    if not (isinstance(axes, tuple) and len(axes) == 2):
        wrong.add(
            "dvax.ensemble(axes)", _tree.line(axes), "it must be a pair, for x0s and for args",
            "Write axes=(0, 0), the default, or axes=(0, None) if all members share args",
        )  # fmt: skip
    if not (observe is None or callable(observe)):
        wrong.add(
            "dvax.ensemble(observe)", _tree.line(observe), "it must be a function of a dvax.Solution",
            "Write observe=lambda sol: sol.xs",
        )  # fmt: skip
    is_dict = folds is None or isinstance(folds, Mapping)
    if not is_dict or not all(isinstance(fold, Fold) for fold in (folds or {}).values()):
        wrong.add(
            "dvax.ensemble(folds)", _tree.line(folds), "it must be a dictionary of dvax.Fold",
            "Write folds={'largest': dvax.Fold(start, add)}",
        )  # fmt: skip
    if not isinstance(keep, bool | np.bool_):
        wrong.add("dvax.ensemble(keep)", _tree.line(keep), "it must be True or False", "Omit it")
    is_count = isinstance(lanes, int | np.integer) and not isinstance(lanes, bool)
    if not (lanes is None or (is_count and lanes >= 1)):
        wrong.add(
            "dvax.ensemble(lanes)",
            _tree.line(lanes),
            "it must be a positive whole number",
            "Omit it",
        )
    wrong.raise_any()


def _check_times(inputs: Inputs) -> None:
    """Raise an `InputError` for the first member whose times are not in order, if times differ."""
    _, _, t0, t1, ts = inputs.tree.unflatten(inputs.leaves)
    if not _tree.is_concrete(t0, t1, ts):
        return
    wrong = Problems()
    if np.ndim(t0) or np.ndim(t1):
        t0, t1 = (np.broadcast_to(t, inputs.count) for t in (t0, t1))
        bad = np.flatnonzero(~((t0 < t1) & np.isfinite(t0) & np.isfinite(t1)))
        if len(bad):
            wrong.add(
                f"dvax.ensemble(t0, t1) of member {bad[0]}", f"{t0[bad[0]]:g}, {t1[bad[0]]:g}",
                "t0 < t1, both finite: a semigroup runs forward only", "Swap or correct them",
            )  # fmt: skip
    if ts is not None and (np.ndim(ts) > 1 or np.ndim(t0) or np.ndim(t1)):
        begin, end = (np.reshape(t, (-1, 1)) for t in (t0, t1))
        rows = np.atleast_2d(ts)
        bad = np.flatnonzero(
            ~(
                np.all(np.diff(rows) >= 0, axis=1, keepdims=True) & (begin <= rows) & (rows <= end)
            ).all(1)
        )
        if len(bad):
            wrong.add(
                f"dvax.ensemble(ts) of member {bad[0]}", _tree.line(rows[min(bad[0], len(rows) - 1)]),
                "they must increase, and lie in [t0, t1]", "Sort them, and remove times outside",
            )  # fmt: skip
    wrong.raise_any()
