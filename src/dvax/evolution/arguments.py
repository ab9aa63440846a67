"""What `dvax.solve` asks of its arguments, all of it checked before anything runs."""

import math
import os
import warnings
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from ..errors import InputError, InputProblem
from ..problem import Problem
from ..vi import AbstractSolver
from .implicit import Implicit
from .method import AbstractMethod
from .picard import Picard
from .piecewise.method import PiecewiseLinear

ADAPTIVE_STEPS = 2**20
"""The most steps of an adaptive solve, unless max_steps says otherwise."""
_MOST_STEPS = 2**30
MOST_COUNTED = 2**31 - 1
"""The largest max_steps: steps are counted in 32 bits."""


def check(
    problem, x0, t0, t1, ts, dt, rtol, atol, dt0, dt_max, horizon, method, adjoint, measure, dense,
    vi_solver=None, max_steps=None, constants=None, progress=False,
) -> None:  # fmt: skip
    """Raise one `InputError` with everything that is wrong with the arguments of `dvax.solve`."""
    wrong: list[InputProblem] = []

    def rule(holds: bool, name: str, given: Any, text: str, fix: str) -> None:
        if not holds:  # what was given is formatted here, so that a call that is right does not pay
            plain = isinstance(given, _tree.Text) or hasattr(given, "dtype")
            line = _tree.short(given) if plain else repr(given)
            wrong.append(InputProblem(f"dvax.solve({name})", line[:200], text, fix))

    rule(isinstance(problem, Problem), "problem", _tree.Text(type(problem).__name__),
         "it must be a dvax.Problem", "Build one, or pass that of a model: model.problem")  # fmt: skip
    known = AbstractMethod | Implicit | Picard | PiecewiseLinear
    rule(method is None or isinstance(method, known), "method", method,
         "it must be a method such as dvax.ETD2RK()", "Leave it out for the default")  # fmt: skip
    rule(isinstance(vi_solver, AbstractSolver | None), "vi_solver", vi_solver,
         "it must be a solver such as dvax.vi.Auto()", "Leave it out for the default")  # fmt: skip
    rule(adjoint in ("reverse", "forward"), "adjoint", adjoint,
         "it must be 'reverse' or 'forward'",
         "'reverse' serves jax.grad, 'forward' jax.jvp")  # fmt: skip
    for name, flag in (("measure", measure), ("dense", dense), ("progress", progress)):
        rule(isinstance(flag, bool | np.bool_ | None), name, flag, "it must be True or False",
             "Leave it out for the default")  # fmt: skip
    if isinstance(method, Implicit):
        for name, wanted in (("measure", measure), ("dense", dense)):
            rule(not wanted, name, True, "an implicit method keeps no polynomials of its steps",
                 "Leave it out and name the times in ts=, or use an exponential method")  # fmt: skip
        rule(dt is None, "dt", dt, "how well an implicit method solves its equations follows from "
             "rtol and atol, so its steps adapt", "Leave it out")  # fmt: skip
    if dt is not None:
        for name, length in (("dt0", dt0), ("dt_max", dt_max)):
            rule(length is None, name, length, "with dt all steps have that length",
                 f"Leave out {name}, or dt for steps that adapt")  # fmt: skip
    if isinstance(method, PiecewiseLinear):
        rule(vi_solver is None, "vi_solver", vi_solver, "dvax.PiecewiseLinear knows its law in closed "
             "form in each mode", "Leave it out, or name another method")  # fmt: skip
        rule(dt_max is None, "dt_max", dt_max, "dvax.PiecewiseLinear steps from one change of the "
             "constraints to the next", "Leave it out, or name another method")  # fmt: skip
        rule(dt is None, "dt", dt, "dvax.PiecewiseLinear steps from one change of the constraints to "
             "the next", "Leave it out, and name the times to save in ts=")  # fmt: skip
    if max_steps is not None:
        whole = isinstance(max_steps, int | np.integer) and not isinstance(max_steps, bool)
        rule(bool(whole and 1 <= max_steps <= MOST_COUNTED), "max_steps", max_steps,
             f"it must be a whole number from 1 to {MOST_COUNTED}",
             f"Leave it out for {ADAPTIVE_STEPS}")  # fmt: skip
    wrong += _not_finite(x0) + _wrong_moduli(constants)
    numbers = {
        "t0": t0,
        "t1": t1,
        "dt": dt,
        "dt0": dt0,
        "dt_max": dt_max,
        "horizon": horizon,
        "rtol": rtol,
        "atol": atol,
    }
    unusable = set()
    for name, value in numbers.items():
        if type(value) is float or (value is None and name in ("dt", "dt0", "dt_max", "horizon")):
            continue
        if not _tree.is_concrete(value) or _tree.is_number(value):
            continue
        unusable.add(name)
        rule(False, name, value, "it must be one real number",
             "Write a number such as 1.0")  # fmt: skip
    if not unusable & {"t0", "t1"} and _tree.is_concrete(t0, t1):
        span = float(t1) - float(t0) if math.isfinite(t0) and math.isfinite(t1) else math.nan
        least = 2.0**12 * _tiny(jnp.result_type(*jax.tree_util.tree_leaves(x0)))
        if not least <= span < math.inf:
            given = _tree.Text(f"{t0}, {t1}")
            rule(span > 0, "t0, t1", given, "t0 < t1, both finite: a semigroup runs forward only",
                 "Swap or correct them")  # fmt: skip
            rule(span != math.inf, "t0, t1", given, "t1 − t0 must be finite",
                 "Take another unit of time")  # fmt: skip
            rule(not 0 < span < least, "t0, t1", given,
                 f"t1 − t0 must be at least {least:.3g}, or steps underflow to 0",
                 "Take another unit of time")  # fmt: skip
        if ts is not None and _tree.is_concrete(ts):
            _check_times(rule, ts, float(t0), float(t1))
    for name in ("dt", "dt0", "dt_max", "horizon", "rtol", "atol"):
        value = numbers[name]
        if value is not None and name not in unusable and _tree.is_concrete(value):
            zero = name in ("rtol", "atol")
            ok = math.isfinite(value) and (value >= 0 if zero else value > 0)
            rule(bool(ok), name, value, "it must be positive and finite", "Give a positive number")
    if dt is None and not wrong and dt_max is not None and _tree.is_concrete(t0, t1, dt_max):
        most, span = ADAPTIVE_STEPS if max_steps is None else max_steps, float(t1) - float(t0)
        rule(span <= most * float(dt_max), "dt_max", dt_max,
             f"steps no longer than that are more than max_steps = {most} over {span:g}",
             f"Write {span / most:.1e} or more, or raise max_steps")  # fmt: skip
    if not unusable & {"rtol", "atol"} and _tree.is_concrete(rtol, atol):
        rule(bool(rtol != 0 or atol != 0), "rtol, atol", _tree.Text("0, 0"),
             "one of them must be positive", "No finite step has defect zero")  # fmt: skip
    if wrong:
        raise InputError(*wrong)


