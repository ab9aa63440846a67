"""The cost of the certificate on a field, and its ratio to the true error on C1."""

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jax.experimental.sparse import BCOO

import dvax

from .. import compiled
from ..clock import in_turn, timed
from ..contact_law import single, strip
from ..section import Section, Table, compare

_POINTS, _STEP, _STEPS = 10**5, 1e-3, 200
_END, _TIMES = 2.0, 41
_CERTIFIED = (1e-3, 1e-5, 1e-7)
_ROUNDING = 1e-13
"""Errors below this are rounding, of which the certificate does not speak."""
_RUNS: tuple[tuple[str, dvax.ETD1 | dvax.ETD2RK, tuple[float, ...]], ...] = (
    ("ETD1", dvax.ETD1(), (1e-2, 1e-3, 1e-4)),
    ("ETD2RK", dvax.ETD2RK(), (1e-2, 1e-4, 1e-6, 1e-8)),
)


def run(full: bool) -> Section:
    section = Section(
        title="certificate: its cost, and its ratio to the true error",
        fair=(
            f"Cost: dvax.solve as called, {_POINTS:.0e} points, {_STEPS} fixed steps, with "
            "measure=True against measure=False, which does not sample the defect and certifies "
            f"nothing. Ratio: bound / true error of C1 at t = 2, adaptive steps, {_TIMES} saved "
            "times, the true error from the closed form; 'sharp' uses the one-sided constant. These "
            "errors are of ETD1 and ETD2RK at the given rtol, atol = rtol/1000. certified_tol: the "
            "time of all its runs, against the smallest number of fixed steps (in steps of a tenth) "
            "whose true error, unknown beforehand, is just below it."
        ),
        tables=[Table("bound / true error on C1", _HEADER, _closeness())],
    )
    law = strip(_POINTS)
    start, end = jnp.asarray(law.start), _STEP * _STEPS
    sides = {
        measure: functools.partial(
            compiled.called, law.model, start, end, dt=_STEP, measure=measure
        )
        for measure in (True, False)
    }
    errors = {measure: law.error(side(), end) for measure, side in sides.items()}
    taken = in_turn({str(m): timed(side) for m, side in sides.items()}, 25 if full else 11)
    section.comparisons.append(
        compare("measure=True, whole call", "measure=False", taken["True"], taken["False"],
                error=errors[True], error_other=errors[False])
    )  # fmt: skip
    _bound_after_a_run(section, law.model, start, full)
    _certified(section, full)
    section.tables.append(
        Table(f"dvax.verify, sparse affine f and h, n = {_LARGE:.0e}", _LARGE_HEADER, _large())
    )
    return section


_LARGE = 10**4
_LARGE_HEADER = ("matrix", "s, compilation included", "status", "β_f / ‖matrix‖", "target")


def _large() -> list[tuple[str, ...]]:
    """Constants of data too large for a matrix: Lanczos, through a scatter and through JAX's BCOO."""
    M = 0.2 * scipy.sparse.random(_LARGE, _LARGE, density=4 / _LARGE, random_state=3, format="coo")
    norm = scipy.sparse.linalg.svds(M, k=1, return_singular_vectors=False)[0]
    rows, columns, values = (jnp.asarray(v) for v in (M.row, M.col, M.data))
    B = BCOO.from_scipy_sparse(M)
    found = []
    for name, push in (
        ("scatter", lambda v: jnp.zeros(_LARGE).at[rows].add(values * v[columns])),
        ("BCOO", lambda v: B @ v),
    ):
        problem = dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
            f=lambda t, x, u, args, push=push: push(u),
            h=lambda t, x, u, args, push=push: x - push(u),
        )  # fmt: skip
        started = time.perf_counter()
        check = dvax.verify(problem, jnp.zeros(_LARGE))
        taken = time.perf_counter() - started
        assert check.constants is not None
        ratio = float(check.constants.beta_f) / norm
        found.append((name, f"{taken:.1f}", check.status, f"{ratio:.4f}", "≤ 10 s"))
    return found


