"""Histories at chosen points, beneath the load and the demand that drive them."""

from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.figure import Figure

from dvax.app.plots.downsample import Scan, blocks, edges
from dvax.app.plots.lines import thin
from dvax.app.plots.picture import Picture
from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.theme import (
    INK,
    MUTED,
    SERIES,
    STILL_STYLE,
    axis_title,
    blank,
    number,
    quantity,
    still_axes,
    unit_text,
)

DRIVERS = {"load_mean": "mean load ℓ", "demand_mean": "mean demand g"}
RESPONSES = {"pressure": "pressure p", "indentation": "indentation x"}


@dataclass(frozen=True)
class _Chosen:
    """Indices of the points whose histories are drawn, their names, and why these."""

    points: np.ndarray
    names: tuple[str, ...]
    why: str


def histories_picture(run: RunRecord, found: Scan) -> Picture:
    """Panels that share time: what drives the boundary above, what the points do below."""
    chosen = _choose(run, found)
    drivers = {name: run.series(name) for name in DRIVERS if run.has(name)}
    responses = {name: _columns(run, name, chosen.points) for name in RESPONSES}
    labels = DRIVERS | RESPONSES
    heights = (0.19,) * len(drivers) + (0.31,) * len(responses)
    figure = blank(170 * len(drivers) + 260 * len(responses), heights)
    # One frame alone has no line.
    mode, marker = ("lines", "") if len(run.time) > 1 else ("markers", "o")
    time_text = f"%{{x:.4g}} {unit_text(run.unit('time'))}"
    for row, (name, values) in enumerate(drivers.items(), start=1):
        shown = thin(run.time, values)
        figure.add_trace(
            go.Scatter(
                x=run.time[shown],
                y=values[shown],
                name=labels[name],
                mode=mode,
                showlegend=False,
                line=dict(color=INK, width=1.2),
                hovertemplate=f"%{{y:.4g}} {unit_text(run.unit(name))} at {time_text}",
            ),
            row=row,
            col=1,
        )
    for row, (name, columns) in enumerate(responses.items(), start=len(drivers) + 1):
        for point, values in enumerate(columns.T):
            shown = thin(run.time, values)
            figure.add_trace(
                go.Scatter(
                    x=run.time[shown],
                    y=values[shown],
                    name=chosen.names[point],
                    legendgroup=chosen.names[point],
                    showlegend=name == "pressure",
                    mode=mode,
                    line=dict(color=SERIES[point % len(SERIES)], width=1.6),
                    hovertemplate=f"%{{y:.4g}} {unit_text(run.unit(name))} at {time_text}",
                ),
                row=row,
                col=1,
            )
    kappa = run.frames.attrs.get("kappa0")
    if kappa is not None:
        span = edges(run.time)[[0, -1]]
        figure.add_trace(
            go.Scatter(
                x=span,
                y=[kappa, kappa],
                name="capacity κ₀",
                mode="lines",
                line=dict(color=MUTED, width=1, dash="dash"),
                hoverinfo="skip",
            ),
            row=len(drivers) + 1,
            col=1,
        )
    for row, name in enumerate([*drivers, *responses], start=1):
        title = labels[name] + (f"<br>[{unit_text(run.unit(name))}]" * bool(run.unit(name)))
        figure.update_yaxes(title_text=title, row=row, col=1)
    last = len(drivers) + len(responses)
    figure.update_xaxes(title_text=axis_title("time", run.unit("time")), row=last, col=1)

    def still() -> Figure:
        with rc_context(STILL_STYLE):
            drawn, panels = still_axes(
                len(heights),
                1,
                figsize=(8, 8),
                sharex=True,
                height_ratios=heights,
            )
            for axes, (name, values) in zip(panels, drivers.items(), strict=False):
                axes.plot(run.time, values, color=INK, linewidth=0.9, marker=marker)
                axes.set_ylabel(axis_title(labels[name] + "\n", run.unit(name)))
            for axes, (name, columns) in zip(
                panels[len(drivers) :], responses.items(), strict=True
            ):
                for point, values in enumerate(columns.T):
                    colour = SERIES[point % len(SERIES)]
                    name_text = chosen.names[point]
                    axes.plot(
                        run.time, values, color=colour, label=name_text, lw=1.3, marker=marker
                    )
                axes.set_ylabel(axis_title(labels[name] + "\n", run.unit(name)))
            if kappa is not None:
                capacity = panels[len(drivers)]
                capacity.axhline(kappa, color=MUTED, lw=0.9, ls="--", label="capacity κ₀")
            panels[len(drivers)].legend(
                ncols=4 if len(run.boundary_shape) == 1 else 2,
                loc="lower left",
                bbox_to_anchor=(0, 1.0),
                fontsize=9,
                borderpad=0.2,
            )
            panels[0].set_title("Histories at chosen points")
            panels[-1].set_xlabel(axis_title("time", run.unit("time")))
            drawn.align_ylabels()
        return drawn

    capacity = (
        f" The dashed line is the capacity κ₀ = {quantity(kappa, run.unit('pressure'))}."
        if kappa is not None
        else ""
    )
    return Picture(
        key="histories",
        title="Histories at chosen points",
        caption=f"{chosen.why}{capacity} Load and demand are averages over the boundary.",
        interactive=figure,
        still=still,
    )


def _choose(run: RunRecord, found: Scan) -> _Chosen:
    """The points that the configuration asks for; without any, three that tell the run apart."""
    asked = run.config.get("output", {}).get("points_of_interest") or []
    if asked:
        nearest = [_nearest(run, np.atleast_1d(np.asarray(place, float))) for place in asked]
        points = np.array(list(dict.fromkeys(nearest)))
        why = "The points nearest to those that the configuration names."
    else:
        order = np.argsort(found.time_mean, kind="stable")
        ends = [order[-1], order[len(order) // 2], order[0]]
        points = np.array(list(dict.fromkeys(int(i) for i in ends)))
        why = "The points of the highest, the median and the lowest mean pressure."
    return _Chosen(points, tuple(_place(run, int(point)) for point in points), why)


def _coordinates(run: RunRecord) -> list[str]:
    return ["s"] if len(run.boundary_shape) == 1 else ["s1", "s2"]


def _nearest(run: RunRecord, place: np.ndarray) -> int:
    axes = [run.frames.line(name).astype(float) for name in _coordinates(run)]
    distance = sum((axis - value) ** 2 for axis, value in zip(axes, place, strict=True))
    return int(np.argmin(distance))


def _place(run: RunRecord, point: int) -> str:
    parts = []
    for name in _coordinates(run):
        value = number(float(run.frames.line(name)[point]), 6)
        parts.append(f"{name} = {value} {unit_text(run.unit(name))}".strip())
    return ", ".join(parts)


def _columns(run: RunRecord, name: str, points: np.ndarray) -> np.ndarray:
    """The histories of a field at `points`, shape (frames, points), read block by block."""
    parts = [run.frames.field(name, block)[:, points] for block in blocks(run)]
    return np.concatenate(parts).astype(float)
