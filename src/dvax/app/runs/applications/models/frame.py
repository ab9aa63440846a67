"""`[model] name = "frame"`: a one-storey frame under a measured earthquake."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
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
from dvax.app.runs.applications.certificate import certificate
from dvax.app.runs.schema import SolverKeys, in_quantity
from dvax.app.runs.solver_options import check_model_steps, event_driven, settings
from dvax.evolution import ExpRosenbrock, PiecewiseLinear, Solution
from dvax.models.frame import Accelerogram, Frame
from dvax.models.frame.peaks import peak_displacement

_INCH = 0.0254
"""Metres in an inch, exactly."""


_peak_displacement = jax.jit(peak_displacement)


class FrameSection(SolverKeys):
    """The record and the frame."""

    name: Literal["frame"] = Field(description="the model")
    record: str = Field(description="an .at2 strong-motion record, in units of gravity")
    period: Annotated[float, in_quantity("time")] = Field(
        gt=0, le=1e6, description="natural period [s]"
    )
    damping: float = Field(ge=0, le=1e6, description="of the critical damping")
    yield_ratio: float | None = Field(
        None, gt=0, description="yield force over the largest elastic force; without it: elastic"
    )
    viscosity_ratio: Annotated[float, in_quantity("time")] | None = Field(
        None,
        gt=0,
        description="viscosity over stiffness, eta/k [s], of a frame that yields; "
        "elastoplastic as it goes to 0",
    )


class FrameApplication(AbstractApplication):
    """Displacements, the force of the spring, and the ground."""

    section = FrameSection
    files = ("record",)
    keys: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "step": ("record",), "acceleration": ("record",),
    }  # fmt: skip

    def __init__(self, table: FrameSection, paths: Mapping[str, Path], quiet: bool):
        self.table = table
        self.frame = Frame(
            record=Accelerogram.from_at2(paths["record"]), period=table.period, damping=table.damping,
            yield_ratio=table.yield_ratio, viscosity_ratio=table.viscosity_ratio,
        )  # fmt: skip
        long = float(self.frame.record.duration)
        check_model_steps(table, long, f"{long:g} s")

    @property
    def fit(self) -> str:
        return self.frame.fit

    def describe(self) -> Description:
        record = self.frame.record
        count, long = record.samples.shape[0], record.duration
        sizes = [("record", f"{count} samples", f"{record.step:g} s apart, {long:g} s in all")]
        period, notes = self.table.period, ()
        # An oscillation needs at least two samples a period (Nyquist).
        if period < 2.0 * record.step:
            notes = (
                f"model.period is {period:g} s and samples of the record are {record.step:g} s apart: "
                "what would shake a frame at this period is not in the record.",
            )
        return Description(self.frame.constants, (), sizes, notes)

    @property
    def settings(self) -> dict[str, Any]:
        method = PiecewiseLinear() if event_driven(self.table) else ExpRosenbrock()
        return settings(self.table, method=method, rtol=1e-8)

    def plan(self, say: Say) -> Plan:
        frame = self.frame
        say("solving over the record")
        return Plan(
            frame.problem, jnp.zeros(3), frame.times, frame.constants, self.settings, None, "s"
        )  # fmt: skip

    def results(self, plan: Plan, solution: Solution, count: int) -> Results:
        frame, constants = self.frame, self.frame.constants
        bound = certificate(frame.problem, solution, constants, count)
        between = (len(plan.times) - 1) // (frame.record.samples.shape[0] - 1)
        d, v, plastic = np.asarray(solution.xs)[:count].T
        ts = np.asarray(solution.ts)[:count]
        omega = float(frame.omega)
        ground = np.interp(ts, np.asarray(frame.record.knots()), np.asarray(frame.record.samples))
        time, error = ("time",), bound.values / omega
        spring = omega**2 * (d - plastic)
        variables = {"time": Variable(time, ts, "s", "time")}
        for name, values, unit, words in (
            ("ground", ground, "in/s^2", "ground acceleration"),
            ("displacement", d, "in", "displacement against the ground"),
            ("velocity", v, "in/s", "velocity against the ground"),
            ("plastic", plastic, "in", "plastic displacement"),
            ("spring", spring, "in/s^2", "force of the spring a mass"),
            ("error_bound", error, "in", "bound on the error of the displacement"),
        ):
            status = bound.status if name == "error_bound" else ""
            variables[name] = Variable(time, values, unit, words, status)
            metres = unit.replace("in", "m")
            si = Variable(time, _INCH * values, metres, f"{words}, in SI units", status)
            variables[f"{name}_si"] = si
        peak = float(np.max(np.abs(d[::between])))
        a = -2.0 * float(frame.damping) * omega * v - spring - ground
        apart = frame.record.step / between
        # Rows that were not reached repeat the last displacement with zero velocity.
        behind = len(plan.times) - count
        moves = np.pad(d, (0, behind), "edge"), np.pad(v, (0, behind)), np.pad(a, (0, behind))
        top = float(_peak_displacement(*map(jnp.asarray, moves), apart))
        largest = bound.largest
        # The bound holds for every displacement, hence for their peaks.
        proved = bound.proved(1.0 / omega)
        within, last = (None, None) if proved is None else (float(proved.max()), float(proved[-1]))
        lengths = {
            "peak_displacement": (peak, within, "largest displacement at the times of the record"),
            "largest_displacement": (
                top, None, "largest displacement at all times"
            ),
            "residual_displacement": (float(plastic[-1]), last, "plastic part of it at the end"),
            "error_bound": (
                None if largest is None else largest / omega, None,
                f"bound on the error of the displacement ({bound.status})",
            ),
        }  # fmt: skip
        limit = float(frame.yield_displacement)
        if np.isfinite(limit):
            lengths["yield_displacement"] = (limit, None, "displacement at which it yields")
            lengths["elastoplastic_distance"] = (
                float(np.max(np.asarray(frame.elastoplastic_distance(solution)))), None,
                "bound on how far the displacement is from that of the elastoplastic frame, eta/k = 0 "
                "(estimated, from the velocities that were computed)",
            )  # fmt: skip
        bounds = {"error_bound": bound.status, "elastoplastic_distance": "estimated"}
        figures = {
            n: Figure(value, "in", words, e, bounds.get(n))
            for n, (value, e, words) in lengths.items()
        }
        if np.isfinite(limit):
            figures["ductility"] = Figure(peak / limit, "1", "peak over yield displacement")
        figures |= {
            f"{name}_si": Figure(
                None if value is None else _INCH * value, "m", f"{words}, in SI units",
                None if error is None else _INCH * error, bounds.get(name),
            )
            for name, (value, error, words) in lengths.items()
        }  # fmt: skip
        return Results(figures, variables, constants, int(solution.stats["steps"]))


APPLICATION = FrameApplication
