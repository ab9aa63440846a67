"""A run of an application, in segments of its saved times."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from dvax.app.runs.applications.base import Figure, Plan, Results, Variable
from dvax.app.runs.applications.config import ModelConfig
from dvax.app.runs.applications.segments import (
    end_of,
    from_checkpoint,
    join_pieces,
    segment_length,
    segments,
    states_only,
    to_checkpoint,
)
from dvax.app.runs.interrupt import Work, interruptible, patience
from dvax.app.runs.run import AbstractRun, Facts, Listener
from dvax.app.runs.rundir import consolidate, new_store, replace_store
from dvax.evolution import Solution
from dvax.theory import Constants


class ApplicationRun(AbstractRun):
    """The plan, the pieces that are solved, and the results of them."""

    config: ModelConfig

    def __init__(self, config: ModelConfig, tell: Listener):
        super().__init__(config, tell)
        self.model, self.wording = config.model, config.wording
        known = self.model.describe()
        title = self.model.own.title or f"{config.name}, {config.source.stem}"
        about = {"model": config.name, "title": title, "fit": self.model.fit}
        rows = constant_rows(known.constants)
        self.facts = Facts(rows, known.assumptions, config.fingerprints(), known.notes, about)
        self.plan: Plan | None = None
        self.pieces: list[Solution] = []
        self.complete = 0
        self.last: Work[Results] | None = None
        self.results: Results | None = None

    def begin(self) -> None:
        # Results are written when there are any. Each checkpoint is a piece of the solution.
        whole = [c for k, c in enumerate(self.saved) if c.number == k]
        self.saved, self.kept = whole, len(whole)

    def solve(self) -> None:
        plan = self.plan = interruptible(lambda: self.model.plan(self._stage))
        # One piece is solved at least: the others are made like it.
        count = -(-len(plan.times) // segment_length(plan))
        saved = self.saved[: count - 1]
        x, step = end_of(saved[-1], plan) if saved else (None, None)
        if saved:
            self.tell_resumed(
                float(plan.times[len(saved) * segment_length(plan) - 1]), plan.time_unit
            )
        for piece in segments(plan, len(saved), x, step):
            if not self.pieces:
                self.pieces = [from_checkpoint(c, piece, plan) for c in saved]
                self.steps = sum(int(one.stats["steps"]) for one in self.pieces)
            self.pieces.append(piece)
            begin = (len(self.pieces) - 1) * segment_length(plan)
            # The piece in which a solve failed has fewer rows, and no run can resume after it.
            if len(piece.ts) == len(plan.times[begin : begin + segment_length(plan)]):
                self.complete = len(self.pieces)
            if len(self.pieces) == len(saved) + 1:
                # Compile all programs of the figures now, so that they need no time after an interrupt.
                self.last = Work(self._compute(plan))
                self.last.result()
                self.last = None
                self.event("compiled", compile_seconds=self.compiling())
            self.steps += int(piece.stats["steps"])
            self.method = str(piece.stats["method"])
            begin, t = float(plan.times[0]), float(piece.ts[-1])
            self.event(
                "progress", t=t - begin, t_end=float(plan.times[-1]) - begin, steps=self.steps,
                method=self.method, unit=plan.time_unit,
            )  # fmt: skip
            if self.checkpoints.is_due():
                self.try_checkpoint()
        self._stage("writing the results")
        self.last = Work(self._compute(plan))
        self.results = self.last.result()

    def checkpoint(self) -> None:
        if self.plan is None:
            return
        fixed = self.plan.settings.get("dt") is not None
        for number in range(self.kept, self.complete):
            piece = self.pieces[number]
            arrays, about = to_checkpoint(piece)
            next_dt = None if fixed else float(piece.stats["next_dt"])
            self.checkpoints.save(number, arrays, about | {"next_dt": next_dt})
            self.kept = number + 1

    def reached(self) -> str:
        if self.plan is None or not self.pieces:
            return " before there were results"
        unit, end = f" {self.plan.time_unit}".rstrip(), float(self.plan.times[-1])
        t = float(self.pieces[-1].ts[-1])
        return f" at t = {t:.10g} of {end:.10g}{unit}; what was saved is kept"

    def gather(self) -> str:
        if self.results is not None or self.plan is None or not self.pieces:
            return ""
        try:
            work = self.last or Work(self._compute(self.plan))
            self.results = work.result(patience())
        except (KeyboardInterrupt, TimeoutError):
            self.results = states_only(self.pieces)
            return "Its states alone were kept: there was no time for figures."
        except Exception as error:  # noqa: BLE001 (of the user's figures, say; the reason names it)
            self.results = states_only(self.pieces)
            reason = f"{type(error).__name__}: {error}"
            return f"Its states alone were kept: the figures failed with {reason}"
        return ""

    def write(self) -> tuple[Mapping[str, Figure], bool]:
        results = self.results
        if results is None:
            return {}, False
        self.steps = results.steps
        self.facts = replace(self.facts, assumptions=results.assumptions or self.facts.assumptions)
        if results.constants is not None:
            self.facts = replace(self.facts, rows=constant_rows(results.constants))
        for notice in results.notices:
            self.event("warning", message=notice)
        attrs = {"title": self.facts.model["title"], "model": self.config.name}
        write_dataset(self.directory.path / "trajectory.zarr", results.variables, attrs)
        if results.files is not None:
            names = list(results.files(self.directory.path))
            self.facts = replace(self.facts, model={**self.facts.model, "files": names})
        return results.figures, True

    def _compute(self, plan: Plan) -> Callable[[], Results]:
        """Return a function that computes the results of the pieces so far."""
        pieces = list(self.pieces)

        def compute() -> Results:
            every = len(plan.times)
            count = sum(len(piece.ts) for piece in pieces) if pieces else every
            solution = join_pieces(pieces, every) if pieces else None
            return self.model.results(plan, solution, count)

        return compute

    def _stage(self, words: str) -> None:
        self.event("stage", stage=words)


_ORDER = "variable_order"


def constant_rows(constants: Constants | None) -> list[dict[str, Any]]:
    """The table of constants; an application's units are those of its own description."""
    if constants is None:
        return []
    return [{**row._asdict(), "unit": ""} for row in constants.table()]


def write_dataset(path: Path, variables: Mapping[str, Variable], attrs: Mapping[str, Any]) -> None:
    """Write a zarr group that xarray opens as a Dataset."""
    coordinates = [name for name, v in variables.items() if v.dims == (name,)]
    # A store lists its arrays in no order.
    order = " ".join(variables)
    attributes = {**attrs, "coordinates": " ".join(coordinates), _ORDER: order}
    new = new_store(path)
    group = zarr.open_group(new, mode="w-", zarr_format=3, attributes=attributes)
    for name, v in variables.items():
        about: dict[str, Any] = {"long_name": v.words, "units": v.unit}
        if v.status:
            about["status"] = v.status
        values = np.asarray(v.values)
        group.create_array(name, data=values, dimension_names=v.dims, attributes=about)
    consolidate(new)
    replace_store(new, path)
