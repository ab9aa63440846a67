"""The contact law with sliders for its parameters, solved again at each move.

All calls of `dvax.solve` share one compiled program, since the parameters are its arguments. The
derivative in a parameter is that of the computed solution (`jax.jvp`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dvax.app.explore import run_drawings
from dvax.app.explore.contact_data import LETTERS, Data
from dvax.app.explore.contact_drawings import ContactFrames, Fields, Prediction, drawings
from dvax.app.explore.files import code_of_configuration, configuration_text
from dvax.app.explore.recent import Recent
from dvax.app.explore.separable import separated
from dvax.app.explore.stability import plane
from dvax.app.explore.subject import (
    AbstractSubject,
    Answer,
    Certificate,
    Drawing,
    Number,
    Parameter,
    Question,
    Values,
    value_text,
)
from dvax.app.plots.theme import unit_text
from dvax.app.runs.config import build_contact, load_config
from dvax.app.runs.contact_figures import Figures
from dvax.app.runs.contact_frames import norm_unit
from dvax.app.runs.fields import Field
from dvax.app.runs.keys import set_key
from dvax.app.runs.settings import Config
from dvax.app.runs.solver_options import settings
from dvax.evolution import solve
from dvax.evolution.rows import all_finite
from dvax.models import Contact
from dvax.theory import bound_error

DEFAULT = Path(__file__).with_name("contact.toml")

_FACTORS = {"demand.value": "factor of the demand g", "load.value": "factor of the load ℓ"}
_HEADLINES = (
    "peak_pressure", "peak_pressure_time", "peak_force", "final_force", "peak_indentation",
    "peak_saturated_fraction", "peak_unloaded_fraction", "decay_rate", "sharp_decay_rate", "steps",
)  # fmt: skip


@dataclass(frozen=True)
class _Solved:
    fields: Fields
    numbers: list[Number]
    certificate: Certificate


class ContactSubject(AbstractSubject):
    """A configuration of the contact law. `config` is checked and complete."""

    def __init__(self, config: Config):
        self.config, self.inputs = config, build_contact(config)
        inputs = self.inputs
        self.data = Data(
            separated(_without_factor(inputs.demand), inputs.boundary),
            separated(_without_factor(inputs.load), inputs.boundary),
            jnp.asarray(inputs.boundary.weights),
            jnp.asarray(inputs.x0),
        )
        self.title = "Contact law"
        if config.source != DEFAULT:
            self.title += f", {config.source.stem}"
        points = " × ".join(map(str, inputs.boundary.shape))
        self.subtitle = f"{points} points, {len(inputs.frame_times)} saved times"
        self.parameters = _parameters(config)
        self.planes = tuple(p.key for p in self.parameters)
        self.exports = ("configuration", "code")
        self._labels = {p.key: p for p in self.parameters}
        self._solved: Recent[_Solved] = Recent(4)
        self._slopes: Recent[np.ndarray] = Recent(4)

    def solve(self, question: Question, check: Callable[[], None]) -> Answer:
        solved, prediction, has_more = self._solve(question.values), None, False
        if question.slider is not None:
            # At the first time it is compiled, which takes seconds.
            place = (_key(question.base), question.slider)
            has_more = not question.derivative and self._slopes.get(place) is None
            prediction = None if has_more else self._predict(question, question.slider)
        fields = solved.fields
        return Answer(
            drawings(fields, prediction),
            solved.numbers,
            solved.certificate,
            ContactFrames(fields, prediction),
            "" if prediction is None else prediction.sentence,
            has_more,
            notes=self.inputs.notices,
        )

    def derivative(self, values: Values, key: str) -> np.ndarray:
        """Return the derivative of the pressure in a parameter, (frames, points)."""
        place = (_key(values), key)
        found = self._slopes.get(place)
        if found is None:
            direction = {name: jnp.asarray(float(name == key)) for name in values}
            arrays = {name: jnp.asarray(float(v)) for name, v in values.items()}
            slope = _slope(
                arrays, direction, self.data, self._times, float(self._times[-1]), self._settings
            )
            found = self._slopes.put(place, np.asarray(slope))
        return found

    def stability_map(self, values: Values, across: str, upward: str) -> Drawing:
        axes = self._labels[across], self._labels[upward]
        return plane(self.data, self.inputs.companion_x0, self._times, self.config, values, axes)

    def export(self, kind: str, values: Values) -> tuple[str, str]:
        tree = self.config.tree()
        for key, value in values.items():
            set_key(tree, key, value)
        name = f"{self.config.source.stem}_explored"
        if kind == "configuration":
            files = [file for _, file in self.config.data_files()]
            return f"{name}.toml", configuration_text(tree, files)
        return f"{name}.py", code_of_configuration(tree, self.config.source)

    @property
    def _times(self) -> np.ndarray:
        return self.inputs.frame_times

    @property
    def _settings(self) -> dict[str, Any]:
        return settings(self.config.solver)

    def _solve(self, values: Values) -> _Solved:
        found = self._solved.get(_key(values))
        return found or self._solved.put(_key(values), self._compute(values))

    @np.errstate(over="ignore", invalid="ignore")  # a bound that overflows is infinite
    def _compute(self, values: Values) -> _Solved:
        model, config, inputs = self.data.model(values), self.config, self.inputs
        problem, constants = model.problem, model.constants
        times = self._times
        solution = solve(
            problem, self.data.x0, 0.0, float(times[-1]), None, times, constants=constants,
            measure=True, horizon=config.time.end, **self._settings,
        )  # fmt: skip
        solution = all_finite(solution, 0.0)
        bound = bound_error(problem, solution, constants)
        assert bound.x_sharp is not None and solution.law_error is not None
        rows = {
            "pressure": solution.ys,
            "indentation": solution.xs,
            "regime": _regimes(model, solution.ts, solution.xs),
            "error_bound_x": bound.x_paper,
            "error_bound_u": bound.u_paper,
            "error_bound_sharp_x": bound.x_sharp,
            "law_error": solution.law_error,
            # There is one trajectory here, and not two.
            "separation_x": np.full(len(times), np.nan),
        }
        rows = {name: np.asarray(v) for name, v in rows.items()}
        changed = config.model.model_copy(
            update={"kappa0": values["model.kappa0"], "beta": values["model.beta"]}
        )
        figures = Figures(inputs, config.model_copy(update={"model": changed}), constants)
        figures.add(times, rows, bound.status)
        summary = {n: f.to_json() for n, f in figures.summary(int(solution.stats["steps"])).items()}
        fields = Fields(
            times, inputs.boundary, config.units, values["model.kappa0"], rows["pressure"],
            rows["regime"].astype(np.int8), np.asarray(bound.x), np.asarray(bound.u), bound.status,
            norm_unit(config, len(inputs.boundary.names)),
        )  # fmt: skip
        numbers = run_drawings.numbers({name: summary[name] for name in _HEADLINES})
        return _Solved(fields, numbers, run_drawings.certificate(summary))

    def _predict(self, question: Question, key: str) -> Prediction:
        parameter = self._labels[key]
        start = question.base[key]
        change = question.values[key] - start
        aim = question.values[key] if change else start + parameter.step(start)
        base = self._solve(question.base).fields.pressure
        pressure = base + (aim - start) * self.derivative(question.base, key)
        unit = unit_text(parameter.unit)
        letter = parameter.label.partition(",")[0]
        return Prediction(
            pressure,
            f"predicted for {letter} = {value_text(aim)}",
            f"Dashed: {letter} from {value_text(start)} to {value_text(aim)} {unit}".rstrip()
            + ", to first order.",
        )


def load_default() -> Config:
    """Return the configuration that is explored without a file."""
    return load_config(DEFAULT)


@eqx.filter_jit
def _slope(
    values: Mapping[str, Any],
    direction: Mapping[str, Any],
    data: Data,
    times: Any,
    end: float,
    options: dict[str, Any],
) -> jax.Array:
    """Return the derivative of the pressure at all times in this direction of the parameters."""

    def pressure(values: Mapping[str, Any]) -> Any:
        solution = solve(
            data.model(values).problem, data.x0, 0.0, end, None, times, adjoint="forward",
            horizon=end, **options,
        )  # fmt: skip
        return solution.ys

    return jax.jvp(pressure, (values,), (direction,))[1]


@jax.jit
def _regimes(model: Contact, ts: Any, xs: Any) -> jax.Array:
    return jax.vmap(model.regimes)(ts, xs)


def _without_factor(given: Field) -> Field:
    return replace(given, constant=1.0)


def _key(values: Values) -> tuple[tuple[str, float], ...]:
    return tuple(sorted(values.items()))


def _parameters(config: Config) -> tuple[Parameter, ...]:
    found = []
    for key, (letter, words, kind) in LETTERS.items():
        value = float(getattr(config.model, key.removeprefix("model.")))
        unit = config.units.of(kind)
        if value > 0:
            low, high = value / 10, 10 * value
            found.append(Parameter(key, f"{letter}, {words}", unit, low, high, value, log=True))
        else:  # b_u alone may be zero
            found.append(Parameter(key, f"{letter}, {words}", unit, 0.0, 2.0, value))
    for key, words in _FACTORS.items():
        given = getattr(config, key.partition(".")[0]).value
        value = 1.0 if given is None else float(given)
        low, high = sorted((-value, 3 * value)) if value else (-1.0, 1.0)
        found.append(Parameter(key, words, "", low, high, value))
    return tuple(found)
