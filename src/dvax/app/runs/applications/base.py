"""What an application hands to a run, and what a run asks of it."""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import jax
import numpy as np

from dvax.app.runs.schema import Section
from dvax.problem import Problem
from dvax.theory import Assumption, Constants


@dataclass(frozen=True)
class Figure:
    """A headline figure: a number, or a list of them; `error`: a proved bound on its error, or on those
    of its entries, where there is one. A figure that is a bound itself says in `bound` how much is
    known of it: "proved", "declared" or "estimated"."""

    value: Any
    unit: str
    meaning: str
    error: Any = None
    bound: str | None = None


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
    """What a run leaves: figures for summary.json, variables for trajectory.zarr, constants and
    assumptions for the report; `files` writes what else belongs into the run directory."""

    figures: Mapping[str, Figure]
    variables: Mapping[str, Variable]
    constants: Constants | None
    steps: int
    assumptions: tuple[Assumption, ...] = ()
    notices: tuple[str, ...] = ()
    files: Callable[[Path], None] | None = None


class Known(NamedTuple):
    """What is known of a model before anything is solved: its constants and assumptions, sizes as
    (what, value, remark), and `notes`, sentences about what is allowed but worth knowing."""

    constants: Constants | None
    assumptions: tuple[Assumption, ...]
    sizes: list[tuple[str, str, str]]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """What a run integrates: the problem from x0 at the first of `times` up to the last, saved at all
    of them, with these `settings` for `dvax.solve`. `data` is the application's own."""

    problem: Problem
    x0: Any
    times: np.ndarray
    constants: Constants
    settings: Mapping[str, Any]
    data: Any = None
    time_unit: str = ""


class PerRow:
    """Functions of one row of a solution over all of its rows, each compiled once for a model. One row
    after the other: of a large state all at once would need more memory than the solve."""

    def __init__(self) -> None:
        self._made: dict[str, Callable[..., Any]] = {}

    def __call__(self, name: str, function: Callable[..., Any], *rows: Any) -> np.ndarray:
        """function(*row) at every row of `rows`; by the same `name` it is the same function."""
        if name not in self._made:
            self._made[name] = jax.jit(lambda *rows: jax.lax.map(lambda row: function(*row), rows))
        return np.asarray(self._made[name](*rows))


Say = Callable[[str], None]
"""To be told what a solve is about to do: "solving at rest", for a reader who waits."""

Model = TypeVar("Model")


class AbstractApplication(abc.ABC, Generic[Model]):
    """A model that the table `[model]` of a configuration describes alone.

    - `section`: that table, for pydantic; the keys in `files` name data files, those in `folders`
      folders, with the files that are read there;
    - `keys`: the keys that make an argument of the model, where they are called otherwise than it;
    - `read`: from the table to the model, everything checked, nothing solved;
    - `fit`: "exact", or by what it is regularised, or why it is outside the class;
    - `known`: what can be told before anything is solved;
    - `plan`: what is to be integrated, all else being computed, saying at each stage what it does;
    - `results`: from the solution, of which the first `count` rows are meant, to the results.

    `end` is the key of the file for the last time of a run, where there is one.
    """

    section: ClassVar[type[Section]]
    files: ClassVar[tuple[str, ...]] = ()
    folders: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    keys: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    end: ClassVar[str | None] = None

    @abc.abstractmethod
    def read(self, table: Any, paths: Mapping[str, Path], quiet: bool) -> Model:
        """The model, from its table and where its data lies; `quiet`: without lines of progress.

        **Raises:** `dvax.InputError` with everything that is wrong.
        """

    @abc.abstractmethod
    def fit(self, model: Model) -> str:
        """Whether the model is in the class, exactly or regularised."""

    @abc.abstractmethod
    def known(self, model: Model) -> Known:
        """Constants, assumptions, sizes and notes."""

    @abc.abstractmethod
    def plan(self, model: Model, say: Say) -> Plan:
        """What to integrate. **Raises:** `dvax.SolveError`."""

    @abc.abstractmethod
    def results(self, model: Model, plan: Plan, solution: Any, count: int) -> Results:
        """The results up to the time number `count` of the plan. The `dvax.Solution` has all rows of
        the plan, and the last of those `count` once more in each that was not reached: what is compiled
        for the first results serves all later ones. None stands for it where the plan has one time
        alone."""
