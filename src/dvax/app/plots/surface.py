"""Pressure and regimes on a boundary that is a surface: maps at chosen times, and a slider."""

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.figure import Figure

from dvax.app.plots.downsample import REGIMES, Scan, edges
from dvax.app.plots.picture import Picture, Views
from dvax.app.plots.regimes import REGIME_SCALE, STILL_COLOURS, STILL_NORM, regime_patches
from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.theme import (
    PRESSURE_MAP,
    STILL_STYLE,
    axis_title,
    blank,
    number,
    pressure_bar,
    quantity,
    still_axes,
    unit_text,
)

HEIGHT = 560
MOST_TIMES = 24
STILL_TIMES = 6
CELLS_PER_SIDE = 128


def surface_pictures(run: RunRecord, found: Scan) -> list[Picture]:
    """The pressure map and the regime map, at up to 24 frames spread over the run."""
    frames = _spread(len(run.time), MOST_TIMES)
    starts = [_starts(n) for n in run.boundary_shape]
    pressure = [_read(run, "pressure", frame) for frame in frames]
    regime = [_read(run, "regime", frame) for frame in frames]
    cell_edges = [_cell_edges(run, axis, starts[axis]) for axis in (0, 1)]
    weight = run.weight.reshape(run.boundary_shape)
    means = [_mean(values, weight, starts) for values in pressure]
    common = [_common(values, weight, starts) for values in regime]
    low, high = min(0.0, found.pressure_low), found.pressure_high
    unit = run.unit("pressure")
    note = _note(run, starts, frames)
    labels = tuple(
        f"{number(float(run.time[frame]))} {unit_text(run.unit('time'))}, "
        f"highest {quantity(float(values.max()), unit)}"
        for frame, values in zip(frames, pressure, strict=True)
    )
    first = int(np.argmax([values.max() for values in pressure]))
    pressure_map = _stack(
        run,
        cell_edges,
        [values.astype("f4") for values in means],
        first,
        dict(zmin=low, zmax=high, colorscale=PRESSURE_MAP),
        f"pressure %{{z:.4g}} {unit_text(unit)}",
    )
    bar = pressure_bar(pressure_map, axis_title("pressure", unit), HEIGHT)
    pressure_map.update_traces(colorbar=bar)
    regime_map = _stack(
        run,
        cell_edges,
        common,
        first,
        dict(zmin=-0.5, zmax=2.5, colorscale=REGIME_SCALE, showscale=False),
        "regime %{z} (0 unloaded, 1 active, 2 saturated)",
    )
    _legend(regime_map)
    times = tuple(
        f"{number(float(run.time[frame]))} {unit_text(run.unit('time'))}" for frame in frames
    )
    chosen = _spread(len(frames), STILL_TIMES)

    def pressure_still() -> Figure:
        drawing = dict(cmap=PRESSURE_MAP, vmin=low, vmax=high)
        return _still(run, "Pressure at chosen times", cell_edges, means, times, chosen, drawing)

    def regime_still() -> Figure:
        drawing = dict(cmap=STILL_COLOURS, norm=STILL_NORM)
        return _still(run, "Regimes at chosen times", cell_edges, common, times, chosen, drawing)

    return [
        Picture(
            key="pressure",
            title="Pressure over the boundary",
            caption=(
                f"The pressure p = βu; the highest over the run is {quantity(high, unit)}. {note}"
            ),
            interactive=pressure_map,
            still=pressure_still,
            views=Views("Time", labels, slider=True, first=first),
        ),
        Picture(
            key="regimes",
            title="Regimes over the boundary",
            caption=f"Unloaded: no pressure. Saturated: the pressure is at κ₀. {note}",
            interactive=regime_map,
            still=regime_still,
            views=Views("Time", times, slider=True, first=first),
        ),
    ]


def _spread(count: int, most: int) -> list[int]:
    """At most `most` indices spread evenly over `count`, the first and the last among them."""
    return sorted({round(float(i)) for i in np.linspace(0, count - 1, min(count, most))})


def _starts(count: int) -> np.ndarray:
    groups = min(count, CELLS_PER_SIDE)
    return (np.arange(groups) * count) // groups


def _read(run: RunRecord, name: str, frame: int) -> np.ndarray:
    return run.frames.field(name, frame).reshape(run.boundary_shape)


