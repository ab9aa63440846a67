"""Pictures of traffic: convergence to the equilibrium, and the load of the network."""

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from matplotlib import colormaps, rc_context
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from dvax.app.plots.panels import Curve, Panel, bound_panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable
from dvax.app.plots.theme import INK, STILL_STYLE, blank, still_axes

_BUSIEST = 5
_MAP = "viridis"
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
        f"Above, {words}. In the middle, the links that are the fullest in the end. Below, the bound "
        "on the error of the path flows.",
        [
            above,
            Panel(links, "flow / capacity"),
            bound_panel(days, data["error_bound"], "trip", _BUSIEST + 1, share=0.7),
        ],
        "time", "day",
    )  # fmt: skip


def _map(data: Mapping[str, Variable]) -> Picture:
    place = data["place"].values.astype(float)
    first, last = (data[name].values.astype(int) - 1 for name in ("init_node", "term_node"))
    load = data["flow"].values[-1] / data["capacity"].values[-1]
    along = place[last] - place[first]
    length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    right = np.column_stack([along[:, 1], -along[:, 0]]) / length
    aside = _LINK_OFFSET * np.ptp(place, axis=0).max() * right
    ends = np.stack([place[first] + aside, place[last] + aside], axis=1)
    top = float(np.quantile(load, 0.98))
    shades = colormaps[_MAP](np.clip(load / top, 0.0, 1.0))
    figure = blank(620)
    for k, (a, b) in enumerate(ends):
        figure.add_trace(
            go.Scatter(
                x=[a[0], b[0]], y=[a[1], b[1]], mode="lines", showlegend=False,
                line=dict(color=to_hex(shades[k]), width=4),
                text=f"{first[k] + 1} → {last[k] + 1}: {load[k]:.2f} of its capacity",
                hovertemplate="%{text}<extra></extra>",
            )
        )  # fmt: skip
    figure.add_trace(
        go.Scatter(
            x=place[:, 0], y=place[:, 1], mode="markers+text", showlegend=False,
            text=[str(k + 1) for k in range(len(place))], textposition="middle center",
            textfont=dict(size=9, color=INK), hoverinfo="skip",
            marker=dict(
                size=17, color=np.zeros(len(place)), colorscale=[[0, "white"], [1, "white"]],
                line=dict(color=INK, width=1),
            ),
        )
    )  # fmt: skip
    figure.add_trace(
        go.Scatter(
            x=[None], y=[None], mode="markers", showlegend=False,
            marker=dict(
                colorscale=_MAP.capitalize(), cmin=0.0, cmax=top, color=[0.0],
                colorbar=dict(title=dict(text="flow / capacity", side="right")),
            ),
        )
    )  # fmt: skip
    figure.update_xaxes(visible=False)
    figure.update_yaxes(visible=False, scaleanchor="x")

    def still() -> Figure:
        with rc_context({**STILL_STYLE, "axes.grid": False}):
            drawn, axes = still_axes(figsize=(8, 8))
            lines = LineCollection(list(ends), array=load, cmap=_MAP, linewidths=3.0)
            lines.set_clim(0.0, top)
            axes.add_collection(lines)
            axes.scatter(place[:, 0], place[:, 1], s=130, c="white", edgecolors=INK, zorder=3)
            for k, (x, y) in enumerate(place):
                axes.text(x, y, str(k + 1), ha="center", va="center", fontsize=7, zorder=4)
            axes.set_aspect("equal")
            axes.set_axis_off()
            axes.set_title("How full the links are in the end")
            drawn.colorbar(lines, label="flow / capacity", shrink=0.7)
        return drawn

    return Picture(
        key="map", title="How full the links are in the end",
        caption="Of the two lines between nodes, each is on the right of its direction.",
        interactive=figure, still=still,
    )  # fmt: skip
