"""Contact regimes over space and time, and the share of the boundary in each (paper,
eq:concrete_contact_states)."""

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from dvax.app.plots.downsample import REGIMES, Scan, edges
from dvax.app.plots.lines import thin
from dvax.app.plots.picture import Picture, Views
from dvax.app.plots.pressure import cell_note
from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.theme import (
    MUTED,
    REGIME_COLOURS,
    STILL_STYLE,
    axis_title,
    blank,
    number,
    still_axes,
)

REGIME_VIEWS = (
    "most common regime of a cell",
    "highest regime in a cell",
    "lowest regime in a cell",
)
REGIME_SCALE = [
    [edge, colour]
    for index, colour in enumerate(REGIME_COLOURS)
    for edge in (index / len(REGIMES), (index + 1) / len(REGIMES))
]
STILL_COLOURS = ListedColormap(list(REGIME_COLOURS))
STILL_NORM = BoundaryNorm([-0.5, 0.5, 1.5, 2.5], len(REGIMES))


def regime_patches() -> list[Patch]:
    """The legend of a still map."""
    return [
        Patch(facecolor=colour, edgecolor=MUTED, linewidth=0.5, label=name)
        for name, colour in zip(REGIMES, REGIME_COLOURS, strict=True)
    ]


def regime_picture(run: RunRecord, found: Scan) -> Picture:
    """On a curve: the map above, the exact shares below. On a surface: the shares alone."""
    cells = found.cells
    if cells is None:
        figure, row = blank(320), 1
    else:
        figure, row = blank(620, (0.68, 0.32)), 2
        fields = [cells.common, cells.highest, cells.lowest] if cells.reduced else [cells.common]
        for index, values in enumerate(fields):
            figure.add_trace(
                go.Heatmap(
                    x=cells.time_edges,
                    y=cells.space_edges,
                    z=values.T,
                    zmin=-0.5,
                    zmax=2.5,
                    colorscale=REGIME_SCALE,
                    showscale=False,
                    visible=index == 0,
                    hovertemplate=(
                        f"time %{{x:.4g}} {run.unit('time')}<br>place %{{y:.4g}} {run.unit('s')}"
                        "<br>regime %{z} (0 unloaded, 1 active, 2 saturated)<extra></extra>"
                    ),
                ),
                row=1,
                col=1,
            )
        place = axis_title("place on the boundary", run.unit("s"))
        figure.update_yaxes(title_text=place, showgrid=False, row=1, col=1)
    _shares(figure, run, found, row)
    figure.update_xaxes(title_text=axis_title("time", run.unit("time")), row=row, col=1)
    figure.update_yaxes(title_text="share [%]", range=[0, 100], row=row, col=1)
    peak = found.shares.max(axis=1) * 100
    greatest = ", ".join(f"{name} {number(p, 3)} %" for name, p in zip(REGIMES, peak, strict=True))
    title = "Regimes over space and time" if cells else "Shares of the boundary in each regime"
    return Picture(
        key="regimes" if cells else "shares",
        title=title,
        caption=(
            "Unloaded: no pressure. Active: contact below the capacity. Saturated: the pressure is "
            "at κ₀. The shares count every point, with its quadrature weight; the greatest: "
            f"{greatest}." + (f" {cell_note(cells)}" if cells is not None else "")
        ),
        interactive=figure,
        still=lambda: _still(run, found, title),
        views=Views("Show the", REGIME_VIEWS) if cells is not None and cells.reduced else None,
    )


def _shares(figure: go.Figure, run: RunRecord, found: Scan, row: int) -> None:
    time, shares = _area(run.time, found.shares)
    # One choice of frames for the three curves: stacked areas need common abscissae.
    shown = thin(time, shares[2] - shares[0])
    for name, colour, share in zip(REGIMES, REGIME_COLOURS, shares, strict=True):
        figure.add_trace(
            go.Scatter(
                x=time[shown],
                y=100 * share[shown],
                name=name,
                stackgroup="shares",
                mode="lines",
                line=dict(width=0.5, color=MUTED),
                fillcolor=colour,
                hovertemplate=f"%{{y:.3g}} % at %{{x:.4g}} {run.unit('time')}",
            ),
            row=row,
            col=1,
        )


def _still(run: RunRecord, found: Scan, title: str) -> Figure:
    cells = found.cells
    with rc_context(STILL_STYLE):
        if cells is None:
            drawn, below = still_axes(figsize=(8, 3.2))
            top = below
        else:
            drawn, (top, below) = still_axes(
                2, 1, figsize=(8, 6), sharex=True, height_ratios=[2.2, 1]
            )
            top.pcolormesh(
                cells.time_edges,
                cells.space_edges,
                cells.common.T,
                cmap=STILL_COLOURS,
                norm=STILL_NORM,
                rasterized=True,
            )
            top.grid(False)
            top.set_ylabel(axis_title("place on the boundary", run.unit("s")))
        _stack(below, run.time, found.shares)
        below.set_xlabel(axis_title("time", run.unit("time")))
        reduced = cells is not None and cells.reduced
        top.set_title(title + (" (most common regime of a cell)" * reduced), pad=28)
        top.legend(
            handles=regime_patches(),
            ncols=3,
            loc="lower left",
            bbox_to_anchor=(0, 1.0),
            borderpad=0.2,
        )
    return drawn


def _stack(axes: Axes, time: np.ndarray, shares: np.ndarray) -> None:
    time, shares = _area(time, shares)
    axes.stackplot(time, 100 * shares, colors=REGIME_COLOURS, linewidth=0.5, edgecolor=MUTED)
    axes.set_xlim(time[0], time[-1])
    axes.set(ylim=(0, 100), ylabel="share of the\nboundary [%]")


def _area(time: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Abscissae and shares of the stacked areas; one frame alone fills its cell of the map."""
    return (time, shares) if len(time) > 1 else (edges(time), np.repeat(shares, 2, axis=1))
