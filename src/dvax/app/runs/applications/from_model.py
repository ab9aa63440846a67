"""Applications whose problem is a `dvax.models.Model`: states and responses over time, by name."""

import abc
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import jax.tree_util as jtu
import numpy as np
from pydantic import Field

from dvax.app.runs.applications.base import (
    AbstractApplication,
    Description,
    Figure,
    Plan,
    Results,
    Say,
    Variable,
)
from dvax.app.runs.applications.certificate import Certificate, certificate
from dvax.app.runs.schema import SolverKeys
from dvax.app.runs.solver_options import check_model_steps, settings
from dvax.errors import input_error
from dvax.evolution import Solution
from dvax.evolution.auto import choose
from dvax.models import Model
from dvax.theory import Constants, verify

_FIGURES = 12
"""Up to this many final values are figures of the summary."""


class FramesKeys(SolverKeys):
    """How many states of a run are saved."""

    frames: int = Field(200, ge=1, le=10**6, description="number of intervals between saved states")


class AbstractModelApplication(AbstractApplication):
    """An application that is complete when its constructor has called `set_model`.

    A subclass adds its own sizes, notes, figures and series in `sizes`, `notes` and `further`.
    """

    table: Any
    own: Model
    t_end: float
    certified = True
    """Whether steps are chosen for a proved bound."""
    bound_words = "bound on the error of the state in the norm of the state space"
    bound_unit = ""
    place_of_figures = "figures"

    def set_model(self, model: Model, t_end: float | None) -> None:
        """Take the `model`, and run it until `t_end`, or as long as the model says.

        **Raises:** `dvax.InputError` if the run ends before it starts, or has no such steps.
        """
        self.own, self.title = model, model.title
        self.t_end = float(model.t_end if t_end is None else t_end)
        if not self.t_end > model.t0:
            raise input_error(
                "model.t_end", f"{self.t_end:g}", f"the run begins at {model.t0:g}",
                "Write a later time",
            )  # fmt: skip
        span = self.t_end - model.t0
        check_model_steps(self.table, span, f"{span:g} {model.time_unit}")

    @abc.abstractmethod
    def further(
        self, solution: Solution, bound: Certificate | None
    ) -> tuple[Mapping[str, Variable], Mapping[str, Figure]]:
        """Series and figures besides those of the names of the model.

        The solution has all rows of the plan, and the results keep those that were reached."""

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
        return settings(self.table, **self.own.settings)

    @cached_property
    def verification(self) -> Any:
        """The result of `dvax.verify` for the problem."""
        m = self.own
        return self.call(lambda: verify(m.problem, m.x0, m.t0, self.t_end, m.args))

    @property
    def constants(self) -> Constants | None:
        """Those of the model, or else those of `dvax.verify`."""
        return self.own.constants or self.verification.constants

    def describe(self) -> Description:
        m = self.own
        count = sum(np.size(leaf) for leaf in jtu.tree_leaves(m.x0))
        law = sum(np.size(leaf) for leaf in jtu.tree_leaves(m.problem.zero_control(m.x0)))
        sizes = [
            ("states", str(count), ", ".join(m.states)),
            ("responses", str(law), ", ".join(m.responses)),
            *self.sizes(),
            (
                "time",
                f"{m.t0:g} to {self.t_end:g} {m.time_unit}",
                f"{self.table.frames + 1} saved states",
            ),
        ]
        if self.settings.get("method") is None and self.settings.get("dt") is None:
            sizes.append(("method", *self._choice()))
        return Description(self.constants, self.verification.assumptions, sizes, self.notes())

    def _choice(self) -> tuple[str, str]:
        """Return the method that `dvax.solve` will choose, and the reason."""
        m, given = self.own, {"rtol": 1e-6, "atol": 1e-9} | self.settings
        found = choose(
            m.problem, m.x0, m.args, self.t_end - m.t0, float(max(given["rtol"], given["atol"])), False,
            self.certified,
        )  # fmt: skip
        name, _, reason = str(found.text()).partition(": ")
        return name, reason

    def plan(self, say: Say) -> Plan:
        m = self.own
        say(f"solving from {m.t0:g} to {self.t_end:g} {m.time_unit}".rstrip())
        times = np.linspace(m.t0, self.t_end, self.table.frames + 1)
        constants = self.constants if self.certified else None
        return Plan(
            m.problem, m.x0, times, constants, self.settings, None, m.time_unit, m.args
        )  # fmt: skip

    def results(self, plan: Plan, solution: Solution, count: int) -> Results:
        m, times = self.own, np.asarray(solution.ts)[:count]
        variables = {"time": Variable(("time",), times, m.time_unit, "time")}
        figures: dict[str, Figure] = {}
        last = f"at t = {times[-1]:g} {m.time_unit}".rstrip()
        for which, rows in (("states", solution.xs), ("responses", solution.us)):
            for name, (values, unit) in m.series(which, rows).items():
                key, values = name.replace("/", "∕"), values[:count]
                dims = ("time", *(f"{key}_{k}" for k in range(values.ndim - 1)))
                variables[key] = Variable(dims, values, unit, f"{which.removesuffix('s')} {name}")
                if values.ndim == 1 and len(figures) < _FIGURES:
                    figures[f"final_{key}"] = Figure(float(values[-1]), unit, f"{name} {last}")
        bound = self._bound(solution, count)
        if bound is not None:
            words, unit = self.bound_words, self.bound_unit
            variables["error_bound"] = bound.variable("time", unit, words)
            figures["error_bound"] = bound.figure(unit, words)
        series, more = self.further(solution, bound)
        for name, v in series.items():
            over_time = v.dims[:1] == ("time",)
            variables[name] = Variable(
                v.dims, v.values[:count] if over_time else v.values, v.unit, v.words
            )
        return Results(
            variables=variables, figures=self._merged(figures, more), constants=self.constants,
            steps=int(solution.stats["steps"]), assumptions=self.verification.assumptions,
        )  # fmt: skip

    def _merged(
        self, figures: Mapping[str, Figure], more: Mapping[str, Figure]
    ) -> Mapping[str, Figure]:
        taken = sorted(set(figures) & set(more))
        if taken:
            raise input_error(
                self.place_of_figures, ", ".join(taken), "these names are taken", "Choose others"
            )
        return {**figures, **more}

    def _bound(self, solution: Solution, count: int) -> Certificate | None:
        constants = self.constants
        if constants is None or solution.defect is None:
            return None
        return certificate(self.own.problem, solution, constants, count)
