"""`[model] name = "frame"`: a one-storey frame under a measured earthquake."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

from dvax.app.runs.applications.base import Figure, Variable
from dvax.app.runs.applications.certificate import Certificate
from dvax.app.runs.applications.from_model import AbstractModelApplication
from dvax.app.runs.schema import SolverKeys, in_quantity
from dvax.app.runs.solver_options import event_driven
from dvax.evolution import ExpRosenbrock, PiecewiseLinear, Solution
from dvax.models import Model
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


class FrameApplication(AbstractModelApplication):
    """Displacements, the force of the spring, and the ground."""

    section = FrameSection
    files = ("record",)
    keys: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "step": ("record",), "acceleration": ("record",),
    }  # fmt: skip
    verified = False
    bound_words = "bound on the error of the displacement"
    bound_unit = "in"

    def __init__(self, table: FrameSection, paths: Mapping[str, Path], quiet: bool):
        self.table = table
        frame = self.frame = Frame(
            record=Accelerogram.from_at2(paths["record"]), period=table.period, damping=table.damping,
            yield_ratio=table.yield_ratio, viscosity_ratio=table.viscosity_ratio,
        )  # fmt: skip
        self.omega = float(frame.omega)
        self.bound_scale = 1.0 / self.omega
        method = PiecewiseLinear() if event_driven(table) else ExpRosenbrock()
        model = Model(
            frame.problem, jnp.zeros(3), float(frame.times[-1]), constants=frame.constants,
            states={"displacement": "in", "velocity": "in/s", "plastic": "in"},
            settings={"method": method, "rtol": 1e-8},
        )  # fmt: skip
        self.set_model(model, times=frame.times)
        # Saved intervals in one of the record.
        self.between = (len(self.times) - 1) // (frame.record.samples.shape[0] - 1)

    @property
    def fit(self) -> str:
        return self.frame.fit

    def sizes(self) -> list[tuple[str, str, str]]:
        record = self.frame.record
        words = f"{record.step:g} s apart, {record.duration:g} s in all"
        return [("record", f"{record.samples.shape[0]} samples", words)]

    def notes(self) -> tuple[str, ...]:
        period, step = self.table.period, self.frame.record.step
        # An oscillation needs at least two samples a period (Nyquist).
        if period >= 2.0 * step:
            return ()
        return (
            f"model.period is {period:g} s and samples of the record are {step:g} s apart: "
            "what would shake a frame at this period is not in the record.",
        )

    def series(self, solution: Solution, bound: Certificate | None) -> Mapping[str, Variable]:
        record = self.frame.record
        d, v, plastic = np.asarray(solution.xs).T
        ts = np.asarray(solution.ts)
        ground = np.asarray(np.interp(ts, record.knots(), record.samples))
        spring = self.omega**2 * (d - plastic)
        time = ("time",)
        found = {
            "ground": Variable(time, ground, "in/s^2", "ground acceleration"),
            "displacement": Variable(time, d, "in", "displacement against the ground"),
            "velocity": Variable(time, v, "in/s", "velocity against the ground"),
            "plastic": Variable(time, plastic, "in", "plastic displacement"),
            "spring": Variable(time, spring, "in/s^2", "force of the spring a mass"),
            **self.bound_series(bound),
        }
        both = {}
        for name, one in found.items():
            si = f"{one.words}, in SI units"
            metres = one.unit.replace("in", "m")
            both[name] = one
            both[f"{name}_si"] = Variable(time, _INCH * one.values, metres, si, one.status)
        return both

    def figures(
        self, series: Mapping[str, np.ndarray], end: Solution, bound: Certificate | None
    ) -> Mapping[str, Figure]:
        frame, omega = self.frame, self.omega
        ts, d, v = (series[name] for name in ("time", "displacement", "velocity"))
        peak = float(np.max(np.abs(d[:: self.between])))
        a = -2.0 * float(frame.damping) * omega * v - series["spring"] - series["ground"]
        # Rows that were not reached repeat the last displacement with zero velocity, so that one
        # compiled program serves all partial results.
        behind = (0, len(self.times) - len(ts))
        ts, d, v, a = (
            jnp.asarray(np.pad(rows, behind, "edge" if repeats else "constant"))
            for rows, repeats in ((ts, True), (d, True), (v, False), (a, False))
        )
        top = float(_peak_displacement(d, v, a, frame.record.step / self.between))
        # The bound holds for every displacement, hence for their peaks.
        proved = None if bound is None else bound.proved()
        within, last = (None, None) if proved is None else (float(proved.max()), float(proved[-1]))
        plastic = float(series["plastic"][-1])
        lengths = {
            "peak_displacement": Figure(
                peak, "in", "largest displacement at the times of the record", within
            ),
            "largest_displacement": Figure(top, "in", "largest displacement at all times"),
            "residual_displacement": Figure(plastic, "in", "plastic part of it at the end", last),
            **self.bound_figure(bound),
        }
        ratios = {}
        limit = float(frame.yield_displacement)
        if np.isfinite(limit):
            apart = float(np.max(np.asarray(frame.distance_bound(ts, v))))
            lengths |= {
                "yield_displacement": Figure(limit, "in", "displacement at which it yields"),
                "elastoplastic_distance": Figure(
                    apart, "in",
                    "bound on how far the displacement is from that of the elastoplastic frame, "
                    "eta/k = 0 (estimated, from the velocities that were computed)",
                    bound="estimated",
                ),
            }  # fmt: skip
            ratios["ductility"] = Figure(peak / limit, "1", "peak over yield displacement")
        metres = {
            f"{name}_si": Figure(
                _in_metres(f.value), "m", f"{f.meaning}, in SI units", _in_metres(f.error), f.bound
            )
            for name, f in lengths.items()
        }
        return {**lengths, **ratios, **metres}


def _in_metres(inches: float | None) -> float | None:
    return None if inches is None else _INCH * inches


APPLICATION = FrameApplication
