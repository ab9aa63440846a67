"""SciPy's and Diffrax's solvers on a right-hand side with the law written into it."""

from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from ..default_problems import Case

Solve = Callable[[float], np.ndarray]
"""From a tolerance, relative and absolute, to x(end); NaN where the solver fails."""

_SCIPY = ("LSODA", "DOP853", "Radau")
_DIFFRAX = {"Tsit5": diffrax.Tsit5(), "Kvaerno5": diffrax.Kvaerno5()}
_MOST_STEPS = 200_000
_LARGEST_DENSE = 600
"""Unknowns up to which a solver with a dense matrix is tried."""


def solvers(case: Case) -> dict[str, Solve]:
    small = case.x0.size <= _LARGEST_DENSE
    found: dict[str, Solve] = {
        f"SciPy {name}": partial(_scipy, case, name) for name in _SCIPY if small or name == "DOP853"
    }
    for name, method in _DIFFRAX.items():
        if small or name == "Tsit5":
            found[f"Diffrax {name}"] = _diffrax(case, method)
    return found


def _scipy(case: Case, name: str, tol: float) -> np.ndarray:
    calls = 0

    def field(t: float, x: np.ndarray) -> Any:
        nonlocal calls
        calls += 1
        if calls > 10 * _MOST_STEPS:
            raise TimeoutError
        return case.field(t, x, np)

    try:
        found = solve_ivp(field, (0.0, case.end), case.x0, method=name, rtol=tol, atol=tol)
    except TimeoutError:
        return np.full_like(case.x0, np.nan)
    return found.y[:, -1] if found.success else np.full_like(case.x0, np.nan)


def _diffrax(case: Case, method: Any) -> Solve:
    """Compiled once, with the tolerance as an argument."""

    @jax.jit
    def solve(x0: Any, tol: Any) -> Any:
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, x, _: case.field(t, x, jnp)), method, 0.0, case.end, None, x0,
            stepsize_controller=diffrax.PIDController(rtol=tol, atol=tol),
            saveat=diffrax.SaveAt(t1=True), max_steps=_MOST_STEPS, throw=False,
        )  # fmt: skip
        assert found.ys is not None
        good = found.result == diffrax.RESULTS.successful
        return jnp.where(good, found.ys[-1], jnp.nan)

    x0 = jnp.asarray(case.x0)
    return lambda tol: np.asarray(solve(x0, tol))
