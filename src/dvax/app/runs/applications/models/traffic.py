"""`[model] name = "traffic"`: trips that find their paths from day to day."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, Field

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
from dvax.app.runs.schema import Section, SolverKeys, rule_error
from dvax.app.runs.solver_options import check_model_steps, settings
from dvax.errors import InputError, SolveError, input_error
from dvax.evolution import Solution
from dvax.formats import read_nodes
from dvax.models.traffic import Incident, Traffic

_DEFAULT_STEP = 0.25
"""The default step size, in days."""
_LEAST_CAPACITY = 0.01
_CAPACITY_REASON = "of less, the link costs so much that rounding hides the costs of all others"
_CAPACITY_FIX = "Write 0.01 or more; for a closed road remove its link from the network file"


def _within_capacity(value: float) -> float:
    if not _LEAST_CAPACITY <= value <= 1:
        rule = f"it is the part of the capacity that is left, {_LEAST_CAPACITY:g} to 1"
        raise rule_error(f"{rule}: {_CAPACITY_REASON}", _CAPACITY_FIX)
    return value


class IncidentSection(Section):
    """A link that loses capacity for a time."""

    init_node: int = Field(ge=1, description="node where the link begins", examples=[10])
    term_node: int = Field(ge=1, description="node where it ends", examples=[16])
    remaining: Annotated[float, AfterValidator(_within_capacity)] = Field(
        description="part of its capacity that is left", examples=[0.3]
    )
    start: float = Field(description="when it begins [day]", examples=[5.0])
    end: float = Field(description="when it is over [day]", examples=[12.0])


class TrafficSection(SolverKeys):
    """The network, the trips, and how they adapt."""

    name: Literal["traffic"] = Field(description="the model")
    network: str = Field(description="_net.tntp file of the network")
    trips: str = Field(description="_trips.tntp file of the demand")
    nodes: str | None = Field(None, description="_node.tntp file of coordinates, for the map")
    toll_weight: float = Field(0.0, ge=0, description="cost of a unit of toll")
    distance_weight: float = Field(0.0, ge=0, description="cost of a unit of length")
    rate: float = Field(1.0, gt=0, description="how fast trips change their paths [1/day]")
    rho: float | None = Field(None, gt=0, description="trips that a unit of cost moves")
    days: float = Field(40.0, gt=0, le=1e5, description="length of the run [day]")
    gap: float = Field(
        1e-12,
        gt=0,
        lt=1,
        description="relative gap of the equilibrium that paths are generated for",
    )
    incidents: list[IncidentSection] = Field(
        default_factory=list, description="links that lose capacity for a time"
    )


class TrafficApplication(AbstractApplication):
    """From the first day, on which all take the road that is fastest when empty, to the equilibrium."""

    section = TrafficSection
    files = ("network", "trips", "nodes")
    end = "model.days"
    keys: ClassVar[Mapping[str, tuple[str, ...]]] = {"link": ("init_node", "term_node")}

    def __init__(self, table: TrafficSection, paths: Mapping[str, Path], quiet: bool):
        self.table, self.per_row = table, PerRow()
        check_model_steps(table, table.days, f"{table.days:g} days")
        try:
            # By file names, so that the problems of both files are reported at once.
            self.traffic = Traffic(
                paths["network"], paths["trips"], toll_weight=table.toll_weight,
                distance_weight=table.distance_weight, rate=table.rate, rho=table.rho, gap=table.gap,
                progress=not quiet,
                incidents=[
                    Incident(
                        link=(i.init_node, i.term_node), remaining=i.remaining, start=i.start, end=i.end
                    )
                    for i in table.incidents
                ],
            )  # fmt: skip
        except SolveError as error:
            raise self._extreme(paths) from error
        if not np.isfinite(self.traffic.constants.L_F):
            raise self._extreme(paths)
        left = float(np.min(self.traffic.least_capacity / self.traffic.network.capacity))
        if left < _LEAST_CAPACITY:
            raise input_error(
                "model.incidents", f"{left:.2g} of a capacity left where several meet",
                f"incidents on one link multiply, and {_LEAST_CAPACITY:g} or more is left of all: "
                + _CAPACITY_REASON,
                _CAPACITY_FIX,
            )  # fmt: skip
        nodes = paths.get("nodes")
        self.places = None if nodes is None else read_nodes(nodes, self.traffic.network)

    def _extreme(self, paths: Mapping[str, Path]) -> InputError:
        return input_error(
            f"{paths['network'].name} and {paths['trips'].name}",
            "numbers of which no equilibrium could be found",
            "capacities, times and trips are of sizes that rounding can compare",
            "Look in both files for very large and very small ones",
        )  # fmt: skip

    @property
    def fit(self) -> str:
        return self.traffic.fit

    def describe(self) -> Description:
        t, table = self.traffic, self.table
        sizes = [
            ("links", str(len(t.network)), f"between {t.network.nodes} nodes"),
            ("pairs", str(len(t.trips)), f"with {float(np.sum(t.trips.flow)):g} trips"),
            ("paths", str(len(t.paths.lengths)), "generated until none of the network costs less"),
            ("days", f"{table.days:g}", _steps(table)),
        ]
        return Description(t.constants, (), sizes, _notes(table))

    @property
    def settings(self) -> dict[str, Any]:
        step = min(_DEFAULT_STEP, self.table.days)
        return settings(self.table, dt=step, vi_solver=self.traffic.vi_solver)

    def plan(self, say: Say) -> Plan:
        t, table = self.traffic, self.table
        whole = np.arange(0.0, np.floor(table.days) + 0.5)
        days = whole if whole[-1] == table.days else np.append(whole, table.days)
        say(f"solving {table.days:g} days")
        return Plan(t.problem, t.all_or_nothing(), days, t.constants, self.settings, None, "days")

    def results(self, plan: Plan, solution: Solution, count: int) -> Results:
        t, days = self.traffic, np.asarray(solution.ts)[:count]
        bound = certificate(t.problem, solution, t.constants, count)
        each = self.per_row
        objectives = each("objective", t.objective, solution.ts, solution.xs)[:count]
        spent = each("travel_time", t.total_travel_time, solution.ts, solution.xs)[:count]
        flows = each("flow", t.link_flows, solution.xs)[:count]
        gap = t.relative_gap(days[-1], solution.xs[-1])
        # Paths are generated for all capacities; the equilibrium is that of the undisturbed network.
        cut = np.asarray(t.capacity(days[-1])) != np.asarray(t.network.capacity)
        least = np.nan if cut.any() else float(t.objective(days[-1], t.equilibrium))
        found = t.figures(solution)
        day = ("day",)
        capacity = each("capacity", t.capacity.value, solution.ts)[:count]
        variables = {
            "day": Variable(day, days, "day", "time"),
            "objective": Variable(day, objectives, "trip cost", "Beckmann's objective"),
            "equilibrium": Variable((), np.asarray(least), "trip cost", "objective at equilibrium"),
            "travel_time": Variable(day, spent, "trip time", "time that all trips spend together"),
            "flow": Variable(("day", "link"), flows, "trip", "flow of each link"),
            "capacity": Variable(("day", "link"), capacity, "trip", "capacity of each link"),
            "init_node": Variable(("link",), np.asarray(t.network.init_node), "1", "from"),
            "term_node": Variable(("link",), np.asarray(t.network.term_node), "1", "to"),
            "error_bound": bound.variable("day", "trip", "bound on the error of path flows"),
        }
        if self.places is not None:
            variables["place"] = Variable(("node", "axis"), self.places, "1", "places of nodes")
        figures = {
            "objective": Figure(
                found["objective"], "trip cost", "Beckmann's objective, Σ ∫ cost dv, on the last day"
            ),
            "total_travel_time": Figure(
                found["total_travel_time"], "trip time", "what all trips together spend that day"
            ),
            "max_conservation_error": Figure(
                found["max_conservation_error"], "1",
                "largest relative error of the trips of any pair, on any day",
            ),
            "relative_gap": Figure(
                gap, "1",
                "share of all cost that would be saved if all took the least cost path of the network",
            ),
            "error_bound": bound.figure("trip", "bound on the error of the path flows, in ℓ²"),
        }  # fmt: skip
        if np.isfinite(least):
            figures["equilibrium_objective"] = Figure(
                least, "trip cost", "the same at the equilibrium that paths were generated for"
            )
        return Results(figures, variables, t.constants, int(solution.stats["steps"]))


def _notes(table: TrafficSection) -> tuple[str, ...]:
    """Incidents that the run never meets."""
    return tuple(
        f"model.incidents[{number}] lasts from day {i.start:g} to day {i.end:g}, and the run, from day "
        f"0 to day {table.days:g}, never meets it."
        for number, i in enumerate(table.incidents, start=1)
        if i.end <= 0 or i.start >= table.days
    )


def _steps(table: TrafficSection) -> str:
    adaptive = table.rtol is not None or table.atol is not None
    return "in adaptive steps" if adaptive else f"in steps of {table.dt or _DEFAULT_STEP:g}"


APPLICATION = TrafficApplication
