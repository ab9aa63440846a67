"""Checks of the arguments of `dvax.solve`, before anything runs."""

import math
import os
import warnings
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding

from .. import _tree
from ..errors import InputProblem, Problems, input_error
from ..problem import Problem
from ..vi import AbstractSolver
from .event import Event
from .implicit import Implicit
from .method import AbstractMethod
from .picard import Picard
from .piecewise.method import PiecewiseLinear

ADAPTIVE_STEPS = 2**20
"""Default of max_steps in adaptive solves."""
_MAX_FIXED_STEPS = 2**30
"""Largest number of steps of a solve with fixed steps."""
_METHODS = AbstractMethod | Implicit | Picard | PiecewiseLinear
_FLAGS = bool | np.bool_ | None
MAX_STEP_COUNT = 2**31 - 1
"""Largest value of max_steps: steps are counted in 32 bits."""


MAX_EVENTS = 256
"""The default of `max_events`."""


class Arguments(NamedTuple):
    """The arguments of `dvax.solve`, with its defaults."""

    problem: Any
    x0: Any
    t0: Any
    t1: Any
    args: Any = None
    ts: Any = None
    dt: Any = None
    rtol: Any = 1e-6
    atol: Any = 1e-9
    method: Any = None
    vi_solver: Any = None
    progress: bool = False
    constants: Any = None
    certified_tol: Any = None
    measure: bool | None = None
    dense: bool = False
    dt0: Any = None
    dt_max: Any = None
    horizon: Any = None
    max_steps: int | None = None
    adjoint: str = "reverse"
    throw: bool = True
    events: Sequence[Event] = ()
    max_events: int = MAX_EVENTS
    save: Any = None


