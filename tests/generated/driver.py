"""Solve samples of a family with dvax and with SciPy, and compare them."""

import time
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

import dvax

from . import reference
from .family import METHODS, Family, Sample

MAX_STEPS = 2**20
SECOND_ORDER = 1e-7
"""Below this rtol the default method, of order 2, takes 10⁶ steps or more."""

LIMIT = 10.0
"""In tolerances: a run that says it succeeded has no larger error."""


class Record(NamedTuple):
    """One run: `ratio` of its error to the tolerance; of the bounds on it that were computed the
    status, and the largest ratio of error to bound (of those errors that stand out of the reference's
    own); what failed, or ""."""

    family: str
    seed: int
    method: str
    rtol: float
    result: str
    ratio: float
    steps: int
    status: str
    excess: float
    seconds: float
    failure: str


def run(
    family: Family,
    seed: int,
    methods: tuple[str, ...] | None = None,
    bounds: bool = True,
    certify: bool = False,
) -> Iterator[Record]:
    """Solve sample `seed` by each method; with `bounds`, also bound each error, and solve once more to
    a certified tolerance."""
    sample = sample_of(family, seed)
    ts = sample.ts - sample.t0
    truth = reference.solve(sample.written, ts)
    constants = None
    if bounds or certify:
        constants = dvax.verify(
            family.problem, sample.x0, sample.t0, sample.t1, sample.args
        ).constants
    found: list[Any] = []

    def second() -> tuple[Any, Any]:
        """By other methods of SciPy, as accurate as they can be, and how far apart these are."""
        if not found:
            written = sample.written._replace(accuracy=reference.FINEST)
            other = "DOP853" if written.stiff else "LSODA"
            found.append(reference.solve(written, ts, method=other, refine=2))
            third = reference.solve(written, ts, method="Radau", refine=3)
            found.append(np.linalg.norm(third - found[0], axis=1))
        return found[0], found[1]

    for name in methods or family.methods:
        if name == "default" and sample.rtol < SECOND_ORDER:
            continue
        record = assess(family, seed, sample, name, truth, constants, second)
        if record.failure:
            # Two methods of SciPy against the one that is wrong: this one, or the third.
            finer, apart = second()
            apart = float(np.max(apart)) / tolerance(sample, finer)
            if apart > 0.5:
                text = f"no reference: SciPy's methods are {apart:.1e} tolerances apart"
                record = record._replace(failure=text)
            else:
                record = assess(family, seed, sample, name, finer, constants, second)
        yield record
    if certify and constants is not None:
        method = (methods or family.methods)[0]
        yield certified(family, seed, sample, method, truth, constants, second)


def sample_of(family: Family, seed: int) -> Sample:
    """Sample number `seed` of a family; each family has its own random numbers."""
    return family.draw(np.random.default_rng([seed, zlib.crc32(family.name.encode())]))


def tolerance(sample: Sample, truth: Any) -> float:
    """Return atol + rtol max|x| of the run, with the root mean square as |·|."""
    return float(sample.atol + sample.rtol * np.max(_size(truth)))


def _size(x: Any) -> Any:
    """The root mean square, as in the step-size control."""
    return np.sqrt(np.mean(np.square(x), axis=1))


def solve(family: Family, sample: Sample, method: str, **options: Any) -> dvax.Solution:
    return dvax.solve(
        family.problem, sample.x0, sample.t0, sample.t1, sample.args, sample.ts, rtol=sample.rtol,
        atol=sample.atol, method=METHODS[method], vi_solver=sample.law, throw=False,
        max_steps=MAX_STEPS, **options,
    )  # fmt: skip


