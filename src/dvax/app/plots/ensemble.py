"""The picture of a `dvax.Ensemble` over time: quantiles of the members, and their mean."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dvax._dataset import Names, named
from dvax.app.plots.panels import AbstractPanel, Band, Curve, Panel
from dvax.app.plots.solution import MOST_CURVES, finished
from dvax.app.plots.theme import number
from dvax.ensembles import Ensemble
from dvax.errors import input_error
from dvax.evolution.dataset import leaves_of

PLACE = "Ensemble.plot"


def plot_ensemble(
    ensemble: Ensemble,
    ts: Any,
    quantiles: tuple[float, float],
    *,
    names: Names,
    name: str,
    unit: str,
    time_unit: str,
    title: str | None,
    backend: str,
    axes: Sequence[Axes] | None,
) -> Figure | go.Figure:
    """Return the figure of `Ensemble.plot`, whose docstring has the arguments."""
    times = np.asarray(ts, float)
    trees = ensemble.mean, *map(ensemble.quantile, quantiles)
    for label, mean in leaves_of(ensemble.mean, name).items():
        if times.ndim != 1 or np.shape(mean)[:1] != times.shape or len(times) < 2:
            raise input_error(
                f"{PLACE}(ts)", f"{np.size(times)} times for {label} of shape {np.shape(mean)}",
                "an ensemble keeps no times; these are the ones of ts= in dvax.ensemble, at least two",
                "Pass the same ts to dvax.ensemble and to plot",
            )  # fmt: skip
    words = f"{100 * (quantiles[1] - quantiles[0]):g} % of the members"
    panels: list[AbstractPanel] = [
        _panel(times, series, of, words) for series, of in _panels(trees, names, name, unit)
    ]
    failed = int(np.sum(np.asarray(ensemble.failed)))
    text = f"{number(len(ensemble))} members" + (f", {number(failed)} failed" if failed else "")
    return finished(panels, text if title is None else title, time_unit, backend, axes, PLACE)


_Series = list[tuple[str, list[np.ndarray]]]
"""The names of entries, with the mean and the two quantiles of each over time."""


def _panels(
    trees: Sequence[Any], names: Names, name: str, unit: str
) -> Iterator[tuple[_Series, str]]:
    """Yield the entries of each panel and their unit: a panel for each part of the values, or with
    names for each unit."""
    if names:
        parts = [named(tree, names, name, f"{PLACE}(names)") for tree in trees]
        by_unit: dict[str, _Series] = {}
        for label, (_, of) in parts[0].items():
            by_unit.setdefault(of or "", []).extend(_entries(label, [p[label][0] for p in parts]))
        for of, series in by_unit.items():
            for begin in range(0, len(series), MOST_CURVES):
                yield series[begin : begin + MOST_CURVES], of
        return
    leaves = [leaves_of(tree, name) for tree in trees]
    for label in leaves[0]:
        series = _entries(label, [leaf[label] for leaf in leaves])
        if len(series) > MOST_CURVES:
            raise input_error(
                PLACE, f"{len(series)} entries of {label}", f"up to {MOST_CURVES} entries are drawn",
                "Observe fewer: observe=lambda sol: sol.xs[:, :3]",
            )  # fmt: skip
        yield series, unit


def _entries(label: str, arrays: Sequence[Any]) -> _Series:
    """Return the entries of one part, each by its name."""
    rows = [np.asarray(v, float).reshape(len(v), -1) for v in arrays]
    count = rows[0].shape[1]
    return [
        (label if count == 1 else f"{label}[{k}]", [v[:, k] for v in rows]) for k in range(count)
    ]


def _panel(times: np.ndarray, series: _Series, unit: str, words: str) -> Panel:
    # One name for all areas: they have the colours of the curves inside them.
    bands = [
        Band(times, low, high, words if k == 0 else "", k)
        for k, (_, (_, low, high)) in enumerate(series)
    ]
    curves = [Curve(times, mean, f"{n}, mean", k) for k, (n, (mean, _, _)) in enumerate(series)]
    shown = ", ".join(n for n, _ in series[:3]) + (", …" if len(series) > 3 else "")
    return Panel(curves, shown, unit, bands=tuple(bands))
