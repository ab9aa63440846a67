"""What an application gives to a run."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from dvax.app.runs.figure import Figure as Figure
from dvax.problem import Problem
from dvax.theory import Assumption, Constants


@dataclass(frozen=True)
class Variable:
    """An array of the results with the names of its dimensions; one named like its dimension is a
    coordinate. `status`: of a bound, how much is known of it."""

    dims: tuple[str, ...]
    values: np.ndarray
    unit: str
    words: str
    status: str = ""


@dataclass(frozen=True)
class Results:
    """What a run has besides its variables over time: figures for summary.json, the other variables
    of trajectory.zarr, and `files`, which writes further files into the run directory and returns their
    names."""

    figures: Mapping[str, Figure]
    fixed: Mapping[str, Variable]
    files: Callable[[Path], tuple[str, ...]]


class Description(NamedTuple):
    """A model before anything is solved: its constants and assumptions, sizes as (what, value,
    remark), and `notes`, sentences about input that is allowed but unusual."""

    constants: Constants | None
    assumptions: tuple[Assumption, ...]
    sizes: list[tuple[str, str, str]]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """What a run integrates: the problem from x0 at the first of `times` up to the last, saved at all
    of them, with these `settings`."""

    problem: Problem
    x0: Any
    times: np.ndarray
    constants: Constants | None
    settings: Mapping[str, Any]
    time_unit: str = ""
    args: Any = None


class PerRow:
    """Map functions over the rows of a solution, each compiled once for a model. Rows are
    processed one after the other, since a vectorised map of a large state needs more memory than
    the solve."""

    def __init__(self) -> None:
        self._made: dict[str, Callable[..., Any]] = {}

    def __call__(self, name: str, function: Callable[..., Any], *rows: Any) -> np.ndarray:
        """Return function(*row) at every row of `rows`. A `name` always stands for the same
        function."""
        if name not in self._made:
            self._made[name] = jax.jit(lambda *rows: jax.lax.map(lambda row: function(*row), rows))
        return np.asarray(self._made[name](*rows))


Say = Callable[[str], None]
"""A function that reports the next stage of a run: "solving at rest"."""