def _bound_after_a_run(
    section: Section, model: dvax.models.Contact, start: Any, full: bool
) -> None:
    """What `bound_error` adds to an adaptive solve, which measures its defect anyway."""
    times = np.linspace(0.0, 0.5, 6)[1:]
    settings: dict[str, Any] = dict(ts=times, rtol=1e-4, atol=1e-7)

    def solve() -> dvax.Solution:
        return dvax.solve(model.problem, start, 0.0, 0.5, **settings)

    def bounded() -> Any:
        return jax.block_until_ready(dvax.bound_error(model.problem, solve(), model.constants).x)

    sides = {"bounded": bounded, "solve": lambda: jax.block_until_ready(solve().xs)}
    taken = in_turn({name: timed(side) for name, side in sides.items()}, 9 if full else 5)
    section.comparisons.append(
        compare("adaptive solve and bound_error", "adaptive solve", taken["bounded"],
                taken["solve"], target=("≤", 1.6))
    )  # fmt: skip


def _certified(section: Section, full: bool) -> None:
    """`certified_tol` against the fewest fixed steps whose true error is just below it."""
    law, times = single(), np.linspace(0.0, _END, _TIMES)[1:]
    problem, constants = law.model.problem, law.model.constants
    exact = np.array([law.exact(t)[0] for t in times])

    def error(sol: dvax.Solution) -> float:
        return float(np.max(np.abs(np.asarray(sol.xs) - exact)))

    def fixed(steps: int) -> dvax.Solution:
        return dvax.solve(problem, law.start, 0.0, _END, ts=times, dt=_END / steps)

    for tol in _CERTIFIED:
        run = lambda tol=tol: dvax.solve(  # noqa: E731
            problem, law.start, 0.0, _END, ts=times, constants=constants, certified_tol=tol
        )
        few = next(n for n in (round(8 * 1.1**k) for k in range(200)) if error(fixed(n)) <= tol)
        sides = {
            "certified": lambda run=run: jax.block_until_ready(run().xs),
            "by hand": lambda few=few: jax.block_until_ready(fixed(few).xs),
        }
        taken = in_turn({name: timed(side) for name, side in sides.items()}, 9 if full else 5)
        section.notes.append(
            f"certified_tol = {tol:g}: {int(run().stats['steps'])} steps in its last run, {few} by hand"
        )
        section.comparisons.append(
            compare(f"certified_tol = {tol:g}, as called", f"{few} fixed steps by hand",
                    taken["certified"], taken["by hand"], error=error(run()),
                    error_other=error(fixed(few)), target=("≤", 3.0))
        )  # fmt: skip


_HEADER = ("method", "rtol", "steps", "true error", "bound", "bound/error", "sharp/error",
           "least ratio", "above at every time")  # fmt: skip


def _closeness() -> list[tuple[str, ...]]:
    law = single()
    times = np.linspace(0.0, _END, _TIMES)
    exact = np.array([law.exact(t)[0] for t in times])
    problem, constants = law.model.problem, law.model.constants
    rows = []
    for name, method, tolerances in _RUNS:
        for rtol in tolerances:
            sol = dvax.solve(
                problem, law.start, 0.0, _END, ts=times, rtol=rtol, atol=1e-3 * rtol, method=method
            )
            bound = dvax.bound_error(problem, sol, constants)
            assert bound.x_sharp is not None
            error = np.abs(np.asarray(sol.xs) - exact)
            above, sharp = np.asarray(bound.x_paper), np.asarray(bound.x_sharp)
            told = error > _ROUNDING
            least = np.min(np.minimum(above, sharp)[told] / error[told])
            rows.append(
                (
                    name,
                    f"{rtol:.0e}",
                    str(int(sol.stats["steps"])),
                    f"{error[-1]:.1e}",
                    f"{above[-1]:.1e}",
                    f"{above[-1] / error[-1]:.3g}",
                    f"{sharp[-1] / error[-1]:.3g}",
                    f"{least:.3g}",
                    "yes" if least >= 1.0 else "NO",
                )
            )
    return rows