def assess(
    family: Family, seed: int, sample: Sample, method: str, truth: Any, constants: Any, second: Any
) -> Record:
    started = time.perf_counter()
    sol = solve(family, sample, method)
    steps = int(sol.stats["steps"])
    spent = time.perf_counter() - started
    good = bool(sol.result == dvax.RESULTS.successful)
    ratio, status, excess, failure = np.nan, "", 0.0, ""
    if good:
        ratio = float(np.max(_size(states(sol, truth) - truth)) / tolerance(sample, truth))
        if not ratio <= LIMIT:
            failure = f"wrong by {ratio:.3g} tolerances, and successful"
        if constants is not None:
            bound = dvax.bound_error(family.problem, sol, constants)
            status = bound.status
            excess = beyond(sol, bound.x, sample, truth, second)
            if excess > 1.0 and not failure:
                failure = f"the bound, {status}, is {excess:.3g} times too small"
            elif excess > 1.0:
                failure += f"; the bound, {status}, is {excess:.3g} times too small"
    else:
        word = str(dvax.RESULTS[sol.result]).split(".")[0]
        failure = f"died at t0 + {float(sol.stats['t']) - sample.t0:.6g}: {word}"
    return Record(
        family.name, seed, method, sample.rtol, "successful" if good else "died", ratio, steps,
        status, excess, spent, failure,
    )  # fmt: skip


def certified(
    family: Family, seed: int, sample: Sample, method: str, truth: Any, constants: Any, second: Any
) -> Record:
    """Run with `certified_tol`: an error message, or a result within the tolerance, is correct."""
    started = time.perf_counter()
    wanted = 1e2 * tolerance(sample, truth)
    steps, ratio, excess, result, failure = 0, np.nan, 0.0, "refused", ""
    try:
        sol = dvax.solve(
            family.problem, sample.x0, sample.t0, sample.t1, sample.args, sample.ts,
            method=METHODS[method], vi_solver=sample.law, constants=constants,
            certified_tol=wanted, max_steps=MAX_STEPS, throw=False,
        )  # fmt: skip
    except dvax.InputError:
        sol = None
    if sol is not None and sol.result == dvax.RESULTS.successful:
        result, steps = "successful", int(sol.stats["steps"])
        ratio = float(np.max(np.linalg.norm(states(sol, truth) - truth, axis=1)) / wanted)
        excess = beyond(sol, reached(sol), sample, truth, second)
        if excess > 1.0:
            failure = f"the certified bound is {excess:.3g} times too small"
    return Record(
        family.name, seed, f"{method}, certified", 0.0, result, ratio, steps, "", excess,
        time.perf_counter() - started, failure,
    )  # fmt: skip


def reached(sol: dvax.Solution) -> float:
    """The bound at the end of a run with `certified_tol`, certified or estimated."""
    return sol.stats.get("certified_bound", sol.stats.get("estimated_bound", np.inf))


def states(sol: dvax.Solution, truth: Any) -> Any:
    """The saved states as rows, parts of a tuple beside each other."""
    parts = [np.asarray(leaf).reshape(len(truth), -1) for leaf in jax.tree_util.tree_leaves(sol.xs)]
    return np.concatenate(parts, axis=1)


def beyond(
    sol: dvax.Solution, bound: Any, sample: Sample, truth: Any, second: Callable[[], Any]
) -> float:
    """The largest ratio of error to bound at one time, above 1 where the bound is violated.

    Not counted: the error of the reference (its own, and where that is not enough, twice how far apart
    the finest references are up to that time), and rounding, which bounds leave out: of x a few
    thousand times, and that of t."""
    eps = np.finfo(float).eps
    x, w = states(sol, truth), sample.written
    size = 1.0 + float(np.max(np.linalg.norm(truth, axis=1)))
    rounding = 1e3 * eps + 10 * eps * max(abs(sample.t0), abs(sample.t1)) / w.span
    over = np.linalg.norm(x - truth, axis=1) - size * (10 * w.accuracy + rounding)
    if np.any(over > bound):
        finer, apart = second()
        over = np.linalg.norm(x - finer, axis=1) - 2.0 * np.maximum.accumulate(apart)
        over = over - size * (10 * reference.FINEST + rounding)
    return float(np.max(np.where(over > 0, over / np.maximum(bound, 1e-300), 0.0)))
