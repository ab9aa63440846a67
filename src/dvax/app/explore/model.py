"""A ready model, or a problem of one's own, with sliders for the numbers of its configuration.

At each move the configuration is checked and solved as by `dvax run`, but in fewer pieces, in memory.
Programs that are compiled for one value serve the next where the numbers of a problem are arguments of
them. The derivative in a parameter is a difference quotient of two runs.
"""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dvax.app.explore import run_drawings
from dvax.app.explore.drawing import PREDICTED
from dvax.app.explore.files import code_of_configuration, configuration_text
from dvax.app.explore.recent import Recent
from dvax.app.explore.sliders import sliders
from dvax.app.explore.subject import (
    AbstractFrames,
    AbstractSubject,
    Answer,
    Certificate,
    Drawing,
    Number,
    Question,
    Values,
    value_text,
)
from dvax.app.plots.store import Variable
from dvax.app.plots.theme import unit_text
from dvax.app.runs.applications.base import Figure
from dvax.app.runs.applications.config import OWN, ModelConfig, check_config
from dvax.app.runs.applications.segments import join_pieces, padded, segment_length, segments
from dvax.app.runs.keys import set_key
from dvax.app.runs.toml_file import read_toml
from dvax.errors import input_error
from dvax.evolution import Solution

_DIFFERENCE = 1e-3
"""The step of a difference quotient, relative to the value: large against tolerances of 1e-6."""
_PARTS = 8
"""The number of solves of a run. Between two of them it ends if there is a newer question."""


@dataclass(frozen=True)
class _Ran:
    """A run in memory."""

    variables: Mapping[str, Variable]
    drawings: list[Drawing]
    numbers: list[Number]
    certificate: Certificate
    frames: AbstractFrames | None
    notes: tuple[str, ...]


class ModelSubject(AbstractSubject):
    """A configuration of an application."""

    def __init__(self, config: ModelConfig, allow_outside: bool):
        self.config, self._allow_outside = config, allow_outside
        self.title = config.title
        self.subtitle = f"model {config.name}, {config.model.fit}"
        self.parameters = sliders(config)
        self.planes, self.exports = (), ("configuration", "code")
        self._raw = read_toml(config.source)
        self._labels = {p.key: p for p in self.parameters}
        self._ran: Recent[_Ran] = Recent(8)

    def solve(self, question: Question, check: Callable[[], None]) -> Answer:
        ran = self._run(question.values, check)
        key = question.slider
        drawings, prediction, has_more = ran.drawings, "", False
        if key is not None and not self._labels[key].whole:
            slope = self._slope(question.base, key, check, question.derivative)
            if slope is None:
                has_more = not question.derivative
            else:
                drawings, prediction = self._predicted(ran, slope, question, key)
        return Answer(
            drawings, ran.numbers, ran.certificate, ran.frames, prediction, has_more, ran.notes
        )

    def stability_map(self, values: Values, across: str, upward: str) -> Drawing:
        raise input_error(
            "the map of stability", self.config.name, "it is drawn for the contact law",
            "Explore a configuration of the contact law",
        )  # fmt: skip

    def export(self, kind: str, values: Values) -> tuple[str, str]:
        name, tree = f"{self.config.source.stem}_explored", self._tree(values)
        if kind == "configuration":
            files = [file for _, file in self.config.data_files()]
            return f"{name}.toml", configuration_text(tree, files)
        is_own = self.config.name == OWN
        return f"{name}.py", code_of_configuration(tree, self.config.source, is_own)

    def _tree(self, values: Values) -> dict[str, Any]:
        """Return the configuration with these values; a value that was not moved stays as written."""
        tree = copy.deepcopy(self._raw)
        for key, value in values.items():
            parameter = self._labels[key]
            if value != parameter.value:
                set_key(tree, key, round(value) if parameter.whole else value)
        return tree

    def _run(self, values: Values, check: Callable[[], None]) -> _Ran:
        place = tuple(sorted(values.items()))
        found = self._ran.get(place)
        return found or self._ran.put(place, self._compute(values, check))

    def _compute(self, values: Values, check: Callable[[], None]) -> _Ran:
        config = check_config(
            self._tree(values), self.config.source, allow_outside=self._allow_outside, quiet=True,
            allow_code=True,
        )  # fmt: skip
        assert isinstance(config, ModelConfig)  # the name of the model is that of before
        with config.wording.in_keys():
            variables, figures = _solved(config, check)
        summary = {name: figure.to_json() for name, figure in figures.items()}
        return _Ran(
            variables,
            run_drawings.of_variables(config.name, variables),
            run_drawings.numbers(summary),
            run_drawings.certificate(summary),
            run_drawings.frames(variables),
            config.model.notes(),
        )

    def _slope(
        self, base: Values, key: str, check: Callable[[], None], wanted: bool
    ) -> Mapping[str, np.ndarray] | None:
        """Return the difference quotients of all variables; None where the second run is not there and
        not `wanted`, or where it has other times."""
        step = _DIFFERENCE * (abs(base[key]) or 1.0)
        nearby = {**base, key: base[key] + step}
        if not wanted and self._ran.get(tuple(sorted(nearby.items()))) is None:
            return None
        first, second = (self._run(v, check).variables for v in (base, nearby))
        if any(v.shape != second[n].shape for n, v in first.items() if n in second):
            return None
        return {
            name: (second[name].values - v.values) / step
            for name, v in first.items()
            if name in second and np.issubdtype(v.dtype, np.floating)
        }

    def _predicted(
        self, ran: _Ran, slope: Mapping[str, np.ndarray], question: Question, key: str
    ) -> tuple[list[Drawing], str]:
        parameter, start = self._labels[key], question.base[key]
        change = question.values[key] - start
        aim = question.values[key] if change else start + parameter.step(start)
        base = self._run(question.base, lambda: None).variables
        moved = {
            name: Variable.of(v.values + (aim - start) * slope[name], v.dims, v.attrs)
            if name in slope
            else v
            for name, v in base.items()
        }
        predicted = {d.key: d for d in run_drawings.of_variables(self.config.name, moved)}
        words = f"{parameter.label}: {value_text(start)} → {value_text(aim)}"
        drawings = [_overlaid(d, predicted.get(d.key)) for d in ran.drawings]
        unit = unit_text(parameter.unit)
        return drawings, f"Dashed: {words} {unit}".rstrip() + ", by the difference quotient."


