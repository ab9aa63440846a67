"""What `dvax.solve` asks of its arguments, all of it checked before anything runs."""

import math
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from ..errors import InputError, InputProblem
from ..problem import Problem
from .implicit import Implicit
from .method import AbstractMethod
from .picard import Picard
from .piecewise.method import PiecewiseLinear

ADAPTIVE_STEPS = 2**20
"""The most steps of an adaptive solve, unless max_steps says otherwise."""
_MOST_STEPS = 2**30


def check(
    problem, x0, t0, t1, ts, dt, rtol, atol, dt0, horizon, method, adjoint, measure, dense
) -> None:
    wrong: list[InputProblem] = []

    def rule(holds: bool, name: str, given: Any, text: str, mend: str) -> None:
        if not holds:
            wrong.append(InputProblem(f"dvax.solve({name})", str(given), text, mend))

    rule(isinstance(problem, Problem), "problem", type(problem).__name__,
         "it must be a dvax.Problem", "Build one from A, P, K, f and h")  # fmt: skip
    rule(isinstance(method, AbstractMethod | Implicit | Picard | PiecewiseLinear), "method", method,
         "it must be a method such as dvax.ETD2RK()", "Leave it out for the default")  # fmt: skip
    rule(adjoint in ("reverse", "forward"), "adjoint", repr(adjoint),
         "it must be 'reverse' or 'forward'",
         "'reverse' serves jax.grad, 'forward' jax.jvp")  # fmt: skip
    if isinstance(method, Implicit):
        for name, wanted in (("measure", measure), ("dense", dense)):
            rule(not wanted, name, True, "an implicit method keeps no polynomials of its steps",
                 "Leave it out and name the times in ts=, or use an exponential method")  # fmt: skip
        rule(dt is None, "dt", dt, "how well an implicit method solves its equations follows from "
             "rtol and atol, so its steps adapt", "Leave it out")  # fmt: skip
    if isinstance(method, PiecewiseLinear):
        rule(dt is None, "dt", dt, "dvax.PiecewiseLinear steps from one change of the constraints "
        "to the "
             "next", "Leave it out, and name the times to save in ts=")  # fmt: skip
    if _tree.is_concrete(x0):
        for leaf in map(np.asarray, jax.tree_util.tree_leaves(x0)):
            if not np.isfinite(leaf).all():
                place = tuple(int(i) for i in np.argwhere(~np.isfinite(leaf))[0])
                rule(False, "x0", f"{leaf[place]} at index {place}",
                     "every entry must be finite", "Mend the initial state there")  # fmt: skip
    if _tree.is_concrete(t0, t1):
        rule(bool(math.isfinite(t0) and math.isfinite(t1) and t0 < t1), "t0, t1", f"{t0}, {t1}",
             "t0 < t1, both finite: a semigroup runs forward only", "Swap or mend them")  # fmt: skip
        if ts is not None and _tree.is_concrete(ts):
            times = np.asarray(ts, float)
            good = times.ndim == 1 and times.size > 0 and bool(np.all(np.diff(times) >= 0))
            inside = good and float(t0) <= times[0] and times[-1] <= float(t1)
            if not inside:
                rule(False, "ts", _tree.short(times) if times.size else "nothing",
                     f"a vector of increasing times in [{float(t0):g}, {float(t1):g}]",
                     "Sort them, and drop those outside")  # fmt: skip
    for name, value, zero_allowed in (
        ("dt", dt, False), ("dt0", dt0, False), ("horizon", horizon, False),
        ("rtol", rtol, True), ("atol", atol, True),
    ):  # fmt: skip
        if value is not None and _tree.is_concrete(value):
            ok = math.isfinite(value) and (value >= 0 if zero_allowed else value > 0)
            rule(bool(ok), name, value, "it must be positive and finite", "Give a positive number")
    if _tree.is_concrete(rtol, atol):
        rule(rtol > 0 or atol > 0, "rtol, atol", "0, 0", "one of them must be positive",
             "No finite step has defect zero")  # fmt: skip
    if wrong:
        raise InputError(*wrong)


def warn_precision(x0: Any, rtol: Any) -> None:
    dtype = jnp.result_type(*jax.tree_util.tree_leaves(x0))
    eps = float(jnp.finfo(dtype).eps)
    if _tree.is_concrete(rtol) and float(rtol) == 0.0:
        return  # what is asked for is absolute, and how large x becomes is not known
    if _tree.is_concrete(rtol) and float(rtol) < 100 * eps:
        warnings.warn(
            f"rtol = {float(rtol):g} cannot be reached in {jnp.dtype(dtype).name}, whose rounding is "
            f"{eps:.1e} an operation. Set jax.config.update('jax_enable_x64', True) before anything "
            "else, or ask for less.",
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
