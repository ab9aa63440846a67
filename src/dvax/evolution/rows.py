"""The saved rows of a solution: the first ones, joined ones, and a check that they are finite."""

from typing import Any

import jax.tree_util as jtu
import numpy as np

from ..errors import Fix, SolveError
from .solution import Solution

_ROWS = ("ts", "xs", "law", "defect", "law_defect", "completed_defect", "bounds")


def cut(solution: Solution, which: slice) -> Solution:
    """Return the solution at these saved times."""
    rows = {n: jtu.tree_map(lambda leaf: leaf[which], getattr(solution, n)) for n in _ROWS}
    return with_fields(solution, rows)


def with_fields(solution: Solution, fields: dict[str, Any]) -> Solution:
    """Return the solution with some fields replaced."""
    given = {name: getattr(solution, name) for name in solution.__dataclass_fields__}
    return Solution(**(given | fields))


def all_finite(solution: Solution, start: float) -> Solution:
    """Return `solution`, which starts at the time `start`, where all its states are finite. (The
    loop does not check fixed steps one by one.)

    **Raises:** `dvax.SolveError`, with the saved times before the first state that is not finite, and
    the interval in which the state ceased to be so.
    """
    count = len(solution.ts)
    rows = [np.asarray(leaf).reshape(count, -1) for leaf in jtu.tree_leaves(solution.xs)]
    good = np.logical_and.reduce([np.isfinite(row).all(axis=1) for row in rows])
    end = [bool(np.isfinite(leaf).all()) for leaf in jtu.tree_leaves(solution.stats["x"])]
    if good.all() and all(end):
        return solution
    whole = count if good.all() else int(np.argmin(good))
    times = np.asarray(solution.ts)
    after = float(times[whole - 1]) if whole else start
    until = float(times[min(whole, count - 1)])
    raise SolveError(
        f"The state ceased to be finite between t = {after:.10g} and t = {until:.10g}.",
        cut(solution, slice(whole)),
        (
            Fix("rtol", "1e-6", "in the place of dt, for steps that adapt"),
            Fix("", "", "Check the sizes of the coefficients, and the units that they are in"),
        ),
    )