def check(call: Arguments) -> None:
    """Raise one `InputError` with everything that is wrong with the arguments of `dvax.solve`."""
    problem, x0, method, vi_solver = call.problem, call.x0, call.method, call.vi_solver
    t0, t1, ts, dt, dt_max = call.t0, call.t1, call.ts, call.dt, call.dt_max
    max_steps = call.max_steps
    wrong = Problems()

    def rule(holds: bool, name: str, given: Any, text: str, fix: str) -> None:
        if not holds:  # format the value here, so that valid calls do not pay for it
            plain = isinstance(given, _tree.Text) or hasattr(given, "dtype")
            line = _tree.short(given) if plain else repr(given)
            wrong.add(f"dvax.solve({name})", line[:200], text, fix)

    rule(isinstance(problem, Problem), "problem", _tree.Text(type(problem).__name__),
         "it must be a dvax.Problem", "Build one, or pass that of a model: model.problem")  # fmt: skip
    rule(method is None or isinstance(method, _METHODS), "method", method,
         "it must be a method such as dvax.ETD2RK()", "Omit it for the default")  # fmt: skip
    rule(vi_solver is None or isinstance(vi_solver, AbstractSolver), "vi_solver", vi_solver,
         "it must be a solver such as dvax.vi.Auto()", "Omit it for the default")  # fmt: skip
    rule(call.adjoint in ("reverse", "forward"), "adjoint", call.adjoint,
         "it must be 'reverse' or 'forward'",
         "Use 'reverse' with jax.grad, 'forward' with jax.jvp")  # fmt: skip
    flags = {"measure": call.measure, "dense": call.dense, "progress": call.progress}
    for name, flag in flags.items():
        rule(isinstance(flag, _FLAGS), name, flag, "it must be True or False",
             "Omit it for the default")  # fmt: skip
    if isinstance(method, Implicit):
        for name in ("measure", "dense"):
            rule(not flags[name], name, True, "implicit methods record no polynomials of their steps",
                 "Omit it and list the times in ts=, or use an exponential method")  # fmt: skip
        rule(dt is None, "dt", dt, "implicit methods choose their steps by rtol and atol, which also "
             "control the solution of their equations", "Omit it")  # fmt: skip
    if dt is not None:
        for name, length in (("dt0", call.dt0), ("dt_max", dt_max)):
            rule(length is None, name, length, "with dt all steps have that length",
                 f"Omit {name}, or omit dt for adaptive steps")  # fmt: skip
    if isinstance(method, PiecewiseLinear):
        rule(vi_solver is None, "vi_solver", vi_solver, "dvax.PiecewiseLinear solves its law in closed "
             "form in each mode", "Omit it, or choose another method")  # fmt: skip
        rule(dt_max is None, "dt_max", dt_max, "dvax.PiecewiseLinear steps from one change of the "
             "constraints to the next", "Omit it, or choose another method")  # fmt: skip
        rule(dt is None, "dt", dt, "dvax.PiecewiseLinear steps from one change of the constraints to "
             "the next", "Omit it, and list the times to save in ts=")  # fmt: skip
    if max_steps is not None:
        is_integer = isinstance(max_steps, int | np.integer) and not isinstance(max_steps, bool)
        rule(bool(is_integer and 1 <= max_steps <= MAX_STEP_COUNT), "max_steps", max_steps,
             f"it must be a whole number from 1 to {MAX_STEP_COUNT}",
             f"Omit it for {ADAPTIVE_STEPS}")  # fmt: skip
    wrong += _not_finite(x0) + _wrong_moduli(call.constants)
    optional = ("dt", "dt0", "dt_max", "horizon")
    numbers = {n: getattr(call, n) for n in ("t0", "t1", *optional, "rtol", "atol")}
    unusable = set()
    for name, value in numbers.items():
        if type(value) is float or (value is None and name in optional):
            continue
        if not _tree.is_concrete(value) or _tree.is_number(value):
            continue
        unusable.add(name)
        rule(False, name, value, "it must be one real number",
             "Write a number such as 1.0")  # fmt: skip
    if not unusable & {"t0", "t1"} and _tree.is_concrete(t0, t1):
        span = float(t1) - float(t0) if math.isfinite(t0) and math.isfinite(t1) else math.nan
        least = 2.0**12 * _tiny(_tree.dtype(x0))
        if not least <= span < math.inf:
            given = _tree.Text(f"{t0}, {t1}")
            rule(span > 0, "t0, t1", given, "t0 < t1, both finite: a semigroup runs forward only",
                 "Swap or correct them")  # fmt: skip
            rule(span != math.inf, "t0, t1", given, "t1 − t0 must be finite",
                 "Choose another unit of time")  # fmt: skip
            rule(not 0 < span < least, "t0, t1", given,
                 f"t1 − t0 must be at least {least:.3g}, or steps underflow to 0",
                 "Choose another unit of time")  # fmt: skip
        if ts is not None and _tree.is_concrete(ts):
            _check_times(rule, ts, float(t0), float(t1))
    for name in (*optional, "rtol", "atol"):
        value = numbers[name]
        if value is not None and name not in unusable and _tree.is_concrete(value):
            may_be_zero = name in ("rtol", "atol")
            is_valid = math.isfinite(value) and (value >= 0 if may_be_zero else value > 0)
            rule(
                bool(is_valid),
                name,
                value,
                f"it must be {'≥ 0' if may_be_zero else 'positive'} and finite",
                "Give a positive number",
            )
    if dt is None and not wrong and dt_max is not None and _tree.is_concrete(t0, t1, dt_max):
        limit, span = ADAPTIVE_STEPS if max_steps is None else max_steps, float(t1) - float(t0)
        rule(span <= limit * float(dt_max), "dt_max", dt_max,
             f"a run of length {span:g} takes more than max_steps = {limit} steps of that length",
             f"Write {span / limit:.1e} or more, or raise max_steps")  # fmt: skip
    if not unusable & {"rtol", "atol"} and _tree.is_concrete(call.rtol, call.atol):
        rule(bool(call.rtol != 0 or call.atol != 0), "rtol, atol", _tree.Text("0, 0"),
             "one of them must be positive", "No finite step has defect zero")  # fmt: skip
        rule(bool(call.rtol < 1), "rtol", call.rtol,
             "it must be below 1, or an error as large as x itself is accepted",
             "Write rtol=1e-6 for six digits")  # fmt: skip
    wrong.raise_any()


