"""Pictures of the contact of a body: pressure until rest, force over time, stress inside."""

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from dvax.app.plots.panels import Curve, Panel, bound_panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.store import Variable
from dvax.app.plots.theme import STILL_STYLE, blank, still_axes

_MOMENTS = 5
_MAP = "viridis"


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """Pressure profiles, force over time, von Mises stress at the end."""
    return [_pressure(data), _force(data), _stress(data)]


def _pressure(data: Mapping[str, Variable]) -> Picture:
    times, s, p = (data[name].values for name in ("time", "place", "pressure"))
    # Moments at equal changes of the pressure, not at equal times: most of a run is rest.
    done = np.cumsum(np.abs(np.diff(p, axis=0)).sum(axis=1))
    rows = np.unique(
        1 + np.searchsorted(done, done[-1] * np.arange(1, _MOMENTS + 1) / (_MOMENTS + 0.01))
    )
    curves = [Curve(s, p[row], f"t = {times[row]:.3g}", k) for k, row in enumerate(rows)]
    curves.append(Curve(s, data["pressure_at_rest"].values, "at rest", None, "dash"))
    touched = np.flatnonzero(p.max(axis=0) > 0)
    if touched.size:
        # The points that were ever touched, with a margin.
        first, last = max(touched[0] - 5, 0), touched[-1] + 6
        curves = [Curve(c.x[first:last], c.y[first:last], c.name, c.colour, c.dash) for c in curves]
    return panels_picture(
        "pressure", "Contact pressure",
        "Where the profile is flat the pressure is at its cap. The dashed one is the limit at rest, "
        "from its own variational inequality.",
        [Panel(curves, "pressure", "p")], "place", "x",
    )  # fmt: skip


def _force(data: Mapping[str, Variable]) -> Picture:
    times = data["time"].values
    panels = [Panel([Curve(times, data["force"].values, "force", 0)], "force", "p·x")]
    if "error_bound" in data:
        panels.append(bound_panel(times, data["error_bound"], "(p·x²)^0.5", share=0.7))
    return panels_picture(
        "force", "Force on the punch",
        "Units are those of the configuration: [x] of length, [p] of pressure, [t] of time.",
        panels, "time", "t",
    )  # fmt: skip


def _stress(data: Mapping[str, Variable]) -> Picture:
    nodes, cells = data["nodes"].values, data["cells"].values
    xx, yy, zz, xy = data["stress"].values.T
    mises = np.sqrt(0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) + 3 * xy**2)
    corners = cells[:, : 4 if cells.shape[1] == 9 else 3]
    outlines = nodes[corners]
    figure = blank(460)
    middle = outlines.mean(axis=1)
    figure.add_trace(
        go.Scatter(
            x=middle[:, 0], y=middle[:, 1], mode="markers", showlegend=False,
            marker=dict(
                color=mises, colorscale=_MAP.capitalize(), size=6,
                colorbar=dict(title=dict(text="von Mises stress [p]", side="right")),
            ),
            customdata=mises, hovertemplate="%{customdata:.4g} at (%{x:.3g}, %{y:.3g})",
        )
    )  # fmt: skip
    figure.update_xaxes(title_text="x [x]")
    figure.update_yaxes(title_text="y [x]", scaleanchor="x")

    def still() -> Figure:
        with rc_context({**STILL_STYLE, "axes.grid": False}):
            drawn, axes = still_axes(figsize=(8, 4.6))
            filled = PolyCollection(
                list(outlines), array=mises, cmap=_MAP, edgecolors="face", linewidths=0.2
            )
            axes.add_collection(filled)
            axes.autoscale_view()
            axes.set_aspect("equal")
            axes.set_title("Von Mises stress at the end")
            axes.set_xlabel("x [x]")
            axes.set_ylabel("y [x]")
            drawn.colorbar(filled, label="von Mises stress [p]", shrink=0.8)
        return drawn

    return Picture(
        key="stress", title="Von Mises stress at the end",
        caption="Means over the elements. body.vtu holds the fields for ParaView.",
        interactive=figure, still=still,
    )  # fmt: skip
