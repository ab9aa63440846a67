"""`[model] name = "market"`: a week of RTS-GMLC under a sticky price."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
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
from dvax.app.runs.schema import SolverKeys
from dvax.app.runs.solver_options import check_model_steps, settings
from dvax.errors import input_error
from dvax.evolution import ExpRosenbrock, Solution
from dvax.formats import read_rts
from dvax.formats.rts_gmlc import RTS_FILES
from dvax.models.market import Market, largest_gain


class MarketSection(SolverKeys):
    """The data and the hours."""

    name: Literal["market"] = Field(description="the model")
    data: str = Field(description="folder with gen.csv and the DAY_AHEAD files of RTS-GMLC")
    start_hour: int = Field(
        ge=0, description="the first hour, counted from the first row of the data"
    )
    hours: int = Field(168, ge=1, description="how many hours")
    speed: float = Field(6.0, gt=0, description="rate at which the price follows demand [1/h]")
    reference_price: float = Field(
        40.0, gt=0, description="price at which the load is wanted [$/MWh]"
    )
    elasticity: float = Field(0.3, gt=0, description="of the mean load at the reference price")


class MarketApplication(AbstractApplication):
    """Prices at rest for every hour, and the sticky price between them."""

    section = MarketSection
    folders: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "data": (
            *(name for places in RTS_FILES.values() for name in places),
        ),
    }  # fmt: skip

    def __init__(self, table: MarketSection, paths: Mapping[str, Path], quiet: bool):
        self.table, self.per_row = table, PerRow()
        rts = read_rts(paths["data"])
        options: dict[str, Any] = dict(
            speed=table.speed, reference_price=table.reference_price, elasticity=table.elasticity
        )
        # One hour alone is solved as a point of an interval of two hours.
        last = len(rts.load) - 1
        if not table.start_hour + table.hours <= last + 1:
            raise input_error(
                "dvax.models.Market.from_rts(start_hour, hours)",
                f"{table.start_hour} and {table.hours}",
                f"the data have the hours 0 to {last}", "Name hours inside",
            )  # fmt: skip
        check_model_steps(table, float(max(table.hours - 1, 1)), f"{table.hours} hours")
        self.times = np.arange(table.start_hour, table.start_hour + table.hours, dtype=float)
        first = min(table.start_hour, last - 1) if table.hours == 1 else table.start_hour
        self.market = Market.from_rts(rts, first, max(2, table.hours), **options)

    @property
    def fit(self) -> str:
        return self.market.fit

    def describe(self) -> Description:
        firms = self.market.firms
        sizes = [
            ("units", str(firms.shape[0]), f"of {firms.shape[1]} firms"),
            ("hours", str(len(self.times)), f"from hour {self.table.start_hour} on"),
        ]
        return Description(self.market.constants, (), sizes)

    @property
    def settings(self) -> dict[str, Any]:
        solver = self.market.law_solver
        return settings(
            self.table, method=ExpRosenbrock(), rtol=1e-8, atol=1e-8, vi_solver=solver
        )  # fmt: skip

    def plan(self, say: Say) -> Plan:
        market, times = self.market, self.times
        say("solving for the prices at rest")
        prices, made = jax.vmap(market.equilibrium)(jnp.asarray(times))
        rest = np.asarray(prices), np.asarray(made)
        if len(times) > 1:
            say("solving for the sticky price")
        return Plan(market.problem, prices[0], times, market.constants, self.settings, rest, "h")

    def results(self, plan: Plan, solution: Solution | None, count: int) -> Results:
        market, times = self.market, np.asarray(plan.times)[:count]
        prices, made = (values[:count] for values in plan.data)
        every = self.per_row("capacity", market.capacity.value, jnp.asarray(plan.times))
        capacity = every[:count]
        firms = np.asarray(market.firms)
        numbers = np.asarray(market.cost), np.asarray(market.slope), firms, float(market.b)
        gain = largest_gain(prices, made, capacity, *numbers)
        variables = {
            "hour": Variable(("hour",), times, "h", "hour of the data"),
            "price": Variable(("hour",), prices, "$/MWh", "Cournot-Nash price"),
            "made": Variable(("hour", "firm"), made @ firms, "MW", "what each firm makes"),
            "capacity": Variable(("hour", "firm"), capacity @ firms, "MW", "what it could make"),
        }
        figures = {
            "price": Figure(prices, "$/MWh", "Cournot-Nash price of every hour"),
            "max_deviation_profit": Figure(
                gain, "$/h", "most that a firm could gain by making something else, at any hour"
            ),
            "mean_price": Figure(float(np.mean(prices)), "$/MWh", "their mean"),
        }
        steps = 0
        if solution is not None:
            steps = int(solution.stats["steps"])
            bound = certificate(market.problem, solution, market.constants, count)
            sticky = np.asarray(solution.xs)[:count]
            variables |= {
                "sticky_price": Variable(("hour",), sticky, "$/MWh", "price that follows demand"),
                "error_bound": bound.variable(
                    "hour", "$/MWh", "bound on the error of the sticky price"
                ),
            }
            under_way = largest_gain(sticky, np.asarray(solution.us)[:count], capacity, *numbers)
            figures["max_deviation_profit"] = Figure(
                max(gain, under_way), "$/h",
                "most that a firm could gain by making something else, at rest or under way",
            )  # fmt: skip
            figures |= {
                "sticky_price": Figure(
                    sticky, "$/MWh", "price of the dynamics at every hour", bound.proved()
                ),
                "largest_lag": Figure(
                    float(np.abs(sticky - prices).max()), "$/MWh",
                    "most that the sticky price is away from the price at rest",
                ),
                "error_bound": bound.figure("$/MWh", "bound on the error of the sticky price"),
                "decay_rate": Figure(
                    float(market.constants.sharp_decay_rate), "1/h",
                    "two prices certainly approach at this rate",
                ),
            }  # fmt: skip
        return Results(figures, variables, market.constants, steps)


APPLICATION = MarketApplication
