"""`[model] name = "traffic"`: trips that find their paths from day to day."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, Field

from dvax.app.runs.applications.base import Figure, Variable
from dvax.app.runs.applications.certificate import Certificate
from dvax.app.runs.applications.from_model import AbstractModelApplication
from dvax.app.runs.schema import Section, SolverKeys, rule_error
from dvax.app.runs.solver_options import check_model_steps
from dvax.errors import InputError, SolveError, input_error
from dvax.evolution import Solution
from dvax.formats import read_nodes
from dvax.models import Model
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


class TrafficApplication(AbstractModelApplication):
    """From the first day, on which all take the road that is fastest when empty, to the equilibrium."""

    section = TrafficSection
    files = ("network", "trips", "nodes")
    end = "model.days"
    keys: ClassVar[Mapping[str, tuple[str, ...]]] = {"link": ("init_node", "term_node")}
    axis = ("day", "time")
    verified = False
    bound_words = "bound on the error of the path flows, in ℓ²"
    bound_unit = "trip"

    def __init__(self, table: TrafficSection, paths: Mapping[str, Path], quiet: bool):
        self.table = table
        # Before paths are generated, which takes seconds.
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
        t, whole = self.traffic, np.arange(0.0, np.floor(table.days) + 0.5)
        model = Model(
            t.problem, t.all_or_nothing(), table.days, time_unit="day", constants=t.constants,
            settings={"dt": min(_DEFAULT_STEP, table.days), "vi_solver": t.vi_solver},
        )  # fmt: skip
        self.set_model(model, times=np.unique(np.append(whole, table.days)))

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

    def sizes(self) -> list[tuple[str, str, str]]:
        t = self.traffic
        return [
            ("links", str(len(t.network)), f"between {t.network.nodes} nodes"),
            ("pairs", str(len(t.trips)), f"with {float(np.sum(t.trips.flow)):g} trips"),
            ("paths", str(len(t.paths.lengths)), "generated until none of the network costs less"),
        ]

    def notes(self) -> tuple[str, ...]:
        return _notes(self.table)

    def series(self, solution: Solution, bound: Certificate | None) -> Mapping[str, Variable]:
        t, each, ts, xs = self.traffic, self.per_row, solution.ts, solution.xs
        day, link = ("day",), ("day", "link")
        return {
            name: Variable(dims, np.asarray(values), unit, words)
            for name, dims, values, unit, words in (
                ("objective", day, each("objective", t.objective, ts, xs),
                 "trip cost", "Beckmann's objective"),
                ("travel_time", day, each("travel_time", t.total_travel_time, ts, xs),
                 "trip time", "time that all trips spend together"),
                ("flow", link, each("flow", t.link_flows, xs), "trip", "flow of each link"),
                ("capacity", link, each("capacity", t.capacity.value, ts),
                 "trip", "capacity of each link"),
                ("conservation_error", day, t.conservation_errors(solution),
                 "1", "largest relative error of the trips of any pair"),
            )
        } | self.bound_series(bound)  # fmt: skip

    def fixed(self, end: Solution) -> Mapping[str, Variable]:
        network = self.traffic.network
        least, words = np.asarray(self._least(end)), "objective at equilibrium"
        found = {
            "equilibrium": Variable((), least, "trip cost", words),
            "init_node": Variable(("link",), np.asarray(network.init_node), "1", "from"),
            "term_node": Variable(("link",), np.asarray(network.term_node), "1", "to"),
        }
        if self.places is not None:
            found["place"] = Variable(("node", "axis"), self.places, "1", "places of nodes")
        return found

    def _least(self, end: Solution) -> float:
        """Return the objective at equilibrium. Paths are generated for all capacities, and the
        equilibrium is that of the undisturbed network: NaN if capacities differ on the last day."""
        t, day = self.traffic, end.ts[-1]
        cut = np.asarray(t.capacity(day)) != np.asarray(t.network.capacity)
        return np.nan if cut.any() else float(t.objective(day, t.equilibrium))

    def figures(
        self, series: Mapping[str, np.ndarray], end: Solution, bound: Certificate | None
    ) -> Mapping[str, Figure]:
        figures = {
            "objective": Figure(
                float(series["objective"][-1]), "trip cost",
                "Beckmann's objective, Σ ∫ cost dv, on the last day",
            ),
            "total_travel_time": Figure(
                float(series["travel_time"][-1]), "trip time",
                "what all trips together spend that day",
            ),
            "max_conservation_error": Figure(
                float(series["conservation_error"].max()), "1",
                "largest relative error of the trips of any pair, on any day",
            ),
            "relative_gap": Figure(
                self.traffic.relative_gap(end.ts[-1], end.xs[-1]), "1",
                "share of all cost that would be saved if all took the least cost path of the network",
            ),
            **self.bound_figure(bound),
        }  # fmt: skip
        least = self._least(end)
        if np.isfinite(least):
            figures["equilibrium_objective"] = Figure(
                least, "trip cost", "the same at the equilibrium that paths were generated for"
            )
        return figures


def _notes(table: TrafficSection) -> tuple[str, ...]:
    """Incidents that the run never meets."""
    return tuple(
        f"model.incidents[{number}] lasts from day {i.start:g} to day {i.end:g}, and the run, from day "
        f"0 to day {table.days:g}, never meets it."
        for number, i in enumerate(table.incidents, start=1)
        if i.end <= 0 or i.start >= table.days
    )


APPLICATION = TrafficApplication
