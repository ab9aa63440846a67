"""`[model] name = "thermostat"`: a floor with saturated heaters, a set point and the weather."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import jax
import numpy as np
from pydantic import Field

from dvax.app.runs.applications.base import Figure, Variable
from dvax.app.runs.applications.certificate import Certificate
from dvax.app.runs.applications.from_model import AbstractModelApplication, FramesKeys
from dvax.app.runs.applications.history import read_series
from dvax.app.runs.schema import Section, in_unit, number_or_file
from dvax.errors import Problems
from dvax.evolution import Solution
from dvax.models import Model, Thermostat
from dvax.signals import AbstractSignal, Constant, Table

_SIDES = Field(min_length=2, max_length=2)


class Area(Section):
    """A rectangle of the floor."""

    x: Annotated[list[float], _SIDES] = Field(description="from and to [m]", examples=[[0.0, 1.0]])
    y: Annotated[list[float], _SIDES] = Field(description="from and to [m]", examples=[[0.0, 6.0]])


class ThermostatSection(FramesKeys):
    """The floor, its heaters, the set point and the weather."""

    name: Literal["thermostat"] = Field(description="the model")
    outdoor: Annotated[float | str, number_or_file("degC")] = Field(
        0.0, description="outdoor temperature, a number or a CSV file [degC]"
    )
    set_point: Annotated[float | str, number_or_file("degC")] = Field(
        20.0, description="temperature that is wanted, a number or a CSV file of steps [degC]"
    )
    gains: Annotated[float | str, number_or_file("W/m^2")] = Field(
        0.0, description="heat of sun and people, a number or a CSV file [W/m^2]"
    )
    initial: Annotated[float, in_unit("degC")] = Field(
        15.0, ge=-273.15, description="temperature at the start [degC]"
    )
    lengths: Annotated[list[float], _SIDES] = Field([8.0, 6.0], description="sides [m]")
    cells: Annotated[list[int], _SIDES] = Field(
        [32, 24], description="cells along the sides; [1, 1] for one room temperature"
    )
    heaters: list[Area] | None = Field(
        None, description="where there are heaters; everywhere if not given"
    )
    capacity: Annotated[float, in_unit("W h/(m^2 K)")] = Field(
        50.0, gt=0, description="heat capacity a floor area [W h/(m^2 K)]"
    )
    diffusivity: Annotated[float, in_unit("m^2/h")] = Field(
        0.5, gt=0, description="how fast temperatures of neighbouring places even out [m^2/h]"
    )
    loss: Annotated[float, in_unit("W/(m^2 K)")] = Field(
        2.5, ge=0, description="heat lost to the outdoors a floor area [W/(m^2 K)]"
    )
    gain: Annotated[float, in_unit("W/(m^2 K)")] = Field(
        80.0, gt=0, description="heating power per kelvin below the set point [W/(m^2 K)]"
    )
    power_min: Annotated[float, in_unit("W/m^2")] = Field(
        0.0, description="least power of heaters, below 0 for cooling [W/m^2]"
    )
    power_max: Annotated[float, in_unit("W/m^2")] = Field(
        80.0, description="greatest power of heaters [W/m^2]"
    )
    t_end: Annotated[float, in_unit("h")] = Field(48.0, gt=0, description="end of the run [h]")


class ThermostatApplication(AbstractModelApplication):
    """Temperature and heating over place and time, and their means."""

    section = ThermostatSection
    files = ("outdoor", "set_point", "gains")
    end = "model.t_end"
    keys: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "diffusion": ("diffusivity",), "shape": ("cells",), "lower": ("power_min",),
        "upper": ("power_max",), "reference": ("set_point",), "load": ("gains", "outdoor"),
    }  # fmt: skip
    bound_words = "bound on the error of the temperature, ‖T‖² = ∫T² over the floor"
    bound_unit = "K m"

    def __init__(self, table: ThermostatSection, paths: Mapping[str, Path], quiet: bool):
        self.table = table
        problems, signals = Problems(), dict[str, AbstractSignal]()
        for name, unit in (("outdoor", "degC"), ("set_point", "degC"), ("gains", "W/m^2")):
            with problems.collect():
                signals[name] = self._signal(name, unit, paths)
        with problems.collect():
            heated = self._heated()
        problems.raise_any()
        self.outdoor, self.set_point, gains = signals.values()
        self.heated, C = heated, table.capacity
        self.floor = Thermostat(
            shape=tuple(table.cells), lengths=tuple(table.lengths), boundary="neumann",
            diffusion=table.diffusivity, gain=table.gain / C, loss=table.loss / C,
            lower=np.where(heated, table.power_min / C, 0.0),
            upper=np.where(heated, table.power_max / C, 0.0), reference=self.set_point,
            load=lambda t: (table.loss * self.outdoor(t) + gains(t)) / C,
        )  # fmt: skip
        model = Model(
            self.floor.problem, np.full(table.cells, table.initial), table.t_end, time_unit="h",
            states={"temperature": "degC"}, responses={"heating": "K/h"},
            constants=self.floor.constants, settings={"rtol": 1e-5, "atol": 1e-5},
        )  # fmt: skip
        self.set_model(model, None)

    @property
    def fit(self) -> str:
        return self.floor.fit

    def _signal(self, name: str, unit: str, paths: Mapping[str, Path]) -> AbstractSignal:
        given = getattr(self.table, name)
        if not isinstance(given, str):
            return Constant(np.asarray(given, float))
        path = paths[name]
        found = read_series(path, name, unit, "h").check_covers(path, self.table.t_end, "h")
        # A schedule changes in steps; weather is measured at points of a curve.
        kind = "constant" if name == "set_point" else "linear"
        return Table(found.times, found.columns[name], kind)

    def _heated(self) -> np.ndarray:
        """Return where the midpoint of a cell is in one of the heaters."""
        t = self.table
        axes = ((np.arange(n) + 0.5) * side / n for n, side in zip(t.cells, t.lengths, strict=True))
        x, y = np.meshgrid(*axes, indexing="ij")
        if t.heaters is None:
            return np.ones(t.cells, bool)
        problems, heated = Problems(), np.zeros(t.cells, bool)
        for k, a in enumerate(t.heaters):
            swapped = [name for name, ends in (("x", a.x), ("y", a.y)) if ends[0] > ends[1]]
            for name in swapped:
                problems.add(
                    f"model.heaters[{k + 1}].{name}", str(getattr(a, name)),
                    "the first end is the smaller one", "Exchange the two numbers",
                )  # fmt: skip
            if swapped:
                continue
            inside = (a.x[0] <= x) & (x <= a.x[1]) & (a.y[0] <= y) & (y <= a.y[1])
            if not inside.any():
                problems.add(
                    f"model.heaters[{k + 1}]", f"x = {a.x}, y = {a.y}",
                    f"it has the midpoint of a cell, of a floor of {t.lengths} m with {t.cells} cells",
                    "Move or enlarge it, or use more cells",
                )  # fmt: skip
            heated |= inside
        problems.raise_any()
        return heated

    def sizes(self) -> list[tuple[str, str, str]]:
        share = float(self.heated.mean())
        hours = self.table.capacity / self.table.loss if self.table.loss else np.inf
        return [
            ("heated part", f"{share:.4g}", "of the floor"),
            ("time constant", f"{hours:.4g} h", "capacity over loss, of a floor without heaters"),
        ]

    def series(self, solution: Solution, bound: Certificate | None) -> Mapping[str, Variable]:
        t, area = self.table, float(np.prod(self.table.lengths))
        times, x, u = (np.asarray(v) for v in (solution.ts, solution.xs, solution.us))
        outdoor, wanted = (
            np.broadcast_to(np.asarray(jax.vmap(s.value)(solution.ts)), times.shape)
            for s in (self.outdoor, self.set_point)
        )
        kilowatts = area / 1e3
        heating = t.capacity * u.mean(axis=(1, 2)) * kilowatts
        most, least = (
            np.full(times.shape, p * self.heated.mean() * kilowatts)
            for p in (t.power_max, t.power_min)
        )
        mean = x.mean(axis=(1, 2))
        below = np.maximum(wanted[:, None, None] - x, 0.0).mean(axis=(1, 2))
        series = {
            name: Variable(("time",), values, unit, words)
            for name, values, unit, words in (
                ("mean_temperature", mean, "degC", "mean temperature of the floor"),
                ("coldest", x.min(axis=(1, 2)), "degC", "lowest temperature of the floor"),
                ("warmest", x.max(axis=(1, 2)), "degC", "highest temperature of the floor"),
                ("set_point", wanted, "degC", "temperature that is wanted"),
                ("outdoor", outdoor, "degC", "outdoor temperature"),
                ("heating_power", heating, "kW", "power of all heaters"),
                ("heating_max", most, "kW", "greatest power of all heaters"),
                ("heating_min", least, "kW", "least power of all heaters"),
                (
                    "below_set_point",
                    below,
                    "K",
                    "temperature below the set point, mean of the floor",
                ),
            )
        }
        return {**self.named(solution), **self.bound_series(bound), **series}

    def fixed(self, end: Solution) -> Mapping[str, Variable]:
        t, found = self.table, {}
        for k, (name, n, side) in enumerate(zip("xy", t.cells, t.lengths, strict=True)):
            places = (np.arange(n) + 0.5) * side / n
            found[name] = Variable((f"temperature_{k}",), places, "m", f"midpoints along {name}")
        return found

    def figures(
        self, series: Mapping[str, np.ndarray], end: Solution, bound: Certificate | None
    ) -> Mapping[str, Figure]:
        area, times = float(np.prod(self.table.lengths)), series["time"]
        mean, heating = series["mean_temperature"], series["heating_power"]
        last = f"at t = {times[-1]:g} h"
        # |mean error| ≤ ‖error‖/√area
        within = None if bound is None else bound.proved(1.0 / np.sqrt(area))
        figures = {
            "final_mean_temperature": Figure(
                float(mean[-1]), "degC", f"mean temperature {last}",
                None if within is None else float(within[-1]),
            ),
            "heating_energy": Figure(
                float(np.trapezoid(heating, times)), "kWh", "of all heaters, from the saved times"
            ),
            "largest_heating": Figure(float(heating.max()), "kW", "at the saved times"),
            "below_set_point": Figure(
                float(np.trapezoid(series["below_set_point"], times)), "K h",
                "temperature below the set point, mean of the floor, over time",
            ),
            **self.decay_figure("temperatures"),
        }  # fmt: skip
        return self.joined(self.final_values(end) | self.bound_figure(bound), figures)


APPLICATION = ThermostatApplication
