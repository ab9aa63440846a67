"""Applications whose problem is a `dvax.models.Model`."""

import abc
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import jax.tree_util as jtu
import numpy as np
from pydantic import Field

from dvax.app.runs.applications.base import (
    Description,
    Figure,
    PerRow,
    Plan,
    Results,
    Say,
    Variable,
)
from dvax.app.runs.applications.certificate import Certificate, certificate, log_growth
from dvax.app.runs.schema import Section, SolverKeys
from dvax.app.runs.solver_options import check_model_steps, settings
from dvax.app.runs.state_bound import REMEDY
from dvax.errors import input_error
from dvax.evolution import PiecewiseLinear, Solution
from dvax.evolution.auto import choose
from dvax.models import Model
from dvax.theory import Assumption, Constants, verify

EPSILON = float(np.finfo(float).eps)
FINAL_VALUES = 12
"""Up to this many final values are figures of the summary."""


class FramesKeys(SolverKeys):
    """How many states of a run are saved."""

    frames: int = Field(200, ge=1, le=10**6, description="number of intervals between saved states")


class AbstractModelApplication(abc.ABC):
    """A model that the table `[model]` of a configuration describes alone.

    Its constructor gets that table and the places of its data; with `quiet` it prints no progress. It
    checks everything, solves nothing, and calls `set_model`. It raises `dvax.InputError` with all
    problems. A subclass says which variables and figures its results have, in `series` and `figures`;
    it may add to `sizes`, `notes`, `fixed` and `write_files`, and `prepare` a run. Its attributes:

    - `section`: the table, for pydantic; `table`: the checked one, complete;
    - `files`, `folders`: the keys that name data files, and folders with the files that are read there;
    - `is_checked_in_part`: whether the constructor is also called if keys are wrong, which the table
      does not have then, or if further files are missing, to find the other problems;
    - `keys`: the keys that make an argument of the model, where their names differ from its name;
    - `end`: the key for the last time of a run, where there is one;
    - `axis`: the name and the description of the saved times in the results;
    - `certified`: whether steps are chosen for a proved bound;
    - `verified`: whether `dvax.verify` checks the assumptions, besides the constants of the model;
    - `energy`: whether `dvax.verify` searches for a norm in which trajectories approach each other;
    - `remedy`: a sentence on what may make a bound smaller that certifies no digit;
    - `whole`: whether the figures need the solution at all saved times, which must fit into the memory;
    - `bound_words`, `bound_unit`, `bound_scale`: of the bound on the error, which is the scale times
      that of the state in the norm of the state space.
    """

    section: ClassVar[type[Section]]
    files: ClassVar[tuple[str, ...]] = ()
    folders: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    is_checked_in_part: ClassVar[bool] = False
    keys: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    end: ClassVar[str | None] = None
    table: Any
    own: Model
    t_end: float
    times: np.ndarray
    axis: ClassVar[tuple[str, str]] = ("time", "time")
    certified = True
    verified = True
    energy = False
    remedy = REMEDY
    whole = False
    bound_words = "bound on the error of the state in the norm of the state space"
    bound_unit = ""
    bound_scale = 1.0
    place_of_figures = "figures"

    @abc.abstractmethod
    def __init__(self, table: Any, paths: Mapping[str, Path], quiet: bool): ...

    @classmethod
    def further_files(cls, table: Any, paths: Mapping[str, Path]) -> Mapping[str, str]:
        """Return the names of data files besides those of `files`, by their dotted keys below
        `[model]`. **Raises:** `dvax.InputError`."""
        return {}

    @property
    def label(self) -> str:
        """What a title calls the model, if not by its name in the configuration."""
        return ""

    @property
    @abc.abstractmethod
    def fit(self) -> str:
        """Whether the model is in the class: "exact", by what it is regularised, or why it is not."""

    def set_model(
        self, model: Model, t_end: float | None = None, times: np.ndarray | None = None
    ) -> None:
        """Take the `model`, and run it until `t_end`, or as long as the model says; save `times`, or
        equally many frames as the table says.

        **Raises:** `dvax.InputError` if the run ends before it starts, or has no such steps.
        """
        self.own, self.per_row = model, PerRow()
        self.t_end = float(model.t_end if t_end is None else t_end)
        if not self.t_end > model.t0:
            raise input_error(
                "model.t_end", f"{self.t_end:g}", f"the run begins at {model.t0:g}",
                "Write a later time",
            )  # fmt: skip
        equal = times is None
        self.times = np.linspace(model.t0, self.t_end, self.table.frames + 1) if equal else times
        span = self.t_end - model.t0
        check_model_steps(self.table, span, f"{span:g} {model.time_unit}".rstrip())

    @abc.abstractmethod
    def series(self, solution: Any, bound: Certificate | None) -> Mapping[str, Variable]:
        """The variables over time, each row from that row of a solution alone, and the bounds."""

    @abc.abstractmethod
    def figures(
        self, series: Mapping[str, np.ndarray], end: Solution, bound: Certificate | None
    ) -> Mapping[str, Figure]:
        """The figures of the summary, from the series and from the last row of the solution `end`."""

    def fixed(self, end: Solution) -> Mapping[str, Variable]:
        """The variables without a time axis, such as places, and fields at the last row of `end`."""
        return {}

    def write_files(self, directory: Path, end: Solution) -> tuple[str, ...]:
        """Write further files into the run directory, from the last row of `end`, and return their
        names."""
        return ()

    def prepare(self, say: Say) -> Model:
        """Compute what a run needs before it is solved, and return the model, its initial state being
        known. **Raises:** `dvax.SolveError`."""
        return self.own

    def call(self, work: Callable[[], Any]) -> Any:
        """Return work(), which evaluates functions of the problem."""
        return work()

    def sizes(self) -> list[tuple[str, str, str]]:
        """Sizes besides those of states, responses and time."""
        return []

    def notes(self) -> tuple[str, ...]:
        """Sentences about input that is allowed but unusual."""
        return ()

    @property
    def settings(self) -> dict[str, Any]:
        """The method, steps and tolerances: keywords for `dvax.solve`."""
        return settings(self.table, **self.own.settings)

    @cached_property
    def verification(self) -> Any:
        """The result of `dvax.verify` for the problem."""
        m = self.own
        return self.call(
            lambda: verify(m.problem, m.x0, m.t0, self.t_end, m.args, energy=self.energy)
        )

    @property
    def constants(self) -> Constants | None:
        """Those of the model, or else those of `dvax.verify`."""
        return self.own.constants or self.verification.constants

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        return self.verification.assumptions if self.verified else ()

    def describe(self) -> Description:
        """Constants, assumptions, sizes and notes: what is known before anything is solved."""
        m = self.own
        count = sum(np.size(leaf) for leaf in jtu.tree_leaves(m.x0))
        law = sum(np.size(leaf) for leaf in jtu.tree_leaves(m.problem.zero_control(m.x0)))
        sizes = [
            ("states", str(count), ", ".join(m.states)),
            ("responses", str(law), ", ".join(m.responses)),
            *self.sizes(),
            (
                "time",
                f"{self.times[0]:g} to {self.times[-1]:g} {m.time_unit}".rstrip(),
                f"{len(self.times)} saved states",
            ),
        ]
        if self.settings.get("method") is None and self.settings.get("dt") is None:
            sizes.append(("method", *self._choice()))
        notes = (*self.notes(), *self._note_on_bound())
        return Description(self.constants, self.assumptions, sizes, notes)

    def _note_on_bound(self) -> tuple[str, ...]:
        """Return a sentence if errors of the size of the tolerance may grow to that of the solution."""
        if self.constants is None:
            return ()
        given = self.settings
        # The errors of fixed steps are not known before a run, and exact steps have those of rounding.
        is_rounding = given.get("dt") is not None or isinstance(
            given.get("method"), PiecewiseLinear
        )
        error = EPSILON if is_rounding else float(given.get("rtol", 1e-6))
        growth = log_growth(self.constants, self.t_end - self.own.t0)
        if growth + np.log(error) < 0 or not np.isfinite(growth):
            return ()
        digits = growth / np.log(10)
        factor = f"up to 1e{digits:.0f}" if digits <= 300 else "more than 1e300"
        return (
            f"By these constants an error may grow by a factor of {factor} over the run, so that the "
            f"error bound may certify no digit. {self.remedy}",
        )

    def _choice(self) -> tuple[str, str]:
        """Return the method that `dvax.solve` will choose, and the reason."""
        m, given = self.own, {"rtol": 1e-6, "atol": 1e-9} | self.settings
        found = choose(
            m.problem, m.x0, m.args, m.t0, self.t_end - m.t0, float(max(given["rtol"], given["atol"])),
            False, self.certified,
        )  # fmt: skip
        name, _, reason = str(found.text()).partition(": ")
        return name, reason

    def plan(self, say: Say) -> Plan:
        """What to integrate, all else being computed. **Raises:** `dvax.SolveError`."""
        m = self.own = self.prepare(say)
        times = self.times
        if len(times) > 1:
            say(f"solving from {times[0]:g} to {times[-1]:g} {m.time_unit}".rstrip())
        constants = self.constants if self.certified else None
        return Plan(
            m.problem, m.x0, times, constants, self.settings, m.time_unit, m.args
        )  # fmt: skip

    def bound(self, piece: Any, before: Certificate | None) -> Certificate | None:
        """The bound on the error of a piece of the run, which goes on from the one `before`."""
        if piece is None:
            return None
        found = self._bound(piece, before)
        if found is None:
            return None
        space = self.own.problem.spaces(self.own.x0)[0]
        size = float(np.max(self.per_row("norm", space.norm, piece.xs)))
        return found._replace(size=size if before is None else max(size, before.size))

    def _bound(self, piece: Any, before: Certificate | None) -> Certificate | None:
        if self.constants is None:
            return None
        return certificate(self.own.problem, piece, self.constants, before)

    def rows(self, piece: Any, bound: Certificate | None, count: int) -> dict[str, Variable]:
        """The variables over time at the first `count` rows of a piece: those that follow repeat the
        last, so that all pieces share one compiled program. It is None where there is one time alone.
        """
        name, words = self.axis
        if bound is not None:
            bound = bound._replace(values=self.bound_scale * bound.values)
        times = self.times if piece is None else np.asarray(piece.ts)
        found = {name: Variable((name,), times, self.own.time_unit, words)}
        found |= self.series(piece, bound)
        return {key: replace(v, values=np.asarray(v.values)[:count]) for key, v in found.items()}

    def results(
        self, series: Mapping[str, np.ndarray], end: Any, bound: Certificate | None = None
    ) -> Results:
        """The results after the last row of the piece `end`; `bound`: of the last piece, whose values
        those of the series replace."""
        if bound is not None:
            scaled = self.bound_scale * bound.size
            bound = bound._replace(values=series["error_bound"], size=scaled)
        figures, fixed = self.figures(series, end, bound), self.fixed(end)
        return Results(figures, fixed, lambda directory: self.write_files(directory, end))

    def bound_series(self, bound: Certificate | None) -> dict[str, Variable]:
        """The bound on the error over time, where there is one."""
        if bound is None:
            return {}
        return {"error_bound": bound.variable(self.axis[0], self.bound_unit, self.bound_words)}

    def bound_figure(self, bound: Certificate | None) -> dict[str, Figure]:
        """The largest bound on the error, where there is one."""
        return (
            {}
            if bound is None
            else {"error_bound": bound.figure(self.bound_unit, self.bound_words)}
        )

    def decay_figure(self, words: str) -> dict[str, Figure]:
        """The certified rate at which two `words`, such as states, approach."""
        constants, unit = self.constants, self.own.time_unit
        assert constants is not None  # a model that has this figure declares them
        said = f"two {words} certainly approach at this rate"
        return {"decay_rate": Figure(float(constants.sharp_decay_rate) + 0.0, f"1/{unit}", said)}

    def named(self, solution: Solution) -> dict[str, Variable]:
        """The states and responses by the names of the model."""
        found = {}
        for which, rows in (("states", solution.xs), ("responses", solution.us)):
            for name, (values, unit) in self.own.series(which, rows).items():
                key = store_name(name)
                dims = (self.axis[0], *(f"{key}_{k}" for k in range(values.ndim - 1)))
                found[key] = Variable(dims, values, unit, f"{which.removesuffix('s')} {name}")
        return found

    def final_values(self, end: Solution) -> dict[str, Figure]:
        """The last values of the states and responses that are numbers."""
        last = f"at t = {float(end.ts[-1]):g} {self.own.time_unit}".rstrip()
        numbers = [(key, v) for key, v in self.named(end).items() if v.values.ndim == 1]
        return {
            f"final_{key}": Figure(
                float(v.values[-1]), v.unit, f"{v.words.partition(' ')[2]} {last}"
            )
            for key, v in numbers[:FINAL_VALUES]
        }

    def joined(
        self, figures: Mapping[str, Figure], more: Mapping[str, Figure]
    ) -> dict[str, Figure]:
        """Return both. **Raises:** `dvax.InputError` if they share names."""
        taken = sorted(set(figures) & set(more))
        if taken:
            raise input_error(
                self.place_of_figures, ", ".join(taken), "these names are taken", "Choose others"
            )
        return {**figures, **more}


def store_name(name: str) -> str:
    """Return a name for a store, where a slash would begin a folder."""
    return name.replace("/", "∕")
