"""`[model] name = "circuit"`: a netlist from 0 to t_end."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from dvax.app.runs.applications.base import Figure, Variable
from dvax.app.runs.applications.certificate import Certificate
from dvax.app.runs.applications.from_model import (
    FINAL_VALUES,
    AbstractModelApplication,
    store_name,
)
from dvax.app.runs.schema import SolverKeys, in_quantity, in_unit
from dvax.app.runs.solver_options import event_driven
from dvax.evolution import ExpRosenbrock, PiecewiseLinear, Solution
from dvax.models import Model
from dvax.models.circuit import Circuit


class CircuitSection(SolverKeys):
    """The netlist and how long to run it."""

    name: Literal["circuit"] = Field(description="the model")
    netlist: str = Field(description="file with the elements of the circuit, a line each")
    t_end: Annotated[float, in_quantity("time")] = Field(gt=0, description="end of the run [s]")
    frames: int = Field(500, ge=1, le=10**6, description="number of intervals between saved states")
    r_on: Annotated[float, in_unit("ohm")] | None = Field(
        None, gt=0, description="resistance in series with diodes that have none [ohm]"
    )
    g_leak: Annotated[float, in_unit("siemens")] | None = Field(
        None, gt=0, description="conductance across diodes that have none [siemens]"
    )


class CircuitApplication(AbstractModelApplication):
    """States, node voltages and diode currents over time."""

    section = CircuitSection
    files = ("netlist",)
    end = "model.t_end"
    verified = False
    bound_words = "bound on the error of the state in the norm of the energy, ‖x‖² = ΣCv² + ΣLi²"
    bound_unit = "J^(1/2)"

    def __init__(self, table: CircuitSection, paths: Mapping[str, Path], quiet: bool):
        self.table = table
        c = Circuit.from_file(paths["netlist"], r_on=table.r_on, g_leak=table.g_leak)
        self.circuit = c
        c.check_sources(table.t_end)
        # As `dvax.models.Circuit.solve` has them.
        method = PiecewiseLinear() if event_driven(table) else ExpRosenbrock()
        model = Model(
            c.problem, c.x0, table.t_end, states={name: _unit(name) for name in c.states},
            constants=c.constants, settings={"method": method, "rtol": 1e-8, "atol": 1e-9},
        )  # fmt: skip
        self.set_model(model)

    @property
    def fit(self) -> str:
        return self.circuit.fit

    def sizes(self) -> list[tuple[str, str, str]]:
        return [("diodes", str(len(self.circuit.diodes)), ", ".join(self.circuit.diodes))]

    def series(self, solution: Solution, bound: Certificate | None) -> Mapping[str, Variable]:
        c = self.circuit
        volts, amperes = (
            self.per_row(of.__name__, of, solution.ts, solution.xs, solution.us)
            for of in (c.voltages, c.currents)
        )
        states = np.asarray(solution.xs)
        found = {}
        for kind, names, columns in (
            ("state", c.states, states), ("node", c.nodes, volts), ("diode", c.diodes, amperes),
        ):  # fmt: skip
            for k, name in enumerate(names):
                unit = {"node": "V", "diode": "A"}.get(kind) or _unit(name)
                what = "voltage of" if unit == "V" else "current of"
                words = f"{what} {name}" if kind == "state" else f"{what} {kind} {name}"
                key = store_name(f"{kind}_{name}")
                found[key] = Variable(("time",), columns[:, k], unit, words)
        return {**found, **self.bound_series(bound)}

    def figures(
        self, series: Mapping[str, np.ndarray], end: Solution, bound: Certificate | None
    ) -> Mapping[str, Figure]:
        c, last = self.circuit, float(end.ts[-1])
        found = {}
        for name, value in zip(c.states[:FINAL_VALUES], np.asarray(end.xs)[-1], strict=False):
            found[store_name(f"final_{name}")] = Figure(
                float(value), _unit(name), f"{_quantity(name)} {name} at t = {last:g} s"
            )
        return {
            **found,
            **self.bound_figure(bound),
            **self.bounds_of_states(bound),
            **self.decay_figure("runs, in the norm of the energy,"),
        }  # fmt: skip

    def bounds_of_states(self, bound: Certificate | None) -> dict[str, Figure]:
        """Bounds in V and A: each term of ΣCv² + ΣLi² is at most the sum."""
        if bound is None or bound.largest is None:
            return {}
        c, top = self.circuit, bound.largest
        return {
            store_name(f"error_bound_{name}"): Figure(
                top / math.sqrt(float(storage)), _unit(name),
                f"bound on the error of the {_quantity(name)} {name} at all saved times "
                f"({bound.status})",
                bound=bound.status,
            )
            for name, storage in zip(c.states[:FINAL_VALUES], np.asarray(c.storage), strict=False)
        }  # fmt: skip


def _quantity(state: str) -> str:
    return "voltage of" if _unit(state) == "V" else "current of"


def _unit(state: str) -> str:
    """The unit of a state, the voltage of a capacitor or the current of an inductor."""
    return "V" if state.upper().startswith("C") else "A"


APPLICATION = CircuitApplication