def _cell_edges(run: RunRecord, axis: int, starts: np.ndarray) -> np.ndarray:
    grid = run.frames.line(("s1", "s2")[axis]).astype(float).reshape(run.boundary_shape)
    line = grid[:, 0] if axis == 0 else grid[0, :]
    return edges(line)[np.append(starts, len(line))]


def _sum(values: np.ndarray, starts: list[np.ndarray]) -> np.ndarray:
    return np.add.reduceat(np.add.reduceat(values, starts[0], axis=0), starts[1], axis=1)


def _mean(values: np.ndarray, weight: np.ndarray, starts: list[np.ndarray]) -> np.ndarray:
    return _sum(values * weight, starts) / _sum(weight, starts)


def _common(values: np.ndarray, weight: np.ndarray, starts: list[np.ndarray]) -> np.ndarray:
    measure = [_sum(np.where(values == kind, weight, 0.0), starts) for kind in range(len(REGIMES))]
    return np.argmax(measure, axis=0).astype(np.int8)


def _note(run: RunRecord, starts: list[np.ndarray], frames: list[int]) -> str:
    shown, stored = [len(s) for s in starts], run.boundary_shape
    text = f"{len(frames)} of {len(run.time)} saved frames are drawn."
    if tuple(shown) == stored:
        return text
    return (
        f"{text} The {stored[0]} × {stored[1]} points are drawn in {shown[0]} × {shown[1]} cells: "
        "the mean pressure and the most common regime of a cell. The highest pressure, written "
        "beside the slider, is over all points."
    )


def _stack(
    run: RunRecord,
    cell_edges: list[np.ndarray],
    fields: list[np.ndarray],
    first: int,
    style: dict,
    value_text: str,
) -> go.Figure:
    figure = blank(HEIGHT)
    for index, values in enumerate(fields):
        figure.add_trace(
            go.Heatmap(
                x=cell_edges[0],
                y=cell_edges[1],
                z=values.T,
                visible=index == first,
                hovertemplate=f"s1 %{{x:.4g}}, s2 %{{y:.4g}}<br>{value_text}<extra></extra>",
                **style,
            )
        )
    figure.update_xaxes(
        title_text=axis_title("s1", run.unit("s1")),
        showgrid=False,
        constrain="domain",
    )
    # A length is a length in both directions.
    figure.update_yaxes(
        title_text=axis_title("s2", run.unit("s2")),
        showgrid=False,
        scaleanchor="x",
        constrain="domain",
    )
    return figure


def _legend(figure: go.Figure) -> None:
    for name, colour in zip(REGIMES, REGIME_SCALE[::2], strict=True):
        figure.add_trace(
            go.Scatter(
                x=[None],
                y=[None],
                name=name,
                mode="markers",
                marker=dict(symbol="square", size=12, color=colour[1], line=dict(width=0.5)),
            )
        )


def _still(
    run: RunRecord,
    title: str,
    cell_edges: list[np.ndarray],
    fields: list[np.ndarray],
    times: tuple[str, ...],
    chosen: list[int],
    drawing: dict,
) -> Figure:
    columns = min(3, len(chosen))
    rows = -(-len(chosen) // columns)
    sides = [abs(float(line[-1] - line[0])) for line in cell_edges]
    tall = min(max(sides[1] / sides[0], 0.3), 2.0)
    with rc_context(STILL_STYLE):
        drawn, grid = still_axes(
            rows,
            columns,
            figsize=(2.7 * columns + 1, (2.7 * tall + 0.4) * rows + 0.9),
            sharex=True,
            sharey=True,
            squeeze=False,
        )
        image = None
        for axes, index in zip(grid.flat, chosen, strict=False):
            image = axes.pcolormesh(
                cell_edges[0], cell_edges[1], fields[index].T, rasterized=True, **drawing
            )
            axes.set_aspect("equal")
            axes.grid(False)
            axes.set_title(times[index], fontsize=10)
        for axes in grid.flat[len(chosen) :]:
            axes.set_axis_off()
        for axes in grid[:, 0]:
            axes.set_ylabel(axis_title("s2", run.unit("s2")))
        for axes in grid[-1, :]:
            axes.set_xlabel(axis_title("s1", run.unit("s1")))
        drawn.suptitle(title)
        if "norm" in drawing:
            drawn.legend(handles=regime_patches(), ncols=3, loc="outside lower center")
        elif image is not None:
            drawn.colorbar(image, ax=grid, label=axis_title("pressure", run.unit("pressure")))
    return drawn
