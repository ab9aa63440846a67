"""`[model] name = "mpc"`: a linear plant under model predictive control that follows a reference."""

import importlib.util
import math
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import jax
import numpy as np
from pydantic import Field, PlainValidator

from dvax.app.runs.applications.base import Figure, Variable
from dvax.app.runs.applications.certificate import Certificate
from dvax.app.runs.applications.from_model import (
    AbstractModelApplication,
    FramesKeys,
    store_name,
)
from dvax.app.runs.applications.history import read_history
from dvax.app.runs.schema import in_unit, rule_error
from dvax.errors import Problems, input_error
from dvax.evolution import ETD4RK, Solution
from dvax.formats.csv_matrix import read_matrix
from dvax.models import LinearMPC, Model
from dvax.signals import Table
from dvax.theory import verify
from dvax.theory.energy import MAX_UNKNOWNS


def _rows(value: Any) -> Any:
    """Return a file name, or a list of numbers or of rows of numbers."""
    if isinstance(value, str):
        return value
    flat = [n for row in value for n in (row if isinstance(row, list) else [row])] if isinstance(
        value, list
    ) else []  # fmt: skip
    if not flat or not all(type(n) in (int, float) and math.isfinite(n) for n in flat):
        raise rule_error(
            "it is a matrix: rows of finite numbers, or the name of a CSV file of them",
            "Write [[0.0, 1.0], [-1.0, -0.2]], or for a diagonal of weights [1.0, 0.1]",
        )
    return value


Matrix = Annotated[list[Any] | str, PlainValidator(_rows)]
Numbers = float | list[float]


class MpcSection(FramesKeys):
    """The plant, the cost of the horizon, the limits, and the reference."""

    name: Literal["mpc"] = Field(description="the model")
    A: Matrix = Field(description="matrix of the plant, rows or a CSV file [1/s]")
    B: Matrix = Field(description="matrix of the inputs, rows or a CSV file")
    initial: list[float] = Field(description="state at the start, a number for each state")
    lower: Numbers = Field(description="least input, a number or one for each input")
    upper: Numbers = Field(description="greatest input, a number or one for each input")
    slew: Numbers | None = Field(
        None, description="largest change of an input between two steps of the horizon"
    )
    Q: Matrix | None = Field(None, description="weights of the states, 1 each if not given")
    R: Matrix | None = Field(None, description="weights of the inputs, 1 each if not given")
    horizon: int = Field(10, ge=1, le=100, description="number of predicted steps")
    step: Annotated[float, in_unit("s")] = Field(
        0.25, gt=0, description="length of a predicted step [s]"
    )
    reference: list[float] | str | None = Field(
        None, description="state that is wanted, or a CSV file of it over time; 0 if not given"
    )
    reference_kind: Literal["constant", "linear"] = Field(
        "linear", description="how rows of the file are joined: held until the next, straight lines"
    )
    disturbance: list[float] | str | None = Field(
        None, description="what is added to x', or a CSV file of it over time; 0 if not given"
    )
    states: dict[str, str] = Field({}, description="names of the states and their units")
    inputs: dict[str, str] = Field({}, description="names of the inputs and their units")
    t_end: Annotated[float, in_unit("s")] = Field(20.0, gt=0, description="end of the run [s]")


def _at(table: Table, ts: np.ndarray) -> np.ndarray:
    """Return the rows of a table at these times."""
    return np.asarray(jax.vmap(table.value)(ts))


def _matrix(given: Any, name: str, path: Path | None) -> np.ndarray:
    """Return the matrix of a file, of rows, or, for weights, of a diagonal."""
    if path is not None:
        return read_matrix(path)
    if name in "QR" and not any(isinstance(row, list) for row in given):
        return np.diag(np.array(given, float))
    widths = {len(row) if isinstance(row, list) else 0 for row in given}
    if len(widths) != 1 or widths == {0}:
        raise input_error(
            f"model.{name}", str(given)[:70], "it has rows of one length", "Write [[0.0], [1.0]]"
        )
    return np.array(given, float)


def _holding(A: np.ndarray, B: np.ndarray, reference: Table) -> tuple[Table, float]:
    """Return the inputs that hold the reference best, and the largest |x'| that remains."""
    if not len(A) == A.shape[1] == len(B):
        return reference, 0.0  # the controller rejects these matrices
    push = np.asarray(reference.values) @ A.T
    inputs = np.linalg.lstsq(B, -push.T, rcond=None)[0].T
    miss = float(np.linalg.norm(push + inputs @ B.T, axis=1).max())
    return Table(reference.times, inputs, reference.kind), miss


