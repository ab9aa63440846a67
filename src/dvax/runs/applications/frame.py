"""`[model] name = "frame"`: a one-storey frame under a measured earthquake."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from dvax.models.frame import Accelerogram, Frame
from dvax.runs.applications.base import (
    AbstractApplication,
    Figure,
    Known,
    Results,
    Say,
    Variable,
)
from dvax.runs.applications.certificate import certificate
from dvax.runs.schema import Section, in_quantity


class FrameSection(Section):
    """The record and the frame."""

    name: Literal["frame"] = Field(description="the model")
    record: str = Field(description="an .at2 strong-motion record, in units of gravity")
    period: Annotated[float, in_quantity("time")] = Field(gt=0, description="natural period [s]")
    damping: float = Field(ge=0, description="of the critical damping")
    yield_ratio: float | None = Field(
        None, gt=0, description="yield force over the largest elastic force; without it: elastic"
    )
    viscosity_ratio: Annotated[float, in_quantity("time")] | None = Field(
        None,
        gt=0,
        description="viscosity over stiffness, eta/k [s], of a frame that yields; "
        "elastoplastic as it goes to 0",
    )
    rtol: float = Field(1e-8, gt=0, lt=1, description="relative tolerance of a step")


class _Loaded:
    def __init__(self, table: FrameSection, file: Path):
        self.table = table
        self.frame = Frame(
            record=Accelerogram.from_at2(file), period=table.period, damping=table.damping,
            yield_ratio=table.yield_ratio, viscosity_ratio=table.viscosity_ratio,
        )  # fmt: skip


class FrameApplication(AbstractApplication[_Loaded]):
    """Displacements, the force of the spring, and the ground."""

    section = FrameSection
    files = ("record",)
    keys: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "step": ("record",), "acceleration": ("record",),
    }  # fmt: skip

    def read(self, table: Any, paths: Mapping[str, Path]) -> _Loaded:
        return _Loaded(table, paths["record"])

    def fit(self, model: _Loaded) -> str:
        return model.frame.fit

    def known(self, model: _Loaded) -> Known:
        record = model.frame.record
        count, long = record.samples.shape[0], record.duration
        sizes = [("record", f"{count} samples", f"{record.step:g} s apart, {long:g} s in all")]
        period, notes = model.table.period, ()
        # Two samples a period are the least that show an oscillation.
        if period < 2.0 * record.step:
            notes = (
                f"model.period is {period:g} s and samples of the record are {record.step:g} s apart: "
                "what would shake a frame at this period is not in the record.",
            )
        return Known(model.frame.constants, (), sizes, notes)

    def solve(self, model: _Loaded, say: Say) -> Results:
        frame, table = model.frame, model.table
        constants = frame.constants
        say("solving over the record")
        solution = frame.solve(rtol=table.rtol, constants=constants)
        say("bounding the error")
        bound = certificate(frame.problem, solution, constants)
        between = (len(solution.ts) - 1) // (frame.record.samples.shape[0] - 1)
        d, v, plastic = np.asarray(solution.xs).T
        ts = np.asarray(solution.ts)
        omega = float(frame.omega)
        ground = np.interp(ts, np.asarray(frame.record.knots()), np.asarray(frame.record.samples))
        time = ("time",)
        variables = {
            "time": Variable(time, ts, "s", "time"),
            "ground": Variable(time, ground, "in/s^2", "ground acceleration"),
            "displacement": Variable(time, d, "in", "displacement against the ground"),
            "velocity": Variable(time, v, "in/s", "velocity against the ground"),
            "plastic": Variable(time, plastic, "in", "plastic displacement"),
            "spring": Variable(
                time, omega**2 * (d - plastic), "in/s^2", "force of the spring a mass"
            ),
            "error_bound": Variable(
                time, bound.values / omega, "in", "bound on the error of the displacement"
            ),
        }
        peak = float(np.max(np.abs(d[::between])))
        figures = {
            "peak_displacement": Figure(peak, "in", "largest displacement at the times of the record"),
            "largest_displacement": Figure(
                float(frame.largest_displacement(solution)), "in", "largest displacement at all times"
            ),
            "residual_displacement": Figure(float(plastic[-1]), "in", "plastic part of it at the end"),
            "error_bound": Figure(
                bound.largest / omega, "in",
                f"bound on the error of the displacement ({bound.status})",
            ),
        }  # fmt: skip
        limit = float(frame.yield_displacement)
        if np.isfinite(limit):
            figures["yield_displacement"] = Figure(limit, "in", "displacement at which it yields")
            figures["elastoplastic_distance"] = Figure(
                float(np.max(np.asarray(frame.elastoplastic_distance(solution)))), "in",
                "bound on how far the displacement is from that of the elastoplastic frame, eta/k = 0",
            )  # fmt: skip
            figures["ductility"] = Figure(peak / limit, "1", "peak over yield displacement")
        return Results(figures, variables, constants, int(solution.stats["steps"]))


APPLICATION = FrameApplication()
