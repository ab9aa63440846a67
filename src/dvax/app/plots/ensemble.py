"""The picture of a `dvax.Ensemble` over time: quantiles of the members, and their mean."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.figure import Figure

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
    name: str,
    unit: str,
    time_unit: str,
    title: str | None,
    backend: str,
    axes: Sequence[Axes] | None,
) -> Figure | go.Figure:
    """Return the figure of `Ensemble.plot`, whose docstring has the arguments."""
    times = np.asarray(ts, float)
    low, high = (leaves_of(q, name) for q in map(ensemble.quantile, quantiles))
    means = leaves_of(ensemble.mean, name)
    words = f"{100 * (quantiles[1] - quantiles[0]):g} % of the members"
    panels: list[AbstractPanel] = []
    for label, mean in means.items():
        rows = np.asarray(mean, float)
        if times.ndim != 1 or rows.ndim == 0 or len(rows) != len(times) or len(times) < 2:
            raise input_error(
                f"{PLACE}(ts)", f"{np.size(times)} times for {label} of shape {rows.shape}",
                "an ensemble keeps no times; these are the ones of ts= in dvax.ensemble, at least two",
                "Pass the same ts to dvax.ensemble and to plot",
            )  # fmt: skip
        flat, below, above = (
            np.asarray(v, float).reshape(len(times), -1) for v in (rows, low[label], high[label])
        )
        entries = flat.shape[1]
        if entries > MOST_CURVES:
            raise input_error(
                PLACE, f"{entries} entries of {label}", f"up to {MOST_CURVES} entries are drawn",
                "Observe fewer: observe=lambda sol: sol.xs[:, :3]",
            )  # fmt: skip
        names = [label] if entries == 1 else [f"{label}[{k}]" for k in range(entries)]
        each = "" if entries == 1 else f"{label}[{{}}], "
        bands = [
            Band(times, below[:, k], above[:, k], each.format(k) + words, k) for k in range(entries)
        ]
        curves = [Curve(times, flat[:, k], f"{n}, mean", k) for k, n in enumerate(names)]
        panels.append(Panel(curves, label, unit, bands=tuple(bands)))
    failed = int(np.sum(np.asarray(ensemble.failed)))
    text = f"{number(len(ensemble))} members" + (f", {number(failed)} failed" if failed else "")
    return finished(panels, text if title is None else title, time_unit, backend, axes, PLACE)
