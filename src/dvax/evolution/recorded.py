"""The steps of a run that did not record them, made again."""

import math
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from .arguments import ADAPTIVE_STEPS, first_step
from .piecewise.method import PiecewiseLinear
from .results import is_success
from .solve import solve

if TYPE_CHECKING:
    from .solution import Solution

_EVENTS = 256
"""The default of `max_events` in `dvax.solve`."""


def recorded(solution: "Solution") -> "Solution":
    """Return the solution of the same run with `dense=True`: the same steps, up to rounding.

    **Raises:** `dvax.InputError` if the method records no steps.
    """
    setup = solution.setup
    number = {name: float(np.asarray(value)) for name, value in setup.setting.items()}
    t0, t1 = number["t0"], number["t1"]
    has_default_dt0 = number["dt0"] == float(first_step(t1 - t0, t0, t1, setup.dtype))
    tolerances = {name: number[name] for name in ("rtol", "atol")}
    if math.isnan(number["dt"]):
        succeeded = bool(is_success(solution.result))
        attempts = sum(int(solution.stats[name]) for name in ("steps", "rejected"))
        steps: dict[str, Any] = tolerances | {
            "dt0": None if has_default_dt0 else number["dt0"],
            "dt_max": number["dt_max"] if math.isfinite(number["dt_max"]) else None,
            # A run that failed stops where it did.
            "max_steps": max(ADAPTIVE_STEPS, attempts) if succeeded else attempts,
        }
    else:
        steps = tolerances | {"dt": number["dt"], "measure": solution.defect is not None}
    happened = 0 if solution.events is None else len(solution.events.index)
    return solve(
        setup.problem, setup.x0, t0, t1, setup.args, method=setup.method,
        vi_solver=None if isinstance(setup.method, PiecewiseLinear) else setup.vi_solver,
        constants=SimpleNamespace(**setup.moduli) if setup.moduli else None,
        horizon=number["horizon"], dense=True, throw=False, events=setup.events,
        max_events=max(_EVENTS, happened), **steps,
    )  # fmt: skip