@cache
def _tiny(dtype: Any) -> float:
    """Return the smallest normal number of a floating-point type."""
    return float(jnp.finfo(dtype).tiny)


@cache
def _eps(dtype: Any) -> float:
    return float(jnp.finfo(dtype).eps)


def _check_times(rule: Any, ts: Any, t0: float, t1: float) -> None:
    fix = "Sort them, and remove times outside this interval"
    text = f"it must be a vector of increasing times in [{float(t0)!r}, {float(t1)!r}]"
    if np.asarray(ts).dtype.kind in "mM":
        # NumPy would convert them to a number of nanoseconds, or of any other unit.
        rule(
            False,
            "ts",
            ts,
            text,
            "Write the times in the unit of t0: times / np.timedelta64(1, 's')",
        )
        return
    try:
        times = np.asarray(ts, float)
    except (TypeError, ValueError):
        rule(False, "ts", ts, text, "Write a list of numbers")
        return
    got = times if times.size else _tree.Text("nothing")
    if times.ndim != 1 or times.size == 0:
        rule(False, "ts", got, text, fix)
        return
    before = np.append(-np.inf, times[:-1])
    wrong = ~((times >= before) & (times >= t0) & (times <= t1))
    if wrong.any():
        k = int(np.argmax(wrong))
        after = f", after {float(before[k])!r}" if times[k] < before[k] else ""
        got = _tree.Text(f"{float(times[k])!r} at index {k}{after}")
    rule(not wrong.any(), "ts", got, text, fix)


def _not_finite(x0: Any) -> Problems:
    """Return the problems of the initial state: empty, complex or non-finite parts."""
    wrong = Problems()
    for leaf in jax.tree_util.tree_leaves(x0):
        name, wrong_at = "dvax.solve(x0)", None
        if _tree.is_concrete(leaf):
            wrong_at = _tree.first_nonfinite(leaf)
        if np.size(leaf) == 0:
            wrong.add(name, f"shape {np.shape(leaf)}", "a state has at least one entry",
                      "Omit parts without entries")  # fmt: skip
        elif leaf.dtype.kind == "c":
            wrong.add(name, f"an array of {jnp.result_type(leaf)}", "states are real",
                      "Use real and imaginary part as two components")  # fmt: skip
        elif wrong_at is not None:
            wrong.add(name, f"{leaf[wrong_at]} at index {wrong_at}",
                      "every entry must be finite", "Correct the initial state there")  # fmt: skip
        elif _has_explicit_axes(leaf):
            wrong.add(
                name, f"an array on a mesh with explicit axes {leaf.sharding.mesh.axis_names}",
                "the axes must be of the type Auto, so that XLA shards the arrays of a step",
                "Build the mesh by jax.sharding.Mesh(devices, names), or by jax.make_mesh(…, "
                "axis_types=(jax.sharding.AxisType.Auto,))",
            )  # fmt: skip
    return wrong


def _has_explicit_axes(leaf: Any) -> bool:
    """Return whether a concrete array is sharded over axes whose sharding is a part of its type."""
    sharding = getattr(leaf, "sharding", None) if _tree.is_concrete(leaf) else None
    if not isinstance(sharding, NamedSharding):
        return False
    return AxisType.Explicit in sharding.mesh.axis_types


def _wrong_moduli(constants: Any) -> list[InputProblem]:
    """Return the problems of the moduli in `constants`: missing, non-positive or infinite."""
    if constants is None:
        return []
    names = ("gamma", "L_F", "norm_P_inv")
    given = {name: getattr(constants, name) for name in names if hasattr(constants, name)}
    rule, fix = "it must be a positive, finite number", "Use dvax.verify(problem, x0).constants"
    if not given:
        text = "it must have gamma, L_F or norm_P_inv, as dvax.Constants has"
        return [InputProblem("dvax.solve(constants)", repr(constants)[:120], text, fix)]
    return [
        InputProblem(f"dvax.solve(constants.{name})", repr(value)[:120], rule, fix)
        for name, value in given.items()
        if value is not None
        and _tree.is_concrete(value)
        and not (_tree.is_number(value) and 0 < float(value) < math.inf)
    ]


