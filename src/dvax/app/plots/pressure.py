"""Pressure over space and time, on a boundary that is a curve."""

import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.figure import Figure

from dvax.app.plots.downsample import CellMaps, Scan
from dvax.app.plots.picture import Picture, Views
from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.theme import (
    PRESSURE_MAP,
    STILL_STYLE,
    axis_title,
    blank,
    counted,
    pressure_bar,
    quantity,
    still_axes,
)

HEIGHT = 460
CELL_VIEWS = ("mean of a cell", "highest in a cell", "lowest in a cell")


def cell_note(cells: CellMaps) -> str:
    """What a cell of the map stands for, in a sentence; empty where a cell is one stored value."""
    if not cells.reduced:
        return "Every point and every saved frame is drawn."
    return (
        f"Drawn in {len(cells.time_edges) - 1} × {len(cells.space_edges) - 1} cells for the "
        f"screen: a cell gathers up to {counted(cells.points_per_cell, 'point')} and "
        f"{counted(cells.frames_per_cell, 'frame')}. The buttons show the extremes of each "
        "cell, so that no narrow peak is lost."
    )


def pressure_picture(run: RunRecord, found: Scan) -> Picture:
    """The map with time to the right and the place on the boundary upward."""
    cells = found.cells
    if cells is None:
        raise ValueError("a surface has no map over one coordinate; use surface_pictures")
    unit = run.unit("pressure")
    words = axis_title("pressure", unit)
    low, high = min(0.0, found.pressure_low), found.pressure_high
    fields = [cells.mean, cells.high, cells.low] if cells.reduced else [cells.mean]
    figure = blank(HEIGHT)
    bar = pressure_bar(figure, words, HEIGHT)
    for index, values in enumerate(fields):
        figure.add_trace(
            go.Heatmap(
                x=cells.time_edges,
                y=cells.space_edges,
                z=values.T.astype("f4"),
                zmin=low,
                zmax=high,
                colorscale=PRESSURE_MAP,
                visible=index == 0,
                hovertemplate=(
                    f"time %{{x:.4g}} {run.unit('time')}<br>place %{{y:.4g}} {run.unit('s')}<br>"
                    f"pressure %{{z:.4g}} {unit}<extra></extra>"
                ),
                colorbar=bar,
            )
        )
    figure.update_xaxes(title_text=axis_title("time", run.unit("time")), showgrid=False)
    figure.update_yaxes(
        title_text=axis_title("place on the boundary", run.unit("s")), showgrid=False
    )

    def still() -> Figure:
        with rc_context(STILL_STYLE):
            drawn, axes = still_axes(figsize=(8, 4.6))
            image = axes.pcolormesh(
                cells.time_edges,
                cells.space_edges,
                cells.mean.T,
                cmap=PRESSURE_MAP,
                vmin=low,
                vmax=high,
                rasterized=True,
            )
            drawn.colorbar(image, ax=axes, label=words)
            axes.grid(False)
            axes.set(
                title="Pressure over space and time" + (" (mean of a cell)" * cells.reduced),
                xlabel=axis_title("time", run.unit("time")),
                ylabel=axis_title("place on the boundary", run.unit("s")),
            )
        return drawn

    kappa = run.frames.attrs.get("kappa0")
    capacity = f" The capacity κ₀ is {quantity(kappa, unit)}." if kappa is not None else ""
    return Picture(
        key="pressure",
        title="Pressure over space and time",
        caption=(
            f"The pressure p = βu on the contact boundary; the highest is {quantity(high, unit)}."
            f"{capacity} {cell_note(cells)}"
        ),
        interactive=figure,
        still=still,
        views=Views("Show the", CELL_VIEWS) if cells.reduced else None,
    )
