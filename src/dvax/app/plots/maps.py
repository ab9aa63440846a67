"""Maps of pressure and of the contact regimes (paper, eq:concrete_contact_states).

On a boundary that is a curve, a map has time to the right and the place upward; on a surface, it shows
the boundary at chosen times.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from dvax.app.plots.downsample import REGIMES, CellMaps, Reduced, centres, edges, rounded, starts
from dvax.app.plots.lines import thin
from dvax.app.plots.panels import value_range
from dvax.app.plots.picture import Change, Frames, Picture
from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.section import Axis, section_picture
from dvax.app.plots.theme import (
    MUTED,
    PRESSURE_MAP,
    REGIME_COLOURS,
    STILL_STYLE,
    axis_title,
    blank,
    counted,
    number,
    pressure_bar,
    quantity,
    still_axes,
    unit_text,
)

MOST_TIMES, STILL_TIMES = 24, 6
CELLS_PER_SIDE = 128
REGIME_SCALE = [
    [edge, colour]
    for index, colour in enumerate(REGIME_COLOURS)
    for edge in (index / len(REGIMES), (index + 1) / len(REGIMES))
]


@dataclass(frozen=True)
class Layout:
    """What the maps of one boundary have in common.

    `edges` of the cells and `titles` of the axes, horizontal before vertical; `square`: a length is the
    same in both directions; `stills`: which of the times the still picture shows, and their titles.
    """

    edges: tuple[np.ndarray, np.ndarray]
    titles: tuple[str, str]
    place: str
    note: str
    height: int = 460
    zoom: str = ""
    square: bool = False
    stills: dict[int, str] = field(default_factory=lambda: {0: ""})


@dataclass(frozen=True)
class Colours:
    """How values are coloured, by Plotly and by Matplotlib, and the words for a value."""

    interactive: dict[str, Any]
    still: dict[str, Any]
    value: str


_REGIMES = Colours(
    dict(zmin=-0.5, zmax=2.5, colorscale=REGIME_SCALE, showscale=False),
    dict(
        cmap=ListedColormap(list(REGIME_COLOURS)),
        norm=BoundaryNorm([-0.5, 0.5, 1.5, 2.5], len(REGIMES)),
    ),
    "regime %{z} (0 unloaded, 1 active, 2 saturated)",
)


def map_pictures(run: RunRecord, reduced: Reduced) -> list[Picture]:
    """The pressure map and the regime map."""
    if reduced.cells is not None:
        return _curve(run, reduced, reduced.cells)
    return _surface(run, reduced)


def _curve(run: RunRecord, reduced: Reduced, cells: CellMaps) -> list[Picture]:
    time, place = run.unit("time"), run.unit("s")
    layout = Layout(
        (cells.time_edges, cells.space_edges),
        (axis_title("time", time), axis_title("place on the boundary", place)),
        f"time %{{x:.4g}} {time}<br>place %{{y:.4g}} {place}<br>",
        cell_note(cells),
        zoom=axis_title("time", time),
    )
    fields = [cells.mean], [cells.common]
    titles = "Pressure over space and time", "Regimes over space and time"
    pressure, regimes = _pictures(run, reduced, layout, titles, fields, (None, None))
    section = section_picture(
        pressure.key, "Pressure along the boundary",
        "The profile at one time. The slider, the button and a click on the map above choose the time, "
        f"which a line marks in the map. {layout.note}",
        centres(cells.space_edges, run.series("s")), centres(cells.time_edges, run.time), cells.mean,
        Axis("place on the boundary", place), Axis("pressure", run.unit("pressure")), time,
    )  # fmt: skip
    return [pressure, section, regimes]


def _surface(run: RunRecord, reduced: Reduced) -> list[Picture]:
    shape, weight = run.boundary_shape, run.series("weight")
    frames = _spread(len(run.time), MOST_TIMES)
    cells = [starts(n, CELLS_PER_SIDE) for n in shape]
    whole = _sum(weight.reshape(shape), cells)
    pressure = [run["pressure"].frames(frame) for frame in frames]
    means = [_sum((p * weight).reshape(shape), cells) / whole for p in pressure]
    regimes = []
    for frame in frames:
        regime = run["regime"].frames(frame)
        measure = [
            _sum(np.where(regime == kind, weight, 0.0).reshape(shape), cells)
            for kind in range(len(REGIMES))
        ]
        regimes.append(np.argmax(measure, axis=0).astype(np.int8))
    times = tuple(quantity(float(run.time[frame]), run.unit("time")) for frame in frames)
    unit = run.unit("pressure")
    highest = [float(p.max()) for p in pressure]
    labels = tuple(
        f"{time}, highest {quantity(top, unit)}" for time, top in zip(times, highest, strict=True)
    )
    first = int(np.argmax(highest))
    lines = run.series("s1").reshape(shape)[:, 0], run.series("s2").reshape(shape)[0]
    across, upward = (
        edges(line)[np.append(begin, len(line))] for line, begin in zip(lines, cells, strict=True)
    )
    layout = Layout(
        (across, upward),
        (axis_title("s1", run.unit("s1")), axis_title("s2", run.unit("s2"))),
        "s1 %{x:.4g}, s2 %{y:.4g}<br>",
        _surface_note(run, cells, frames),
        height=560,
        square=True,
        stills={index: times[index] for index in _spread(len(frames), STILL_TIMES)},
    )
    titles = "Pressure over the boundary", "Regimes over the boundary"
    shown = run.time[frames]
    moments = tuple(
        Frames(shown, words, (Change(0, "z", _upward(np.stack(field))),), first)
        for field, words in ((means, labels), (regimes, times))
    )
    return _pictures(run, reduced, layout, titles, (means, regimes), moments)


def _pictures(
    run: RunRecord,
    reduced: Reduced,
    layout: Layout,
    titles: tuple[str, str],
    fields: tuple[list[np.ndarray], list[np.ndarray]],
    frames: tuple[Frames, ...] | tuple[None, None],
) -> list[Picture]:
    unit, kappa = run.unit("pressure"), run.attrs.get("kappa0")
    low, high = min(0.0, reduced.pressure_low), reduced.pressure_high
    pressures = Colours(
        dict(zmin=low, zmax=high, colorscale=PRESSURE_MAP),
        dict(cmap=PRESSURE_MAP, vmin=low, vmax=high),
        f"pressure %{{z:.4g}} {unit_text(unit)}",
    )
    words = axis_title("pressure", unit)
    pressure_map = _interactive(layout, fields[0][0], pressures)
    pressure_map.update_traces(colorbar=pressure_bar(pressure_map, words, layout.height))
    regime_map = _interactive(layout, fields[1][0], _REGIMES)
    for name, colour in zip(REGIMES, REGIME_COLOURS, strict=True):
        marker = dict(symbol="square", size=12, color=colour, line=dict(width=0.5))
        regime_map.add_trace(
            go.Scatter(x=[None], y=[None], name=name, mode="markers", marker=marker)
        )
    axes_words = f"A map of {layout.titles[0]} to the right and {layout.titles[1]} upward"
    capacity = f" The capacity κ₀ is {quantity(kappa, unit)}." if kappa is not None else ""
    return [
        Picture(
            key="pressure",
            title=titles[0],
            caption=f"The pressure p = βu on the contact boundary; the highest over the run is "
            f"{quantity(high, unit)}.{capacity} {layout.note}",
            interactive=pressure_map,
            still=lambda: _still(layout, titles[0], fields[0], pressures, words),
            frames=frames[0],
            zoom=layout.zoom,
            alternative=f"{axes_words}: the pressure{value_range(np.array([low, high]))} "
            f"{unit_text(unit)} in colours.",
        ),
        Picture(
            key="regimes",
            title=titles[1],
            caption="Unloaded: no pressure. Active: contact below the capacity. Saturated: the "
            f"pressure is at κ₀. {layout.note}",
            interactive=regime_map,
            still=lambda: _still(layout, titles[1], fields[1], _REGIMES),
            frames=frames[1],
            zoom=layout.zoom,
            alternative=f"{axes_words}: the regimes unloaded, active and saturated in colours.",
        ),
    ]


def _interactive(layout: Layout, values: np.ndarray, colours: Colours) -> go.Figure:
    figure = blank(layout.height)
    figure.add_trace(
        go.Heatmap(
            x=layout.edges[0],
            y=layout.edges[1],
            z=_upward(values),
            hovertemplate=f"{layout.place}{colours.value}<extra></extra>",
            **colours.interactive,
        )
    )
    square = dict(constrain="domain") if layout.square else {}
    figure.update_xaxes(title_text=layout.titles[0], showgrid=False, **square)
    anchor = dict(scaleanchor="x") if layout.square else {}
    figure.update_yaxes(title_text=layout.titles[1], showgrid=False, **square, **anchor)
    return figure


def _upward(values: np.ndarray) -> np.ndarray:
    """Return fields whose last axis goes upward, in the order and precision of a map of Plotly."""
    rows = np.swapaxes(values, -1, -2)
    return rows.astype("i1") if values.dtype == np.int8 else rounded(rows)


def _still(
    layout: Layout, title: str, fields: list[np.ndarray], colours: Colours, bar: str = ""
) -> Figure:
    """The fields of `layout.stills`, with a colour bar that is called `bar`, or the regimes' legend."""
    columns = min(3, len(layout.stills))
    rows = -(-len(layout.stills) // columns)
    width, height = 8.0, 4.6
    if layout.square:
        across, upward = (abs(float(line[-1] - line[0])) for line in layout.edges)
        tall = min(max(upward / across, 0.3), 2.0)
        width, height = 2.7 * columns + 1, (2.7 * tall + 0.4) * rows + 0.9
    with rc_context({**STILL_STYLE, "axes.grid": False}):
        drawn, grid = still_axes(
            rows, columns, figsize=(width, height), sharex=True, sharey=True, squeeze=False
        )
        image = None
        for axes, (index, name) in zip(grid.flat, layout.stills.items(), strict=False):
            image = axes.pcolormesh(
                *layout.edges, fields[index].T, rasterized=True, **colours.still
            )
            axes.set_aspect("equal" if layout.square else "auto")
            axes.set_title(name, fontsize=10)
        for axes in grid.flat[len(layout.stills) :]:
            axes.set_axis_off()
        for axes in grid[:, 0]:
            axes.set_ylabel(layout.titles[1])
        for axes in grid[-1, :]:
            axes.set_xlabel(layout.titles[0])
        drawn.suptitle(title, x=0.01, ha="left", fontsize=11)
        if bar and image is not None:
            drawn.colorbar(image, ax=grid, label=bar)
        else:
            patches = [
                Patch(facecolor=colour, edgecolor=MUTED, linewidth=0.5, label=name)
                for name, colour in zip(REGIMES, REGIME_COLOURS, strict=True)
            ]
            drawn.legend(handles=patches, ncols=3, loc="outside lower center")
    return drawn


def cell_note(cells: CellMaps) -> str:
    """What a cell of the map stands for, in a sentence."""
    if not cells.reduced:
        return "Every point and every saved frame is drawn."
    return (
        f"Drawn in {len(cells.time_edges) - 1} × {len(cells.space_edges) - 1} cells for the "
        f"screen: a cell gathers up to {counted(cells.points_per_cell, 'point')} and "
        f"{counted(cells.frames_per_cell, 'frame')}. It has their mean pressure and most common regime."
    )


def _surface_note(run: RunRecord, cells: list[np.ndarray], frames: list[int]) -> str:
    text = f"{len(frames)} of {len(run.time)} saved frames are drawn."
    shown, stored = tuple(map(len, cells)), run.boundary_shape
    if shown == stored:
        return text
    return (
        f"{text} The {stored[0]} × {stored[1]} points are drawn in {shown[0]} × {shown[1]} cells: "
        "the mean pressure and the most common regime of a cell. The highest pressure, written "
        "beside the slider, is over all points."
    )


def _spread(count: int, most: int) -> list[int]:
    """At most `most` indices spread evenly over `count`, the first and the last among them."""
    return sorted({round(float(i)) for i in np.linspace(0, count - 1, min(count, most))})


def _sum(values: np.ndarray, cells: list[np.ndarray]) -> np.ndarray:
    return np.add.reduceat(np.add.reduceat(values, cells[0], axis=0), cells[1], axis=1)


def shares_picture(run: RunRecord, reduced: Reduced) -> Picture:
    """The share of the boundary in each regime over time, as stacked areas."""
    # One frame alone fills its cell of the map.
    time, shares = run.time, 100.0 * reduced.shares
    if len(time) == 1:
        time, shares = edges(time), np.repeat(shares, 2, axis=1)
    words, title = axis_title("time", run.unit("time")), "Shares of the boundary in each regime"
    # One choice of frames for the three curves: stacked areas need common abscissae.
    shown = thin(time, shares[2] - shares[0])
    figure = blank(320)
    for name, colour, share in zip(REGIMES, REGIME_COLOURS, shares, strict=True):
        figure.add_trace(
            go.Scatter(
                x=time[shown],
                y=share[shown],
                name=name,
                stackgroup="shares",
                mode="lines",
                line=dict(width=0.5, color=MUTED),
                fillcolor=colour,
                hovertemplate="%{y:.3g} %",
            )
        )
    figure.update_layout(hovermode="x unified")
    unified = f"time %{{x}} {run.unit('time')}"
    figure.update_xaxes(title_text=words, hoverformat=".6~g", unifiedhovertitle_text=unified)
    figure.update_yaxes(title_text="share [%]", range=[0, 100])
    most = [f"{name} {number(share.max(), 3)} %" for name, share in zip(REGIMES, shares)]

    def still() -> Figure:
        with rc_context(STILL_STYLE):
            drawn, axes = still_axes(figsize=(8, 3.2))
            areas = axes.stackplot(
                time, shares, colors=REGIME_COLOURS, labels=REGIMES, linewidth=0.5, edgecolor=MUTED
            )
            axes.set(xlim=time[[0, -1]], ylim=(0, 100), xlabel=words, ylabel="share [%]")
            axes.legend(handles=areas, ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0))
            drawn.suptitle(title, x=0.01, ha="left", fontsize=11)
        return drawn

    return Picture(
        key="shares",
        title=title,
        caption="The shares count every point, with its quadrature weight; the greatest: "
        f"{', '.join(most)}.",
        interactive=figure,
        still=still,
        zoom=words,
        alternative=f"Stacked areas over {words}; at most {', '.join(most)}.",
    )
