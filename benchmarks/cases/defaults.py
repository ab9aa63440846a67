"""A call with no options beside each single method: success, error in tolerances, and time."""

import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..clock import in_turn, spread, timed
from ..default_problems import Case, cases
from ..layout import duration
from ..section import Comparison, Section, Table, Target

_TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
_METHODS = (dvax.ETD2RK(), dvax.ETD4RK(), dvax.DormandPrince(), dvax.ExpRosenbrock())
_MOST_STEPS = 200_000
_LONGEST = 0.3
"""Seconds beyond which a named method is left out of the comparison, at this tolerance and below."""


def run(full: bool) -> Section:
    section = Section(
        title="defaults: a call with no options",
        fair=(
            "dvax.solve(problem, x0, 0, t1, rtol=tol, atol=tol), as called, beside the same call "
            "with each method named. The error is that of x(t1), its root mean square in units of "
            "tol (1 + that of x), against closed forms or SciPy's Radau at 1e-12 with the law "
            "written by hand. A time is a median after compilation. Methods that fail, need more "
            f"than {_MOST_STEPS} steps or miss ten tolerances do not count."
        ),
    )
    rows, errors, ratios, failures = [], [], [], 0
    for case in cases(full):
        print(f"defaults: {case.name}", file=sys.stderr, flush=True)
        truth = case.reference()
        named = {type(method).__name__: method for method in _METHODS}
        for tol in _TOLERANCES:
            row, error, ratio = _cell(case, truth, tol, named, full)
            print("  " + "  ".join(row[1:]), file=sys.stderr, flush=True)
            rows.append(row)
            failures += not np.isfinite(error)
            errors.append(error)
            ratios.append(ratio)
    header = ("problem", "tolerance", "method chosen", "steps", "error", "time", "best", "ratio")
    section.tables.append(Table("the default call", header, rows))
    finite = np.asarray(errors)[np.isfinite(errors)]
    figures = [
        ("calls that fail", "≤", 0.0, float(failures)),
        ("median error in tolerances", "≥", 0.05, float(np.median(finite))),
        ("median error in tolerances", "≤", 1.0, float(np.median(finite))),
        ("largest error in tolerances", "≤", 3.0, float(np.max(finite))),
        ("time over the best method's, median", "≤", 1.5, float(np.nanmedian(ratios))),
        ("time over the best method's, largest", "≤", 3.0, float(np.nanmax(ratios))),
    ]
    for name, sign, value, reached in figures:
        target = Target(sign, value, reached)  # pyright: ignore[reportArgumentType]
        section.comparisons.append(Comparison(name, "target", None, None, target=target))
    return section


def _cell(
    case: Case, truth: np.ndarray, tol: float, named: dict[str, Any], full: bool
) -> tuple[Any, float, float]:
    """Return a row of the table, the error in tolerances, and the ratio of times. Methods that are too
    slow leave `named`."""
    x0 = jnp.asarray(case.x0)
    scale = tol * (1.0 + np.sqrt(np.mean(truth**2)))

    def solve(method: Any) -> dvax.Solution:
        return dvax.solve(
            case.problem, x0, 0.0, case.end, rtol=tol, atol=tol, method=method,
            max_steps=_MOST_STEPS, throw=False,
        )  # fmt: skip

    def error_of(solution: dvax.Solution) -> float:
        if solution.result != dvax.RESULTS.successful:
            return np.inf
        return float(np.sqrt(np.mean((np.asarray(solution.xs[-1]) - truth) ** 2)) / scale)

    first = solve(None)
    able = {"": timed(lambda: jax.block_until_ready(solve(None).xs))}
    for name, method in list(named.items()):
        try:
            found = solve(method)
        except dvax.InputError:  # ExpRosenbrock refuses systems that are too large for its matrix
            del named[name]
            continue
        start = time.perf_counter()
        solve(method)
        if time.perf_counter() - start > _LONGEST:
            del named[name]
        elif error_of(found) < 10.0:
            able[name] = timed(lambda m=method: jax.block_until_ready(solve(m).xs))
    error = error_of(first)
    taken = in_turn(able, 11 if full else 5)
    middle = {name: spread(series).middle for name, series in taken.items()}
    own = middle.pop("")
    best = min(middle, key=middle.__getitem__, default=None)
    ratio = own / middle[best] if best is not None else np.nan
    row = (
        case.name, f"{tol:g}", first.stats["method"].split(":")[0], str(int(first.stats["steps"])),
        f"{error:.2g}", duration(own), best or "-", f"{ratio:.2f}",
    )  # fmt: skip
    return row, error, ratio
