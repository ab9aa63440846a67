"""`[model] name = "fem-contact"`: a punch pressed into a Kelvin–Voigt body."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from dvax.app.runs.applications.base import Figure, Say, Variable
from dvax.app.runs.applications.certificate import Certificate
from dvax.app.runs.applications.from_model import AbstractModelApplication
from dvax.app.runs.schema import SolverKeys
from dvax.app.runs.solver_options import check_model_steps
from dvax.errors import InputError, input_error
from dvax.evolution import Solution
from dvax.models import Model
from dvax.models.fem_contact import ElasticBody, FemContact

_NOTABLE_INDENTATION = 0.1
"""Indentations above this part of a size of the body or of the punch are noted."""

_SIZES = ("width", "height", "fine_half_width", "fine", "coarse", "layers", "growth")


class FemContactSection(SolverKeys):
    """The body, the punch and the compliance of the contact, in units of your choice."""

    name: Literal["fem-contact"] = Field(description="the model")
    mesh: str | None = Field(None, description="a mesh file; without it a block of the sizes below")
    width: float | None = Field(None, gt=0, description="width of the block")
    height: float | None = Field(None, gt=0, description="height of the block")
    fine_half_width: float | None = Field(None, gt=0, description="half width of the fine zone")
    fine: int | None = Field(None, ge=1, description="columns of elements a side in the fine zone")
    coarse: int | None = Field(None, ge=1, description="columns a side outside of it")
    layers: int | None = Field(None, ge=1, description="layers of elements")
    growth: float | None = Field(None, gt=0, description="ratio of heights of successive layers")
    contact: str | None = Field(
        None, description='what the mesh file calls the contact boundary, "contact" if not given'
    )
    clamped: str | None = Field(
        None, description='what the mesh file calls the held boundary, "clamped" if not given'
    )
    indentation: float = Field(0.01, gt=0, description="depth to which the punch is pressed")
    stiffness: float = Field(100.0, gt=0, description="pressure per penetration, beta")
    pressure_cap: float | None = Field(
        None, gt=0, description="largest pressure, kappa0; without it there is none"
    )
    radius: float = Field(10.0, gt=0, description="radius of the punch")
    youngs_modulus: float = Field(1.0, gt=0, description="of the body")
    poisson_ratio: float = Field(0.3, gt=-1, lt=0.5, description="of the body")
    relaxation_time: float = Field(1.0, gt=0, description="viscosity over elasticity")
    ramp: float = Field(2.0, gt=0, description="time over which the punch is pressed in")
    end: float = Field(12.0, gt=0, description="end of the run")
    frames: int = Field(120, ge=1, le=10**6, description="number of intervals between saved states")


class FemContactApplication(AbstractModelApplication):
    """The pressure over time, its limit at rest, and the fields at the end for ParaView."""

    section = FemContactSection
    files = ("mesh",)
    end = "model.end"
    verified = False
    bound_words = "bound on the error of the state in the norm of the viscosity"
    bound_unit = "([p][x]²)^(1/2)"

    def __init__(self, table: FemContactSection, paths: Mapping[str, Path], quiet: bool):
        file = paths.get("mesh")
        self.table = table
        # Before a mesh is assembled, which takes seconds.
        check_model_steps(table, table.end, f"the length {table.end:g}")
        sizes = _given(table, _SIZES)
        names = _given(table, ("contact", "clamped"))
        if file is not None and sizes:
            raise _refused(
                ("mesh", *sizes), f"mesh together with {', '.join(sizes)}",
                "a mesh comes from a file or is made from sizes, not both",
                "Keep mesh, or keep the sizes",
            )  # fmt: skip
        if file is None and names:
            raise _refused(
                tuple(names), ", ".join(map(repr, names.values())),
                "it is what a mesh file calls a boundary, and there is no mesh: the block is touched "
                "at its top and held at its bottom",
                'Leave it out, or add mesh = "..."',
            )  # fmt: skip
        self.body = ElasticBody(
            file if file is not None else sizes,
            youngs_modulus=table.youngs_modulus, poisson_ratio=table.poisson_ratio,
            **names,
        )  # fmt: skip
        self.height = float(np.ptp(self.body.nodes[:, 1]))
        if table.indentation >= self.height:
            raise _refused(
                ("indentation",), f"{table.indentation:g}",
                f"the body is {self.height:g} high, and displacements are small against that",
                f"Press the punch in by {0.01 * self.height:g}, say, or check the unit",
            )  # fmt: skip
        self.contact = FemContact(
            self.body, indentation=table.indentation, stiffness=table.stiffness,
            pressure_cap=np.inf if table.pressure_cap is None else table.pressure_cap,
            radius=table.radius, relaxation_time=table.relaxation_time, ramp=table.ramp,
        )  # fmt: skip
        m = self.contact
        model = Model(
            m.problem, m.untouched, table.end, time_unit="[t]", constants=m.constants,
            settings={"method": m.method, "rtol": 1e-7, "atol": 1e-11},
        )  # fmt: skip
        self.set_model(model)
        self.along = np.argsort(m.body.points[:, 0])

    @property
    def fit(self) -> str:
        return self.contact.fit

    def sizes(self) -> list[tuple[str, str, str]]:
        body = self.body
        return [
            ("displacements", str(body.unknowns), "free ones, of quadratic elements"),
            ("contact points", str(len(body.points)), "Gauss points of the contact boundary"),
        ]

    def notes(self) -> tuple[str, ...]:
        return _notes(self)

    def prepare(self, say: Say) -> Model:
        say("solving at rest")
        self.rest = self.contact.equilibrium()
        return self.own

    def series(self, solution: Solution, bound: Certificate | None) -> Mapping[str, Variable]:
        m = self.contact
        pressure = self.per_row("pressure", m.pressure, solution.ts, solution.xs)
        force = np.array([m.figures(p)["force"] for p in pressure])
        time, both = ("time",), ("time", "place")
        return {
            "force": Variable(time, force, "[p][x]", "force on the punch"),
            "pressure": Variable(both, pressure[:, self.along], "[p]", "contact pressure"),
            **self.bound_series(_known(bound)),
        }

    def fixed(self, end: Solution) -> Mapping[str, Variable]:
        m, t, x = self.contact, end.ts[-1], end.xs[-1]
        nodes, rest = m.body.nodes, np.asarray(self.rest.pressure)[self.along]
        place, two = ("place",), ("node", "axis")
        stress, words = m.stress(t, x), "xx, yy, zz, xy at the end"
        return {
            "place": Variable(place, m.body.points[self.along, 0], "[x]", "contact points"),
            "pressure_at_rest": Variable(place, rest, "[p]", "contact pressure at rest"),
            "nodes": Variable(two, nodes, "[x]", "nodes"),
            "deformed": Variable(two, nodes + m.displacement(x), "[x]", "nodes at the end"),
            "cells": Variable(("cell", "corner"), m.body.cells(), "1", "nodes of each element"),
            "stress": Variable(("cell", "component"), stress, "[p]", words),
        }

    def figures(
        self, series: Mapping[str, np.ndarray], end: Solution, bound: Certificate | None
    ) -> Mapping[str, Figure]:
        m, rest = self.contact, self.rest
        pressure = self.per_row("pressure", m.pressure, end.ts, end.xs)[-1]
        still, last = m.figures(rest.pressure), m.figures(pressure)
        known = m.constants.status_of("gamma")
        certified = None if rest.vi.error_bound is None else float(rest.vi.error_bound)
        return {
            "force": Figure(still["force"], "[p][x]", "force on the punch at rest"),
            "contact_half_width": Figure(
                still["contact_half_width"], "[x]", "half of the width under pressure, at rest"
            ),
            "saturated_length": Figure(
                still["saturated_length"], "[x]", "length at the cap, at rest"
            ),
            "peak_pressure": Figure(still["peak_pressure"], "[p]", "largest pressure at rest"),
            "final_force": Figure(last["force"], "[p][x]", "force at the end of the run"),
            "distance_from_rest": Figure(
                float(np.abs(pressure - np.asarray(rest.pressure)).max()), "[p]",
                "largest difference of the last pressure from that at rest",
            ),
            "rest_error_bound": Figure(
                certified, "[p][x]^(1/2)",
                f"bound on the error of the pressure at rest, in L2 ({known})", bound=known,
            ),
            **self.decay_figure("states, in the norm of the viscosity,"),
            **self.bound_figure(bound),
        }  # fmt: skip

    def write_files(self, directory: Path, end: Solution) -> tuple[str, ...]:
        self.contact.write(directory / "body.vtu", end.ts[-1], end.xs[-1])
        return "body.vtu", "body-contact.vtu"


def _known(bound: Certificate | None) -> Certificate | None:
    """Return the bound, or None: the default method is implicit, and has none."""
    return None if bound is None or np.isnan(bound.values).any() else bound


def _given(table: FemContactSection, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the values of those keys that the file has."""
    return {name: getattr(table, name) for name in names if getattr(table, name) is not None}


def _refused(keys: tuple[str, ...], given: str, rule: str, fix: str) -> InputError:
    return input_error(", ".join(f"model.{k}" for k in keys), given, rule, fix)


def _notes(application: FemContactApplication) -> tuple[str, ...]:
    """Return sentences about data for which the equations are not meant."""
    table, notes = application.table, []
    for name, size in (
        ("height of the body", application.height),
        ("radius of the punch", table.radius),
    ):
        part = table.indentation / size
        if part > _NOTABLE_INDENTATION:
            notes.append(
                f"model.indentation is {part:.0%} of the {name}, {size:g}: the equations are those of "
                "small displacements, a few per cent of it."
            )
    if table.end < table.ramp:
        notes.append(
            f"The run ends at {table.end:g} while the punch is still pressed in, until model.ramp = "
            f"{table.ramp:g}: its last force is not that at the full depth."
        )
    return tuple(notes)


APPLICATION = FemContactApplication
