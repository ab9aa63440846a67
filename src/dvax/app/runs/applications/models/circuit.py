"""`[model] name = "circuit"`: a netlist from 0 to t_end."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from dvax.app.runs.applications.base import (
    AbstractApplication,
    Description,
    Figure,
    PerRow,
    Plan,
    Results,
    Say,
    Variable,
)
from dvax.app.runs.applications.certificate import certificate
from dvax.app.runs.schema import SolverKeys, in_quantity
from dvax.app.runs.solver_options import check_model_steps, event_driven, settings
from dvax.evolution import ExpRosenbrock, PiecewiseLinear, Solution
from dvax.models.circuit import Circuit


class CircuitSection(SolverKeys):
    """The netlist and how long to run it."""

    name: Literal["circuit"] = Field(description="the model")
    netlist: str = Field(description="file with the elements of the circuit, a line each")
    t_end: Annotated[float, in_quantity("time")] = Field(gt=0, description="end of the run [s]")
    frames: int = Field(500, ge=1, le=10**6, description="number of intervals between saved states")
    r_on: float | None = Field(
        None, gt=0, description="resistance in series with diodes that have none [ohm]"
    )
    g_leak: float | None = Field(
        None, gt=0, description="conductance across diodes that have none [siemens]"
    )


class CircuitApplication(AbstractApplication):
    """States, node voltages and diode currents over time."""

    section = CircuitSection
    files = ("netlist",)
    end = "model.t_end"

    def __init__(self, table: CircuitSection, paths: Mapping[str, Path], quiet: bool):
        self.table, self.per_row = table, PerRow()
        self.circuit = Circuit.from_file(paths["netlist"], r_on=table.r_on, g_leak=table.g_leak)
        self.circuit.check_sources(table.t_end)
        check_model_steps(table, table.t_end, f"{table.t_end:g} s")

    @property
    def fit(self) -> str:
        return self.circuit.fit

    @property
    def settings(self) -> dict[str, Any]:
        # As `dvax.models.Circuit.solve` has them.
        method = PiecewiseLinear() if event_driven(self.table) else ExpRosenbrock()
        return settings(self.table, method=method, rtol=1e-8, atol=1e-9)

    def describe(self) -> Description:
        c = self.circuit
        sizes = [
            ("states", str(len(c.states)), ", ".join(c.states)),
            ("diodes", str(len(c.diodes)), ", ".join(c.diodes)),
            ("time", f"0 to {self.table.t_end:g} s", f"{self.table.frames + 1} saved states"),
        ]
        return Description(c.constants, (), sizes)

    def plan(self, say: Say) -> Plan:
        c, table = self.circuit, self.table
        say(f"solving from 0 to {table.t_end:g} s")
        times = np.linspace(0.0, table.t_end, table.frames + 1)
        return Plan(c.problem, c.x0, times, c.constants, self.settings, None, "s")

    def results(self, plan: Plan, solution: Solution, count: int) -> Results:
        c, times = self.circuit, np.asarray(solution.ts)[:count]
        bound = certificate(c.problem, solution, c.constants, count)
        volts, amperes = (
            self.per_row(of.__name__, of, solution.ts, solution.xs, solution.us)[:count]
            for of in (c.voltages, c.currents)
        )
        time = ("time",)
        variables = {"time": Variable(time, times, "s", "time")}
        for k, name in enumerate(c.states):
            unit = "V" if name.upper().startswith("C") else "A"
            what = "voltage of" if unit == "V" else "current of"
            values = np.asarray(solution.xs)[:count, k]
            variables[_key("state", name)] = Variable(time, values, unit, f"{what} {name}")
        for k, name in enumerate(c.nodes):
            variables[_key("node", name)] = Variable(
                time, volts[:, k], "V", f"voltage of node {name}"
            )
        for k, name in enumerate(c.diodes):
            words = f"current of diode {name}"
            variables[_key("diode", name)] = Variable(time, amperes[:, k], "A", words)
        words = "bound on the error of the state, ‖x‖² = ΣCv² + ΣLi²"
        variables["error_bound"] = bound.variable("time", "J^(1/2)", words)
        figures = {
            "final_state": Figure(
                np.asarray(solution.xs)[-1], "V, A", f"{', '.join(c.states)} at t = {times[-1]:g} s"
            ),
            "error_bound": bound.figure(
                "J^(1/2)", "bound on the error of the state in the norm of the energy"
            ),
            "decay_rate": Figure(
                float(c.constants.sharp_decay_rate) + 0.0, "1/s",
                "two runs certainly approach at this rate in the norm of the energy",
            ),
        }  # fmt: skip
        return Results(figures, variables, c.constants, int(solution.stats["steps"]))


def _key(kind: str, name: str) -> str:
    """A name in a store, where a slash would begin a folder."""
    return f"{kind}_{name}".replace("/", "∕")


APPLICATION = CircuitApplication