def _solved(
    config: ModelConfig, check: Callable[[], None]
) -> tuple[dict[str, Variable], Mapping[str, Figure]]:
    """Solve, and return the variables and the figures of a run.

    **Raises:** `dvax.SolveError`, and what `check` raises between two pieces.
    """
    model = config.model
    plan = model.plan(lambda words: check())
    length = segment_length(plan, _PARTS)
    pieces: list[Solution] = []
    rows: list[Mapping[str, Any]] = []
    end, bound = None, None
    # A single time has no piece.
    for piece in segments(plan, parts=_PARTS) if len(plan.times) > 1 else ():
        check()
        end = padded(piece, length)
        bound = model.bound(end, bound)
        rows.append(model.rows(end, bound, len(piece.ts)))
        pieces.append(piece)
    if not rows:
        rows.append(model.rows(None, None, 1))
    series = {name: np.concatenate([row[name].values for row in rows]) for name in rows[0]}
    whole = join_pieces(pieces, len(plan.times)) if model.whole and pieces else end
    results = model.results(series, whole, bound)
    variables = {
        name: Variable.of(
            np.asarray(series.get(name, v.values)), v.dims,
            {"units": v.unit, "long_name": v.words, "status": v.status},
        )
        for name, v in {**rows[-1], **results.fixed}.items()
    }  # fmt: skip
    return variables, results.figures


def _overlaid(drawing: Drawing, predicted: Drawing | None) -> Drawing:
    """Return a drawing with the curves of its prediction, where they differ from its own."""
    if predicted is None or len(predicted.data) != len(drawing.data):
        return drawing
    more: list[Any] = []
    if drawing.key == "certificate":  # a bound on the error of one run
        return drawing
    for own, other in zip(drawing.data, predicted.data, strict=True):
        if own.get("type") != "scatter" or own.get("mode") != "lines" or other.get("y") is None:
            continue
        if own["y"] == other["y"]:  # arrays are texts in base64 here
            continue
        curve = {k: v for k, v in other.items() if k not in ("fill", "stackgroup", "fillcolor")}
        curve |= {
            "line": {"color": PREDICTED, "dash": "dash", "width": 1.6}, "name": "predicted",
            "legendgroup": "predicted", "showlegend": not more,
        }  # fmt: skip
        more.append(curve)
    return Drawing(
        drawing.key, drawing.title, drawing.caption, [*drawing.data, *more],
        {**drawing.layout, "showlegend": True} if more else drawing.layout, drawing.views,
    )  # fmt: skip
