"""The interface between an application and a run."""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np

from dvax.app.runs.figure import Figure as Figure
from dvax.app.runs.schema import Section
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
    """The results of a run: figures for summary.json, variables for trajectory.zarr, constants and
    assumptions for the report; `files` writes further files into the run directory."""

    figures: Mapping[str, Figure]
    variables: Mapping[str, Variable]
    constants: Constants | None
    steps: int
    assumptions: tuple[Assumption, ...] = ()
    notices: tuple[str, ...] = ()
    files: Callable[[Path], None] | None = None


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
    of them, with these `settings` (`AbstractApplication.settings`). `data` is the application's
    own."""

    problem: Problem
    x0: Any
    times: np.ndarray
    constants: Constants | None
    settings: Mapping[str, Any]
    data: Any = None
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


class AbstractApplication(abc.ABC):
    """A model that the table `[model]` of a configuration describes alone.

    It is made from that table and the places of its data, everything checked and nothing solved; with
    `quiet` it prints no progress. The constructor raises `dvax.InputError` with all problems.

    - `section`: the table, for pydantic; `table`: the checked one, complete;
    - `files`, `folders`: the keys that name data files, and folders with the files that are read there;
    - `keys`: the keys that make an argument of the model, where their names differ from its name;
    - `end`: the key for the last time of a run, where there is one;
    - `title`: of the run, by default that of the configuration.
    """

    section: ClassVar[type[Section]]
    table: Any
    files: ClassVar[tuple[str, ...]] = ()
    folders: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    keys: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    end: ClassVar[str | None] = None
    title: str = ""

    @abc.abstractmethod
    def __init__(self, table: Any, paths: Mapping[str, Path], quiet: bool): ...

    @property
    @abc.abstractmethod
    def fit(self) -> str:
        """Whether the model is in the class: "exact", by what it is regularised, or why it is not."""

    @property
    @abc.abstractmethod
    def settings(self) -> Mapping[str, Any]:
        """The method, steps and tolerances: keywords for `dvax.solve`."""

    @abc.abstractmethod
    def describe(self) -> Description:
        """Constants, assumptions, sizes and notes: what is known before anything is solved."""

    @abc.abstractmethod
    def plan(self, say: Say) -> Plan:
        """What to integrate, all else being computed. **Raises:** `dvax.SolveError`."""

    @abc.abstractmethod
    def results(self, plan: Plan, solution: Any, count: int) -> Results:
        """The results up to the time number `count` of the plan.

        The `dvax.Solution` has all rows of the plan; rows that were not reached repeat the last of
        those `count`, so that one compiled program serves all results. It is None where the plan has
        one time alone.
        """
