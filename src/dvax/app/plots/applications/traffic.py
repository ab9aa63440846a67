"""Pictures of traffic: convergence to the equilibrium, and the load of the network."""

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from dvax.app.plots.downsample import rounded
from dvax.app.plots.panels import Curve, Panel, panels_picture, value_range
from dvax.app.plots.picture import Change, Frames, Picture
from dvax.app.plots.store import Variable
from dvax.app.plots.theme import (
    INK,
    MUTED,
    STILL_STYLE,
    SURFACE,
    blank,
    number,
    pressure_bar,
    still_axes,
)

_BUSIEST = 5
_MAP, _MOMENTS = "viridis", 97
_LINK_OFFSET = 0.012
"""How far, of the size of the map, a link is drawn to the right of the line between its nodes."""


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """The objective and the busiest links over the days; the map, where places are known."""
    found = [_days(data)]
    if "place" in data:
        found.append(_map(data))
    return found


def _days(data: Mapping[str, Variable]) -> Picture:
    days, objective = data["day"].values, data["objective"].values
    least = float(data["equilibrium"].values)
    if np.isfinite(least):
        excess = (objective - least) / least
        # Below this, the difference of two objectives is roundoff.
        shown = np.where(excess > 1e-15, excess, np.nan)
        above = Panel([Curve(days, shown, "excess", 0)], "objective, excess", log=True)
        words = "by what part Beckmann's objective is larger than at the equilibrium"
    else:
        above = Panel([Curve(days, objective, "objective", 0)], "objective")
        words = "Beckmann's objective, whose least value changes with the capacities"
    load = data["flow"].values / data["capacity"].values
    busiest = np.argsort(load[-1])[::-1][:_BUSIEST]
    names = [f"{data['init_node'].values[k]} → {data['term_node'].values[k]}" for k in busiest]
    links = [
        Curve(days, load[:, k], name, i + 1) for i, (k, name) in enumerate(zip(busiest, names))
    ]
    return panels_picture(
        "days", "The way to equilibrium",
        f"Above, {words}. Below, the links that are the fullest in the end.",
        [above, Panel(links, "flow / capacity")], "time", "day",
    )  # fmt: skip


def _map(data: Mapping[str, Variable]) -> Picture:
    place = data["place"].values.astype(float)
    first, last = (data[name].values.astype(int) - 1 for name in ("init_node", "term_node"))
    days = data["day"].values
    frames = np.unique(np.linspace(0, len(days) - 1, _MOMENTS).round().astype(int))
    loads = data["flow"].values[frames] / data["capacity"].values[frames]
    load = loads[-1]
    along = place[last] - place[first]
    length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    right = np.column_stack([along[:, 1], -along[:, 0]]) / length
    aside = _LINK_OFFSET * np.ptp(place, axis=0).max() * right
    ends = np.stack([place[first] + aside, place[last] + aside], axis=1)
    top = float(np.quantile(loads, 0.98))
    figure = blank(620)
    # A gap between any two links makes one trace of all of them.
    gaps = np.full((len(ends), 1, 2), np.nan)
    lines = np.concatenate([ends, gaps], axis=1).reshape(-1, 2)
    figure.add_trace(
        go.Scatter(
            x=lines[:, 0], y=lines[:, 1], mode="lines", showlegend=False, hoverinfo="skip",
            line=dict(color=MUTED, width=1),
        )
    )  # fmt: skip
    figure.add_trace(
        go.Scatter(
            x=place[:, 0], y=place[:, 1], mode="markers+text", showlegend=False,
            text=[str(k + 1) for k in range(len(place))], textposition="middle center",
            textfont=dict(size=9, color=INK), hoverinfo="skip",
            marker=dict(size=17, color=SURFACE, line=dict(color=INK, width=1)),
        )
    )  # fmt: skip
    # Arrows in the middle of the links: Plotly reads values off markers, and not off lines.
    middle = ends.mean(axis=1)
    figure.add_trace(
        go.Scatter(
            x=middle[:, 0], y=middle[:, 1], mode="markers", showlegend=False,
            text=[f"{a + 1} → {b + 1}" for a, b in zip(first, last)],
            hovertemplate="%{text}: %{marker.color:.3g} of its capacity<extra></extra>",
            marker=dict(
                symbol="arrow", size=18, angle=np.degrees(np.arctan2(along[:, 0], along[:, 1])),
                color=rounded(load), cmin=0.0, cmax=top, colorscale=_MAP.capitalize(),
                line=dict(color=MUTED, width=1),
                colorbar=pressure_bar(figure, "flow / capacity", 620),
            ),
        )
    )  # fmt: skip
    figure.update_xaxes(visible=False, constrain="domain")
    figure.update_yaxes(visible=False, scaleanchor="x", constrain="domain")
    labels = tuple(f"day {number(float(t))}" for t in days[frames])
    moments = Frames(
        days[frames], labels, (Change(2, "marker.color", rounded(loads)),), len(frames) - 1
    )

    def still() -> Figure:
        with rc_context({**STILL_STYLE, "axes.grid": False}):
            drawn, axes = still_axes(figsize=(8, 8))
            drawn_links = LineCollection(list(ends), array=load, cmap=_MAP, linewidths=3.0)
            drawn_links.set_clim(0.0, top)
            axes.add_collection(drawn_links)
            axes.scatter(place[:, 0], place[:, 1], s=130, c="white", edgecolors=INK, zorder=3)
            for k, (x, y) in enumerate(place):
                axes.text(x, y, str(k + 1), ha="center", va="center", fontsize=7, zorder=4)
            axes.set_aspect("equal")
            axes.set_axis_off()
            axes.set_title("How full the links are in the end")
            drawn.colorbar(drawn_links, label="flow / capacity", shrink=0.7)
        return drawn

    return Picture(
        "map", "How full the links are",
        "An arrow stands in the middle of each link and points along it. Of the two links between "
        "nodes, each is on the right of its direction. The slider chooses the day.",
        figure, still, frames=moments,
        alternative=f"A map of the network with {len(ends)} links; the flow over the capacity"
        f"{value_range(loads)} in colours, on {len(frames)} days that a slider chooses.",
    )  # fmt: skip
