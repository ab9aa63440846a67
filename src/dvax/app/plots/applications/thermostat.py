"""Pictures of a heated floor: temperatures against the set point, heating, and the map at the end."""

from collections.abc import Mapping

import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.figure import Figure

from dvax.app.plots.panels import Curve, Panel, bound_panel, bound_title, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable
from dvax.app.plots.theme import STILL_STYLE, blank, still_axes

_MAP = "viridis"


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """Histories, the map where there is more than one cell, and the error bound."""
    t, unit = data["time"].values, data["time"].unit

    def curve(name: str, words: str, colour: int | None, dash: str = "solid") -> Curve:
        return Curve(t, data[name].values, words, colour, dash)

    means = [curve("mean_temperature", "mean", 0), curve("set_point", "set point", None, "dash")]
    is_field = data["temperature"].values[0].size > 1
    if is_field:
        means[1:1] = [curve("coldest", "coldest", 5, "dot"), curve("warmest", "warmest", 4, "dot")]
    limits = [curve(f"heating_{end}", "limits", None, "dash") for end in ("min", "max")]
    bound = data["error_bound"]
    found = [
        panels_picture(
            "histories", "Temperature and heating",
            "Heaters at a limit cannot hold the set point; between the limits the temperature stays "
            "below it by the power over the gain.",
            [
                Panel(means, "temperature", "degC", share=1.3),
                Panel([curve("heating_power", "heating", 1), *limits], "heating", "kW"),
                Panel([curve("outdoor", "outdoor", 2)], "outdoor<br>temperature", "degC", share=0.7),
            ],
            "time", unit,
        )
    ]  # fmt: skip
    if is_field:
        found.append(_map(data))
    found.append(
        panels_picture(
            "certificate", bound_title(bound),
            "A bound on the error of the temperature, ‖T‖² = ∫T² over the floor; divided by the root "
            "of the area, of its mean.",
            [bound_panel(t, bound, bound.unit)], "time", unit,
        )
    )  # fmt: skip
    return found


def _map(data: Mapping[str, Variable]) -> Picture:
    x, y = data["x"].values, data["y"].values
    last, title = data["temperature"].values[-1].T, "Temperature at the end"
    figure = blank(420)
    figure.add_trace(
        go.Heatmap(
            x=x, y=y, z=last, colorscale=_MAP.capitalize(),
            colorbar=dict(title=dict(text="temperature [degC]", side="right")),
            hovertemplate="%{z:.4g} degC at (%{x:.3g}, %{y:.3g}) m<extra></extra>",
        )
    )  # fmt: skip
    figure.update_xaxes(title_text="x [m]", constrain="domain")
    figure.update_yaxes(title_text="y [m]", scaleanchor="x")

    def still() -> Figure:
        with rc_context({**STILL_STYLE, "axes.grid": False}):
            drawn, axes = still_axes(figsize=(8, 4.4))
            image = axes.pcolormesh(x, y, last, cmap=_MAP, shading="nearest")
            axes.set_aspect("equal")
            axes.set_title(title)
            axes.set_xlabel("x [m]")
            axes.set_ylabel("y [m]")
            drawn.colorbar(image, label="temperature [degC]", shrink=0.8)
        return drawn

    words = "Heat spreads from the heaters; where there is none the floor is colder."
    return Picture(key="map", title=title, caption=words, interactive=figure, still=still)
