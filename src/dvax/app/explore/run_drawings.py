"""Drawings of a run directory: the pictures of its report, fields at one saved time, and figures."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from dvax._figure_text import entry_text
from dvax.app.explore.contact_drawings import REGIME_WORDS
from dvax.app.explore.drawing import layout, line, of_picture, single
from dvax.app.explore.subject import AbstractFrames, Certificate, Drawing, Number
from dvax.app.plots.applications import application_pictures
from dvax.app.plots.certificate import certificate_picture
from dvax.app.plots.downsample import downsample, starts
from dvax.app.plots.histories import histories_picture
from dvax.app.plots.maps import REGIME_SCALE, map_pictures, shares_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.run_reader import CONTACT, RunRecord
from dvax.app.plots.separation import separation_picture
from dvax.app.plots.store import Variable
from dvax.app.plots.theme import MUTED, PRESSURE_MAP, SERIES, quantity, unit_text

Summary = Mapping[str, Mapping[str, Any]]
"""The content of summary.json."""
_SIDE = 256
"""The most cells of a map along each side."""
_MAX_FIELDS = 4
"""The most fields that are drawn."""
_OF_TIME = ("time", "hour", "day")
"""The names of the axis of saved times."""


@np.errstate(over="ignore", invalid="ignore")  # infinite values become gaps
def drawings(run: RunRecord) -> list[Drawing]:
    """Return the pictures of the report of a run."""
    if run.trajectory is None:
        return []
    if run.model != CONTACT:
        return of_variables(run.model, run.trajectory.variables)
    reduced = downsample(run)
    pictures: list[Picture | None] = [
        *map_pictures(run, reduced), shares_picture(run, reduced), histories_picture(run, reduced),
        certificate_picture(run), separation_picture(run),
    ]  # fmt: skip
    timed = {"pressure", "regimes"} if len(run.boundary_shape) == 1 else set[str]()
    return [of_picture(p, p.key in timed) for p in pictures if p is not None]


def of_variables(model: str, variables: Mapping[str, Variable]) -> list[Drawing]:
    """Return the pictures of an application for these variables."""
    return [of_picture(picture) for picture in application_pictures(model, variables)]


def numbers(summary: Summary) -> list[Number]:
    """Return the headline figures of a run."""
    return [
        Number(name.replace("_", " "), entry_text(entry), _unit(entry), str(entry.get("meaning", "")))
        for name, entry in summary.items()
        if name != "status"
    ]  # fmt: skip


def certificate(summary: Summary) -> Certificate:
    """Return what the summary of a run says about its error bounds."""
    bounds = {name: e for name, e in summary.items() if name != "law_error" and e.get("bound")}
    sentences = tuple(
        f"{str(e['meaning'])[:1].upper()}{str(e['meaning'])[1:]}: {entry_text(e)} {_unit(e)}".rstrip()
        + "."
        for e in bounds.values()
    )
    if not sentences:
        return Certificate("not known", ("This run has no error bound.",))
    found = {str(e["bound"]) for e in bounds.values()}
    order = ("not known", "estimated", "declared", "proved")
    return Certificate(next((s for s in order if s in found), "estimated"), sentences)


def frames(
    variables: Mapping[str, Variable], shape: tuple[int, ...] | None = None
) -> AbstractFrames | None:
    """Return the fields of a run at a saved time; None where its variables have none over time.
    `shape`: of the boundary of a contact law."""
    axis = next((name for name in _OF_TIME if name in variables), None)
    if axis is None:
        return None
    fields = [
        name
        for name, v in variables.items()
        if v.dims[:1] == (axis,) and len(v.shape) in (2, 3) and min(v.shape[1:]) > 1
    ]
    if not fields:
        return None
    return RunFrames(variables, axis, fields[:_MAX_FIELDS], shape)


class RunFrames(AbstractFrames):
    """Each field of a run at one saved time: a curve over its entries, or a map. `shape`: of the
    boundary of a contact law, whose fields are flattened."""

    def __init__(
        self, variables: Mapping[str, Variable], axis: str, names: list[str],
        shape: tuple[int, ...] | None,
    ):  # fmt: skip
        self._variables, self._names, self._shape = variables, names, shape
        self.times, self.unit = variables[axis].values.astype(float), variables[axis].unit
        self._ranges: dict[str, list[float]] = {}

    def draw(self, frame: int) -> list[Drawing]:
        at = quantity(float(self.times[frame]), self.unit)
        return [self._one(name, frame, at) for name in self._names]

    def _one(self, name: str, frame: int, at: str) -> Drawing:
        variable = self._variables[name]
        values = variable.frames(frame).astype(float)
        if self._shape is not None and len(self._shape) == 2:
            values = values.reshape(self._shape)
        title = f"{name.replace('_', ' ').capitalize()} at t = {at}"
        words = (name.replace("_", " "), variable.unit)
        draw = self._curve if values.ndim == 1 else self._map
        return draw(f"frame-{name}", title, values, words, variable)

    def _curve(
        self, key: str, title: str, values: np.ndarray, words: tuple[str, str], variable: Variable
    ) -> Drawing:
        x, across = self._axis(variable, len(values), 1)
        if variable.attrs.get("flag_meanings"):
            curve = line(x, values, words[0], MUTED, line={"shape": "hvh", "color": MUTED})
        else:
            curve = line(x, values, words[0], SERIES[0])
        return Drawing(
            key, title, "The vertical range is that of the whole run.", [curve],
            layout(300, across, words, yaxis={"range": self._range(words[0], variable)}),
        )  # fmt: skip

    def _map(
        self, key: str, title: str, values: np.ndarray, words: tuple[str, str], variable: Variable
    ) -> Drawing:
        rows, columns = (starts(n, _SIDE) for n in values.shape)
        shown = values[np.ix_(rows, columns)]
        names = ("s1", "s2") if self._shape is not None else variable.dims[1:]
        (x, across), (y, upward) = (self._named(n, k) for n, k in zip(names, values.shape))
        low, high = self._range(words[0], variable)
        is_regime = bool(variable.attrs.get("flag_meanings"))
        scale: dict[str, Any] = (
            {"colorscale": REGIME_SCALE, "zmin": -0.5, "zmax": 2.5}
            if is_regime
            else {"colorscale": PRESSURE_MAP.capitalize(), "zmin": low, "zmax": high}
        )
        data = {
            "type": "heatmap", "x": single(x[rows]), "y": single(y[columns]), "z": single(shown.T),
            "colorbar": {"title": {"text": unit_text(words[1]), "side": "right"}, "thickness": 12},
            **scale,
        }  # fmt: skip
        caption = f"Regimes: {REGIME_WORDS}." if is_regime else ""
        return Drawing(
            key, title, caption, [data],
            layout(
                420, across, upward, xaxis={"constrain": "domain"},
                yaxis={"scaleanchor": "x", "constrain": "domain"},
            ),
        )  # fmt: skip

    def _axis(
        self, variable: Variable, count: int, dimension: int
    ) -> tuple[np.ndarray, tuple[str, str]]:
        """Return coordinates along a dimension of a variable, and their name and unit."""
        name = "s" if self._shape is not None else variable.dims[dimension]
        return self._named(name, count)

    def _named(self, name: str, count: int) -> tuple[np.ndarray, tuple[str, str]]:
        known = self._variables.get(name)
        if known is None:
            return np.arange(1, count + 1), (f"number of the entry ({name})", "")
        values = known.values.astype(float)
        if self._shape is not None and len(self._shape) == 2:
            values = values.reshape(self._shape)
            values = values[:, 0] if name == "s1" else values[0]
        return values, (name.replace("_", " "), known.unit)

    def _range(self, key: str, variable: Variable) -> list[float]:
        """Return the range of a field over some of the saved times, read once."""
        if key not in self._ranges:
            rows = np.unique(np.linspace(0, len(self.times) - 1, 40).astype(int))
            some = [variable.frames(int(row)) for row in rows]
            low, high = float(np.nanmin(some)), float(np.nanmax(some))
            room = 0.05 * (high - low) or 1.0
            self._ranges[key] = [low - room, high + room]
        return self._ranges[key]


def _unit(entry: Mapping[str, Any]) -> str:
    return unit_text(str(entry.get("unit", "")))