class MpcApplication(AbstractModelApplication):
    """States against their reference, and inputs within their limits."""

    section = MpcSection
    files = ("A", "B", "Q", "R", "reference", "disturbance")
    end = "model.t_end"
    keys: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "target": ("reference",), "feed": ("reference",), "x0": ("initial",),
    }  # fmt: skip
    certified = False  # steps for a proved bound are a thousand times as many

    def __init__(self, table: MpcSection, paths: Mapping[str, Path], quiet: bool):
        self.table = table
        problems, found = Problems(), dict[str, np.ndarray]()
        for name in "ABQR":
            if getattr(table, name) is not None:
                with problems.collect():
                    found[name] = _matrix(getattr(table, name), name, paths.get(name))
        problems.raise_any()
        n, m = found["A"].shape[0], found["B"].shape[1]
        if found["A"].shape[1] != n:
            raise input_error(
                "model.A", f"{n} rows of {found['A'].shape[1]} numbers", "it is square",
                "Write a row and a column for each state",
            )  # fmt: skip
        self.weights = (found.setdefault("Q", np.eye(n)), found.setdefault("R", np.eye(m)))
        with problems.collect():
            self.state_units = self._units("states", "x", n)
        with problems.collect():
            self.input_units = self._units("inputs", "u", m)
        problems.raise_any()
        with problems.collect():
            x0 = self._state("initial", table.initial)
        with problems.collect():
            push = self._rows("disturbance", "linear", paths)
        with problems.collect():
            self.reference = self._rows("reference", table.reference_kind, paths)
        problems.raise_any()
        self.feed, self.miss = _holding(found["A"], found["B"], self.reference)
        self.mpc = LinearMPC(
            **found, horizon=table.horizon, step=table.step, slew=table.slew, lower=table.lower,
            upper=table.upper, target=self.reference, feed=self.feed, disturbance=push,
        )  # fmt: skip
        model = Model(
            self.mpc.problem, x0, table.t_end, states=self.state_units, responses={"plan": ""},
            settings={"method": ETD4RK(), "rtol": 1e-6, "atol": 1e-9},
        )  # fmt: skip
        self.set_model(model, None)

    @property
    def fit(self) -> str:
        return self.mpc.fit

    def _units(self, which: str, symbol: str, size: int) -> dict[str, str]:
        """Return the names of the states or inputs with their units."""
        given = getattr(self.table, which)
        if given and len(given) != size:
            raise input_error(
                f"model.{which}", ", ".join(given), f"it has a name for each of the {size} {which}",
                "Add or remove names",
            )  # fmt: skip
        return given or {f"{symbol}{k + 1}": "" for k in range(size)}

    def _state(self, key: str, given: Any) -> np.ndarray:
        """Return a list of numbers, one for each state."""
        n = len(self.state_units)
        if len(given) != n:
            raise input_error(
                f"model.{key}", f"{len(given)} numbers", f"it has one for each of the {n} states",
                "Add or remove numbers",
            )  # fmt: skip
        return np.array(given, float)

    def _rows(
        self, key: str, kind: Literal["constant", "linear"], paths: Mapping[str, Path]
    ) -> Table:
        """Return states over time: from a file, or the same one all the time."""
        given, end = getattr(self.table, key), self.table.t_end
        if not isinstance(given, str):
            row = np.zeros(len(self.state_units)) if given is None else self._state(key, given)
            return Table(np.array([0.0, end]), np.stack([row, row]), kind)
        path, is_reference = paths[key], key == "reference"
        units = {n: u if is_reference else f"({u or '1'})/s" for n, u in self.state_units.items()}
        data = read_history(path, units, "s").check_covers(path, end, "s")
        missing = [name for name in units if name not in data.columns]
        if missing and is_reference:
            raise input_error(
                path.name, f"no column {', '.join(missing)}",
                "a reference has a column for each state", "Add it: 0 for a velocity at rest",
            )  # fmt: skip
        zero = np.zeros(len(data.times))
        return Table(data.times, np.stack([data.columns.get(n, zero) for n in units], axis=1), kind)

    @cached_property
    def verification(self) -> Any:
        """Constants, with a norm in which the closed loop contracts where one can be searched for."""
        size = len(self.state_units) + len(self.mpc.H)
        energy = size <= MAX_UNKNOWNS and importlib.util.find_spec("clarabel") is not None
        return verify(self.own.problem, self.own.x0, 0.0, self.t_end, energy=energy)

    def sizes(self) -> list[tuple[str, str, str]]:
        table = self.table
        gain = min(bound for bound in self.mpc.lipschitz if bound is not None)
        return [
            ("horizon", f"{table.horizon} steps", f"of {table.step:g} s"),
            ("inputs", str(len(self.input_units)), ", ".join(self.input_units)),
            ("gain of the controller", f"{gain:.4g}", "proved bound on |Δu|/|Δx|"),
        ]

    def notes(self) -> tuple[str, ...]:
        found = []
        if self.miss > 1e-9:
            found.append(
                f"model.reference is no rest of the plant: no input holds it, and x' is up to "
                f"{self.miss:.3g} there, so that the state stays away from it."
            )
        low, high = np.asarray(self.mpc.lower), np.asarray(self.mpc.upper)
        values = np.asarray(self.feed.values)
        if np.any((values < low) | (values > high)):
            found.append(
                "The input that holds model.reference is beyond model.lower or model.upper."
            )
        if self.constants is not None and self.constants.energy is None:
            found.append(
                "No norm is known in which the closed loop contracts, and bounds on its error "
                f"grow fast: pip install 'dvax[energy]' for a search, of up to {MAX_UNKNOWNS} unknowns."
            )
        return tuple(found)

    def series(self, solution: Solution, bound: Certificate | None) -> Mapping[str, Variable]:
        times, x, u = (np.asarray(v) for v in (solution.ts, solution.xs, solution.us))
        wanted, u, time, found = (
            _at(self.reference, times),
            u[:, : len(self.input_units)],
            ("time",),
            {},
        )
        for k, (name, unit) in enumerate(self.state_units.items()):
            key = f"reference_{store_name(name)}"
            found[key] = Variable(time, wanted[:, k], unit, f"reference of {name}")
        low, high = np.asarray(self.mpc.lower), np.asarray(self.mpc.upper)
        for k, (name, unit) in enumerate(self.input_units.items()):
            for prefix, values, words in (
                ("input", u[:, k], "input"), ("input_min", np.full(times.shape, low[k]), "least"),
                ("input_max", np.full(times.shape, high[k]), "greatest"),
            ):  # fmt: skip
                key = f"{prefix}_{store_name(name)}"
                found[key] = Variable(time, values, unit, f"{words} {name}")
        apart, moved = x - wanted, u - _at(self.feed, times)
        rate = np.einsum("ti,ij,tj->t", apart, self.weights[0], apart)
        rate += np.einsum("ti,ij,tj->t", moved, self.weights[1], moved)
        at_limit = ((u <= low) | (u >= high)).any(axis=1).astype(float)
        found["weighted_squares"] = Variable(time, rate, "", "cost of a unit of time")
        found["at_limit"] = Variable(time, at_limit, "1", "1 where an input is at a limit")
        return {**self.named(solution), **self.bound_series(bound), **found}

    def figures(
        self, series: Mapping[str, np.ndarray], end: Solution, bound: Certificate | None
    ) -> Mapping[str, Figure]:
        times = series["time"]
        figures = {
            f"largest_{name}": Figure(
                float(np.abs(series[f"input_{store_name(name)}"]).max()), unit,
                f"largest |{name}| at the saved times",
            )
            for name, unit in self.input_units.items()
        }  # fmt: skip
        last = np.asarray(end.xs)[-1] - _at(self.reference, times[-1:])[0]
        limited = np.trapezoid(series["at_limit"], times) / (times[-1] - times[0] or 1.0)
        figures |= {
            "final_distance": Figure(
                float(np.linalg.norm(last)), "", f"|x − reference| at t = {times[-1]:g} s"
            ),
            "closed_loop_cost": Figure(
                float(np.trapezoid(series["weighted_squares"], times)), "s",
                "integral of the weighted squares, from the saved times",
            ),
            "time_at_limit": Figure(float(limited), "1", "part of the time with an input at a limit"),
        }  # fmt: skip
        c = self.constants
        if c is not None and c.energy is not None and c.energy[1] < 0:
            words = "two states certainly approach at this rate, after an overshoot of {:.3g}"
            figures["decay_rate"] = Figure(
                -float(c.energy[1]), "1/s", words.format(float(c.energy[0]))
            )
        return self.joined(self.final_values(end) | self.bound_figure(bound), figures)


APPLICATION = MpcApplication
