"""`[model] name = "traffic"`: trips that find their paths from day to day."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from pydantic import Field

from dvax.evolution import solve
from dvax.models.traffic import Incident, Traffic, read_nodes
from dvax.runs.applications.base import AbstractApplication, Figure, Results, Variable
from dvax.runs.applications.certificate import certificate
from dvax.runs.schema import Section
from dvax.theory import Assumption, Constants


class IncidentSection(Section):
    """A link that loses capacity for a time."""

    init_node: int = Field(ge=1, description="where the link begins")
    term_node: int = Field(ge=1, description="where it ends")
    remaining: float = Field(gt=0, description="the part of its capacity that is left")
    start: float = Field(description="first day")
    end: float = Field(description="last day")


class TrafficSection(Section):
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
    dt: float = Field(0.25, gt=0, description="step [day]")
    incidents: list[IncidentSection] = Field(
        default_factory=list, description="links that lose capacity for a time"
    )


class _Loaded:
    def __init__(self, table: TrafficSection, paths: Mapping[str, Path]):
        self.table = table
        # By their names, so that what is wrong in both files is said at once.
        self.traffic = Traffic(
            paths["network"], paths["trips"], toll_weight=table.toll_weight,
            distance_weight=table.distance_weight, rate=table.rate, rho=table.rho,
            incidents=[
                Incident(
                    link=(i.init_node, i.term_node), remaining=i.remaining, start=i.start, end=i.end
                )
                for i in table.incidents
            ],
        )  # fmt: skip
        nodes = paths.get("nodes")
        self.places = None if nodes is None else read_nodes(nodes, self.traffic.network)


class TrafficApplication(AbstractApplication[_Loaded]):
    """From the first day, on which all take the road that is fastest when empty, to the equilibrium."""

    section = TrafficSection
    files = ("network", "trips", "nodes")

    def read(self, table: Any, paths: Mapping[str, Path]) -> _Loaded:
        return _Loaded(table, paths)

    def fit(self, model: _Loaded) -> str:
        return model.traffic.fit

    def known(
        self, model: _Loaded
    ) -> tuple[Constants | None, tuple[Assumption, ...], list[tuple[str, str, str]]]:
        t, table = model.traffic, model.table
        sizes = [
            ("links", str(len(t.network)), f"between {t.network.nodes} nodes"),
            ("pairs", str(len(t.trips)), f"with {float(np.sum(t.trips.flow)):g} trips"),
            ("paths", str(len(t.paths.lengths)), "generated until none of the network costs less"),
            ("days", f"{table.days:g}", f"in steps of {table.dt:g}"),
        ]
        return t.constants, (), sizes

    def solve(self, model: _Loaded) -> Results:
        t, table = model.traffic, model.table
        whole = np.arange(0.0, np.floor(table.days) + 0.5)
        days = whole if whole[-1] == table.days else np.append(whole, table.days)
        solution = solve(
            t.problem, t.all_or_nothing(), 0.0, table.days, ts=days, dt=table.dt,
            vi_solver=t.vi_solver, constants=t.constants, measure=True,
        )  # fmt: skip
        bound = certificate(t.problem, solution, t.constants)
        objectives = np.asarray(jax.vmap(t.objective)(solution.ts, solution.xs))
        spent = np.asarray(jax.vmap(t.total_travel_time)(solution.ts, solution.xs))
        flows = np.asarray(jax.vmap(t.link_flows)(solution.xs))
        gap = t.relative_gap(table.days, solution.xs[-1])
        # Paths were generated for all capacities, the equilibrium is that of the network as it is.
        cut = np.asarray(t.capacity(table.days)) != np.asarray(t.network.capacity)
        least = np.nan if cut.any() else float(t.objective(table.days, t.equilibrium))
        found = t.figures(solution)
        day = ("day",)
        capacity = np.asarray(jax.vmap(t.capacity.value)(solution.ts))
        variables = {
            "day": Variable(day, days, "day", "time"),
            "objective": Variable(day, objectives, "trip cost", "Beckmann's objective"),
            "equilibrium": Variable((), np.asarray(least), "trip cost", "objective at equilibrium"),
            "travel_time": Variable(day, spent, "trip time", "time that all trips spend together"),
            "flow": Variable(("day", "link"), flows, "trip", "flow of each link"),
            "capacity": Variable(("day", "link"), capacity, "trip", "capacity of each link"),
            "init_node": Variable(("link",), np.asarray(t.network.init_node), "1", "from"),
            "term_node": Variable(("link",), np.asarray(t.network.term_node), "1", "to"),
            "error_bound": Variable(day, bound.values, "trip", "bound on the error of path flows"),
        }
        if model.places is not None:
            variables["place"] = Variable(("node", "axis"), model.places, "1", "places of nodes")
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
            "error_bound": Figure(
                bound.largest, "trip", f"bound on the error of the path flows, in ℓ² ({bound.status})"
            ),
        }  # fmt: skip
        if np.isfinite(least):
            figures["equilibrium_objective"] = Figure(
                least, "trip cost", "the same at the equilibrium that paths were generated for"
            )
        return Results(figures, variables, t.constants, int(solution.stats["steps"]))


APPLICATION = TrafficApplication()
