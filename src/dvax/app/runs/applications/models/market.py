"""`[model] name = "market"`: a week of RTS-GMLC under a sticky price."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

from dvax.app.runs.applications.base import Figure, Say, Variable
from dvax.app.runs.applications.certificate import Certificate
from dvax.app.runs.applications.from_model import AbstractModelApplication
from dvax.app.runs.schema import SolverKeys
from dvax.errors import input_error
from dvax.evolution import ExpRosenbrock, Solution
from dvax.formats import read_rts
from dvax.formats.rts_gmlc import RTS_FILES
from dvax.models import Model
from dvax.models.market import Market
from dvax.models.market.deviation import largest_gains


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


class MarketApplication(AbstractModelApplication):
    """Prices at rest for every hour, and the sticky price between them."""

    section = MarketSection
    folders: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "data": (
            *(name for places in RTS_FILES.values() for name in places),
        ),
    }  # fmt: skip

    axis = ("hour", "hour of the data")
    verified = False
    bound_words = "bound on the error of the sticky price"
    bound_unit = "$/MWh"

    def __init__(self, table: MarketSection, paths: Mapping[str, Path], quiet: bool):
        self.table = table
        rts = read_rts(paths["data"])
        options: dict[str, Any] = dict(
            speed=table.speed, reference_price=table.reference_price, elasticity=table.elasticity
        )
        start, hours = table.start_hour, table.hours
        # One hour alone is solved as a point of an interval of two hours.
        last = len(rts.load) - 1
        if not start + hours <= last + 1:
            raise input_error(
                "dvax.models.Market.from_rts(start_hour, hours)", f"{start} and {hours}",
                f"the data have the hours 0 to {last}", "Name hours inside",
            )  # fmt: skip
        first = min(start, last - 1) if hours == 1 else start
        market = self.market = Market.from_rts(rts, first, max(2, hours), **options)
        model = Model(
            market.problem, table.reference_price, float(first + max(hours - 1, 1)), float(first),
            states={"sticky_price": "$/MWh"}, time_unit="h", constants=market.constants,
            settings={
                "method": ExpRosenbrock(), "rtol": 1e-8, "atol": 1e-8, "vi_solver": market.law_solver,
            },
        )  # fmt: skip
        self.set_model(model, times=np.arange(start, start + hours, dtype=float))

    @property
    def fit(self) -> str:
        return self.market.fit

    def sizes(self) -> list[tuple[str, str, str]]:
        units, firms = self.market.firms.shape
        return [
            ("units", str(units), f"of {firms} firms"),
            ("hours", str(len(self.times)), f"from hour {self.table.start_hour} on"),
        ]

    def prepare(self, say: Say) -> Model:
        say("solving for the prices at rest")
        prices, made = jax.vmap(self.market.equilibrium)(jnp.asarray(self.times))
        self.prices, self.made = np.asarray(prices), np.asarray(made)
        return replace(self.own, x0=prices[0])

    def series(
        self, solution: Solution | None, bound: Certificate | None
    ) -> Mapping[str, Variable]:
        market, times = self.market, self.times if solution is None else np.asarray(solution.ts)
        which = np.searchsorted(self.times, times)
        prices, made = self.prices[which], self.made[which]
        capacity = self.per_row("capacity", market.capacity.value, jnp.asarray(times))
        firms = np.asarray(market.firms)
        numbers = np.asarray(market.cost), np.asarray(market.slope), firms, float(market.b)
        gain = largest_gains(prices, made, capacity, *numbers)
        found = {
            "price": Variable(("hour",), prices, "$/MWh", "Cournot-Nash price"),
            "made": Variable(("hour", "firm"), made @ firms, "MW", "what each firm makes"),
            "capacity": Variable(("hour", "firm"), capacity @ firms, "MW", "what it could make"),
        }
        if solution is not None:
            sticky = np.asarray(solution.xs)
            gain = np.maximum(
                gain, largest_gains(sticky, np.asarray(solution.us), capacity, *numbers)
            )
            words = "price that follows demand"
            found["sticky_price"] = Variable(("hour",), sticky, "$/MWh", words)
        words = "most that a firm could gain by making something else"
        found["deviation_profit"] = Variable(("hour",), gain, "$/h", words)
        return {**found, **self.bound_series(bound)}

    def figures(
        self, series: Mapping[str, np.ndarray], end: Solution, bound: Certificate | None
    ) -> Mapping[str, Figure]:
        prices, sticky = series["price"], series.get("sticky_price")
        when = "at any hour" if sticky is None else "at rest or under way"
        figures = {
            "price": Figure(prices, "$/MWh", "Cournot-Nash price of every hour"),
            "max_deviation_profit": Figure(
                float(series["deviation_profit"].max()), "$/h",
                f"most that a firm could gain by making something else, {when}",
            ),
            "mean_price": Figure(float(np.mean(prices)), "$/MWh", "their mean"),
        }  # fmt: skip
        if sticky is not None:
            figures |= {
                "sticky_price": Figure(
                    sticky, "$/MWh", "price of the dynamics at every hour",
                    None if bound is None else bound.proved(),
                ),
                "largest_lag": Figure(
                    float(np.abs(sticky - prices).max()), "$/MWh",
                    "most that the sticky price is away from the price at rest",
                ),
                **self.bound_figure(bound),
                **self.decay_figure("prices"),
            }  # fmt: skip
        return figures


APPLICATION = MarketApplication