@cache
def _tiny(dtype: Any) -> float:
    """The smallest normal number of a type."""
    return float(jnp.finfo(dtype).tiny)


@cache
def _eps(dtype: Any) -> float:
    return float(jnp.finfo(dtype).eps)


def _check_times(rule: Any, ts: Any, t0: float, t1: float) -> None:
    fix = "Sort them, and drop those outside"
    text = f"a vector of increasing times in [{t0:g}, {t1:g}]"
    try:
        times = np.asarray(ts, float)
    except (TypeError, ValueError):
        rule(False, "ts", ts, text, "Write a list of numbers")
        return
    good = times.ndim == 1 and times.size > 0 and bool(np.all(np.diff(times) >= 0))
    inside = bool(good and t0 <= times[0] and times[-1] <= t1)
    rule(inside, "ts", times if times.size else _tree.Text("nothing"), text, fix)


def _not_finite(x0: Any) -> list[InputProblem]:
    """What is wrong with the numbers of the initial state."""
    wrong = []
    for leaf in jax.tree_util.tree_leaves(x0):
        name, array = "dvax.solve(x0)", None if not _tree.is_concrete(leaf) else np.asarray(leaf)
        if np.size(leaf) == 0:
            wrong.append(
                InputProblem(name, f"shape {np.shape(leaf)}", "a state has at least one entry",
                             "Leave out parts without entries")
            )  # fmt: skip
        elif leaf.dtype.kind == "c":
            wrong.append(
                InputProblem(name, f"an array of {jnp.result_type(leaf)}", "states are real",
                             "Take real and imaginary part as two components")
            )  # fmt: skip
        elif array is not None and not np.isfinite(array).all():
            place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            wrong.append(
                InputProblem(name, f"{array[place]} at index {place}",
                             "every entry must be finite", "Correct the initial state there")
            )  # fmt: skip
    return wrong


