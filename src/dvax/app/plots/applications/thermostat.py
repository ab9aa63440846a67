"""Pictures of a heated floor: temperatures against the set point, heating, and the map at the end."""

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.figure import Figure

from dvax.app.plots.downsample import rounded
from dvax.app.plots.panels import Curve, Panel, panels_picture, value_range
from dvax.app.plots.picture import Change, Frames, Picture
from dvax.app.plots.store import Variable
from dvax.app.plots.theme import STILL_STYLE, blank, pressure_bar, quantity, still_axes

_MAP, _MOMENTS = "viridis", 97


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """Histories, and the map where there is more than one cell."""
    t, unit = data["time"].values, data["time"].unit

    def curve(name: str, words: str, colour: int | None, dash: str = "solid") -> Curve:
        return Curve(t, data[name].values, words, colour, dash)

    means = [curve("mean_temperature", "mean", 0), curve("set_point", "set point", None, "dash")]
    is_field = data["temperature"].values[0].size > 1
    if is_field:
        means[1:1] = [
            curve("coldest", "coldest", 5, "dot"),
            curve("warmest", "warmest", 4, "dashdot"),
        ]
    limits = [curve(f"heating_{end}", "limits", None, "dash") for end in ("min", "max")]
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
    return found


def _map(data: Mapping[str, Variable]) -> Picture:
    x, y, times = (data[name].values for name in ("x", "y", "time"))
    frames = np.unique(np.linspace(0, len(times) - 1, _MOMENTS).round().astype(int))
    fields = np.swapaxes(data["temperature"].values[frames], 1, 2)
    last, title = fields[-1], "Temperature of the floor"
    figure = blank(440)
    figure.add_trace(
        go.Heatmap(
            x=x, y=y, z=rounded(last), colorscale=_MAP.capitalize(),
            zmin=float(fields.min()), zmax=float(fields.max()),
            colorbar=pressure_bar(figure, "temperature [degC]", 440),
            hovertemplate="%{z:.4g} degC at (%{x:.3g}, %{y:.3g}) m<extra></extra>",
        )
    )  # fmt: skip
    figure.update_xaxes(title_text="x [m]", constrain="domain", showgrid=False)
    figure.update_yaxes(title_text="y [m]", scaleanchor="x", constrain="domain", showgrid=False)
    labels = tuple(f"t = {quantity(float(t), data['time'].unit)}" for t in times[frames])
    # First the time of the largest differences.
    first = int(np.argmax(np.ptp(fields, axis=(1, 2))))
    moments = Frames(times[frames], labels, (Change(0, "z", rounded(fields)),), first)

    def still() -> Figure:
        with rc_context({**STILL_STYLE, "axes.grid": False}):
            drawn, axes = still_axes(figsize=(8, 4.4))
            image = axes.pcolormesh(x, y, last, cmap=_MAP, shading="nearest")
            axes.set_aspect("equal")
            axes.set_title("Temperature at the end")
            axes.set_xlabel("x [m]")
            axes.set_ylabel("y [m]")
            drawn.colorbar(image, label="temperature [degC]", shrink=0.8)
        return drawn

    words = "Heat spreads from the heaters; where there is none the floor is colder."
    return Picture(
        "map", title, f"{words} The slider chooses the time.", figure, still, frames=moments,
        alternative=f"A map of the floor: the temperature{value_range(fields)} degC in colours, at "
        f"{len(frames)} times that a slider chooses.",
    )  # fmt: skip
