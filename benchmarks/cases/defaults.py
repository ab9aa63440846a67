"""A call with no options beside each single method, and beside other tools with the law by hand."""

import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..clock import in_turn, spread, timed
from ..default_problems import Case, cases
from ..layout import duration
from ..peers.by_hand import Solve, solvers
from ..section import Comparison, Section, Table, Target

_TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
_METHODS = (dvax.ETD2RK(), dvax.ETD4RK(), dvax.DormandPrince(), dvax.ExpRosenbrock())
_MOST_STEPS = 200_000
_ENOUGH, _NEAR = 0.1, 1000.0
"""Errors in tolerances: below the first, less is worth no more; above the second, no peer counts."""
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
            f"than {_MOST_STEPS} steps or miss ten tolerances do not count. Peers get the same "
            "tolerances; a cell is ahead where time times error is smaller than that of every peer, an "
            "error below a tenth of the tolerance being worth no more than that. SciPy runs the law in "
            "NumPy, Diffrax in one function under jax.jit. dvax is compared twice: as called, and in a "
            "function under jax.jit, from x0 and tol to x(t1), as Diffrax is."
        ),
    )
    rows, errors, ratios, failures, beside = [], [], [], 0, []
    ahead: dict[str, list[bool]] = {"call": [], "compiled": []}
    for case in cases(full):
        print(f"defaults: {case.name}", file=sys.stderr, flush=True)
        truth = case.reference()
        named = {type(method).__name__: method for method in _METHODS}
        peers, compiled = solvers(case), _compiled(case)
        for tol in _TOLERANCES:
            row, error, ratio, own = _cell(case, truth, tol, named, full)
            others = _peers(case, truth, tol, peers, full)
            jitted, seconds = _of_compiled(case, truth, tol, compiled, full)
            best = min(others, key=lambda name: others[name][2], default="-")
            for kind, wrong, spent in (("call", error, own), ("compiled", jitted, seconds)):
                score = spent * max(wrong, _ENOUGH)
                is_ahead = np.isfinite(score) and all(score <= v[2] for v in others.values())
                ahead[kind].append(bool(is_ahead))
            beside.append(
                (
                    case.name,
                    f"{tol:g}",
                    f"{error:.2g}, {duration(own)}",
                    f"{jitted:.2g}, {duration(seconds)}",
                )
                + (
                    (best, f"{others[best][0]:.2g}, {duration(others[best][1])}")
                    if others
                    else ("-", "-")
                )
                + tuple("yes" if cells[-1] else "no" for cells in ahead.values())
            )
            print("    " + "  ".join(beside[-1][2:]), file=sys.stderr, flush=True)
            print("  " + "  ".join(row[1:]), file=sys.stderr, flush=True)
            rows.append(row)
            failures += not np.isfinite(error)
            errors.append(error)
            ratios.append(ratio)
    header = ("problem", "tolerance", "method chosen", "steps", "error", "time", "best", "ratio")
    section.tables.append(Table("the default call", header, rows))
    header = (
        "problem", "tolerance", "dvax: error, time", "under jit", "best peer", "error, time",
        "ahead", "ahead under jit",
    )  # fmt: skip
    section.tables.append(Table("beside other tools", header, beside))
    finite = np.asarray(errors)[np.isfinite(errors)]
    figures = [
        ("calls that fail", "≤", 0.0, float(failures)),
        ("median error in tolerances", "≥", 0.05, float(np.median(finite))),
        ("median error in tolerances", "≤", 1.0, float(np.median(finite))),
        ("largest error in tolerances", "≤", 3.0, float(np.max(finite))),
        ("time over the best method's, median", "≤", 1.5, float(np.nanmedian(ratios))),
        ("time over the best method's, largest", "≤", 3.0, float(np.nanmax(ratios))),
        ("share of cells ahead of all peers", "≥", 0.9, float(np.mean(ahead["call"]))),
        ("the same under jax.jit", "≥", 0.9, float(np.mean(ahead["compiled"]))),
    ]
    for name, sign, value, reached in figures:
        target = Target(sign, value, reached)  # pyright: ignore[reportArgumentType]
        section.comparisons.append(Comparison(name, "target", None, None, target=target))
    return section


def _cell(
    case: Case, truth: np.ndarray, tol: float, named: dict[str, Any], full: bool
) -> tuple[Any, float, float, float]:
    """Return a row of the table, the error in tolerances, the ratio of times, and the time. Methods
    that are too slow leave `named`."""
    x0 = jnp.asarray(case.x0)

    def solve(method: Any) -> dvax.Solution:
        return dvax.solve(
            case.problem, x0, 0.0, case.end, rtol=tol, atol=tol, method=method,
            max_steps=_MOST_STEPS, throw=False,
        )  # fmt: skip

    def error_of(solution: dvax.Solution) -> float:
        if solution.result != dvax.RESULTS.successful:
            return np.inf
        return _error(np.asarray(solution.xs[-1]), truth, tol)

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
    return row, error, ratio, own


def _compiled(case: Case) -> Callable[[Any, float], Any]:
    @jax.jit
    def run(x0: Any, tol: Any) -> Any:
        return dvax.solve(
            case.problem, x0, 0.0, case.end, rtol=tol, atol=tol, max_steps=_MOST_STEPS
        ).xs[-1]

    return lambda x0, tol: jax.block_until_ready(run(x0, tol))


def _of_compiled(
    case: Case, truth: np.ndarray, tol: float, run: Callable[[Any, float], Any], full: bool
) -> tuple[float, float]:
    """Return the error in tolerances and the time of a compiled function."""
    x0 = jnp.asarray(case.x0)
    error = _error(np.asarray(run(x0, tol)), truth, tol)
    taken = in_turn({"": timed(lambda: run(x0, tol))}, 7 if full else 3)
    return error, spread(taken[""]).middle


def _peers(
    case: Case, truth: np.ndarray, tol: float, peers: dict[str, Solve], full: bool
) -> dict[str, tuple[float, float, float]]:
    """Return error in tolerances, time and their product for the peers that come near the tolerance.
    Those that are too slow leave `peers`."""
    found = {}
    for name, solve in list(peers.items()):
        error = _error(solve(tol), truth, tol)
        start = time.perf_counter()
        solve(tol)
        if time.perf_counter() - start > _LONGEST:
            del peers[name]
        if error < _NEAR:
            run = timed(lambda solve=solve: solve(tol)) if name in peers else None
            if run is not None:
                middle = spread(in_turn({name: run}, 7 if full else 3)[name]).middle
                found[name] = error, middle, middle * max(error, _ENOUGH)
    return found


def _error(x: np.ndarray, truth: np.ndarray, tol: float) -> float:
    """Return the root mean square of the error in units of tol (1 + that of x), infinity for NaN."""
    scale = tol * (1.0 + np.sqrt(np.mean(truth**2)))
    found = float(np.sqrt(np.mean((x - truth) ** 2)) / scale)
    return found if np.isfinite(found) else np.inf