def _wrong_moduli(constants: Any) -> list[InputProblem]:
    """What is wrong with the moduli that an object declares."""
    if constants is None:
        return []
    names = ("gamma", "L_F", "norm_P_inv")
    given = {name: getattr(constants, name) for name in names if hasattr(constants, name)}
    rule, fix = "it must be a positive, finite number", "Take dvax.verify(problem, x0).constants"
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
"""Largest growth factor after the first adaptive step, where its length was not given."""


def first_step(span: Any, t0: Any, t1: Any, dtype: Any) -> Any:
    """Return 10⁻⁶ of the span, and no less than four roundings of t, or the span where it is less.

    Such a step takes no compilation, and its error estimate gives the scale of the problem, where the
    rule of Hairer, Nørsett and Wanner (1993, II.4) takes two evaluations of f̃ and a second derivative.
    """
    step = span * 1e-6
    if not _tree.is_concrete(t0, t1):
        return step
    ulp = _eps(dtype) * max(abs(t0), abs(t1))
    return min(max(step, 4.0 * ulp), span)


def check_memory(state: int, itemsize: int, steps: int, degree: int) -> None:
    """Refuse `dense=True` where the records of so many steps exceed the memory of the machine."""
    needed = steps * itemsize * (state * (degree + 3) + 2)
    try:
        available = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return  # not every system says how much it has
    if needed > available:
        raise InputError(
            InputProblem(
                "dvax.solve(dense, max_steps)",
                f"True and {steps}",
                f"keeping so many steps takes {needed / 2**30:.3g} GiB, and the machine has "
                f"{available / 2**30:.3g} GiB",
                "Give max_steps, a bound on the steps that are needed, or name times in ts=",
            )
        )


def warn_precision(x0: Any, rtol: Any) -> None:
    dtype = jnp.result_type(*jax.tree_util.tree_leaves(x0))
    eps = float(jnp.finfo(dtype).eps)
    if _tree.is_concrete(rtol) and float(rtol) == 0.0:
        return  # what is asked for is absolute, and how large x becomes is not known
    if _tree.is_concrete(rtol) and float(rtol) < 100 * eps:
        wider = "Set jax.config.update('jax_enable_x64', True) before anything else, or pass"
        if jax.config.read("jax_enable_x64"):
            wider = "Give x0 as float64, or pass"
        if jnp.dtype(dtype) == np.float64:
            wider = "Pass"
        warnings.warn(
            f"rtol = {float(rtol):g} cannot be reached in {jnp.dtype(dtype).name}, whose rounding is "
            f"{eps:.1e} an operation. {wider} rtol = {105 * eps:.1e} or more.",
            stacklevel=3,
        )


def bound_steps(max_steps: int | None, fixed: bool, t0, t1, dt) -> int:
    if max_steps is not None:
        return int(max_steps)
    if not fixed:
        return ADAPTIVE_STEPS
    if not _tree.is_concrete(t0, t1, dt):
        raise InputError(
            InputProblem(
                "dvax.solve(max_steps)",
                "None, with t0, t1 or dt traced",
                "the number of fixed steps is then unknown when the loop is compiled",
                "Give max_steps, a bound on it",
            )
        )
    span = float(t1) - float(t0)
    if not span / float(dt) < _MOST_STEPS:
        raise InputError(
            InputProblem(
                "dvax.solve(dt)",
                f"{float(dt):g} for a span of {span:g}",
                f"that is more than {_MOST_STEPS} steps, which cannot be counted",
                "Give a longer step, or solve in pieces",
            )
        )
    count = math.ceil(span / float(dt)) + 1
    # A power of two, and not a small one: runs of different length share one compilation.
    return 2 ** max(12, math.ceil(math.log2(count + 1)))