FIRST_GROWTH = 1e3
"""Largest growth factor after the first adaptive step, if dt0 is not given."""


def first_step(span: Any, t0: Any, t1: Any, dtype: Any) -> Any:
    """Return the length of the first step: 10⁻⁶ of the span, but at least four units of roundoff in t,
    and at most the span.

    This rule needs no compilation, and the error estimate of the step gives the scale of the problem.
    The rule of Hairer, Nørsett and Wanner (1993, II.4) needs two evaluations of f̃ and a second
    derivative.
    """
    step = span * 1e-6
    if not _tree.is_concrete(t0, t1):
        return step
    ulp = _eps(dtype) * max(abs(t0), abs(t1))
    return min(max(step, 4.0 * ulp), span)


def machine_memory() -> float:
    """Return the bytes of memory of the machine, infinity where it does not report them."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return math.inf


def check_memory(state: int, itemsize: int, steps: int, degree: int) -> None:
    """Raise if the records of `dense=True` exceed the memory of the machine.

    `state` is the number of entries of x, `steps` the largest number of steps, and `degree` that of the
    polynomial of a step.
    """
    needed, available = steps * itemsize * (state * (degree + 3) + 2), machine_memory()
    if needed > available:
        raise input_error(
            "dvax.solve(dense, max_steps)",
            f"True and {steps}",
            f"recording that many steps needs {needed / 2**30:.3g} GiB, and the machine has "
            f"{available / 2**30:.3g} GiB",
            "Give a smaller max_steps, or list the times in ts= instead of dense=True",
        )


def warn_precision(x0: Any, rtol: Any) -> None:
    """Warn if rtol is below the roundoff level of the precision of x0."""
    dtype = _tree.dtype(x0)
    eps = _eps(dtype)
    if _tree.is_concrete(rtol) and float(rtol) == 0.0:
        return  # only atol applies, and the size of x during the run is unknown
    if _tree.is_concrete(rtol) and float(rtol) < 100 * eps:
        wider = "Set jax.config.update('jax_enable_x64', True) before anything else, or pass"
        if jax.config.read("jax_enable_x64"):
            wider = "Give x0 as float64, or pass"
        if jnp.dtype(dtype) == np.float64:
            wider = "Pass"
        warnings.warn(
            f"rtol = {float(rtol):g} cannot be reached in {jnp.dtype(dtype).name}, whose rounding "
            f"error is {eps:.1e} per operation. {wider} rtol = {105 * eps:.1e} or more.",
            stacklevel=3,
        )


def bound_steps(max_steps: int | None, fixed: bool, t0, t1, dt) -> int:
    """Return the largest number of steps of a run: max_steps, or its default.

    The default of a run with fixed steps follows from its length and is rounded up to a power of two.
    """
    if max_steps is not None:
        return int(max_steps)
    if not fixed:
        return ADAPTIVE_STEPS
    if not _tree.is_concrete(t0, t1, dt):
        raise input_error(
            "dvax.solve(max_steps)",
            "None, with t0, t1 or dt traced",
            "the number of fixed steps is then unknown when the loop is compiled",
            "Give max_steps, a bound on it",
        )
    span = float(t1) - float(t0)
    if not span / float(dt) < _MAX_FIXED_STEPS:
        raise input_error(
            "dvax.solve(dt)",
            f"{float(dt):g} for a span of {span:g}",
            f"a run has at most {_MAX_FIXED_STEPS} fixed steps",
            "Give a longer step, or solve in pieces",
        )
    count = math.ceil(span / float(dt)) + 1
    # Round up to a power of two ≥ 2¹², so that runs of different length share a compilation.
    return 2 ** max(12, math.ceil(math.log2(count + 1)))
