"""Pictures of the contact of a body: pressure until rest, force over time, stress inside."""

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from dvax.app.plots.downsample import rounded
from dvax.app.plots.field import field_pictures
from dvax.app.plots.panels import DASHES, Curve, Panel, panels_picture, value_range
from dvax.app.plots.picture import Picture
from dvax.app.plots.section import Axis
from dvax.app.plots.store import Variable
from dvax.app.plots.theme import STILL_STYLE, blank, pressure_bar, still_axes

_MOMENTS = 5
_CELLS = 400
"""Of the map of the stress, along its longer side."""
_MAP = "viridis"


def pictures(data: Mapping[str, Variable]) -> list[Picture]:
    """Pressure over time and at one time, profiles until rest, force, von Mises stress at the end."""
    return [*_field(data), _pressure(data), _force(data), _stress(data)]


def _field(data: Mapping[str, Variable]) -> list[Picture]:
    """The pressure over space and time, and along the contact boundary at one time."""
    times, places, p = (data[name].values for name in ("time", "place", "pressure"))
    near = _touched(p)
    rest = Curve(places[near], data["pressure_at_rest"].values[near], "at rest", None, "dash")
    return field_pictures(
        "contact", "Contact pressure", times, places[near], p[:, near], Axis("place", "x"),
        Axis("pressure", "p"), "t", [rest], label_unit="",
    )  # fmt: skip


def _touched(p: np.ndarray) -> slice:
    """The points that were ever touched, with a margin; all where none was."""
    touched = np.flatnonzero(p.max(axis=0) > 0)
    return slice(max(touched[0] - 5, 0), touched[-1] + 6) if touched.size else slice(None)


def _pressure(data: Mapping[str, Variable]) -> Picture:
    times, s, p = (data[name].values for name in ("time", "place", "pressure"))
    # Moments at equal changes of the pressure, not at equal times: most of a run is rest.
    done = np.cumsum(np.abs(np.diff(p, axis=0)).sum(axis=1))
    rows = np.unique(
        1 + np.searchsorted(done, done[-1] * np.arange(1, _MOMENTS + 1) / (_MOMENTS + 0.01))
    )
    near = _touched(p)
    curves = [
        Curve(s[near], p[row][near], f"t = {times[row]:.3g}", k, DASHES[k])
        for k, row in enumerate(rows)
    ]
    curves.append(Curve(s[near], data["pressure_at_rest"].values[near], "at rest", None, "dash"))
    return panels_picture(
        "pressure", "Contact pressure until rest",
        "Where the profile is flat the pressure is at its cap. The dashed one is the limit at rest, "
        "from its own variational inequality.",
        [Panel(curves, "pressure", "p")], "place", "x",
    )  # fmt: skip


def _force(data: Mapping[str, Variable]) -> Picture:
    times = data["time"].values
    panel = Panel([Curve(times, data["force"].values, "force", 0)], "force", "p·x")
    return panels_picture(
        "force", "Force on the punch",
        "Units are those of the configuration: [x] of length, [p] of pressure, [t] of time.",
        [panel], "time", "t",
    )  # fmt: skip


def _stress(data: Mapping[str, Variable]) -> Picture:
    nodes, cells = data["nodes"].values, data["cells"].values
    xx, yy, zz, xy = data["stress"].values.T
    mises = np.sqrt(0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) + 3 * xy**2)
    corners = cells[:, : 4 if cells.shape[1] == 9 else 3]
    outlines = nodes[corners]
    figure = blank(460)
    across, upward, shown = _map_of_cells(nodes, corners, mises)
    figure.add_trace(
        go.Heatmap(
            x=across, y=upward, z=rounded(shown), colorscale=_MAP.capitalize(),
            colorbar=pressure_bar(figure, "von Mises stress [p]", 460),
            hovertemplate="%{z:.4g} p at (%{x:.3g}, %{y:.3g})<extra></extra>", hoverongaps=False,
        )
    )  # fmt: skip
    figure.update_xaxes(title_text="x [x]", constrain="domain", showgrid=False)
    figure.update_yaxes(title_text="y [x]", scaleanchor="x", constrain="domain", showgrid=False)

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
        alternative=f"A map of the body: the von Mises stress{value_range(mises)} p in colours.",
    )  # fmt: skip


def _map_of_cells(
    nodes: np.ndarray, corners: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the values of the elements on a grid of points, NaN outside the body, after its axes."""
    halves = [(0, k, k + 1) for k in range(1, corners.shape[1] - 1)]
    triangles = np.concatenate([corners[:, half] for half in halves])
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    step = float((high - low).max()) / _CELLS
    across, upward = (
        a + step * (np.arange(max(1, round((b - a) / step))) + 0.5) for a, b in zip(low, high)
    )
    find = Triangulation(nodes[:, 0], nodes[:, 1], triangles).get_trifinder()
    which = np.asarray(find(*np.meshgrid(across, upward)))
    return across, upward, np.where(which < 0, np.nan, values[which % len(values)])
