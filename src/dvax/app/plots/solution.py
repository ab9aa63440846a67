"""The default picture of a `dvax.Solution`: states, responses, active constraints, error bound."""

import sys
from collections.abc import Sequence
from typing import Any

import jax
import jax.tree_util as jtu
import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dvax._dataset import Names, named
from dvax._tree import Tree
from dvax.app.plots.constraints import box_rows, constraint_panel
from dvax.app.plots.lines import LARGEST
from dvax.app.plots.map_panel import MapPanel
from dvax.app.plots.panels import (
    AbstractPanel,
    Band,
    Curve,
    Panel,
    TimeMarks,
    draw_panels,
    panels_picture,
)
from dvax.app.plots.picture import Picture
from dvax.app.plots.theme import number, quantity
from dvax.errors import input_error
from dvax.evolution import RESULTS, Solution
from dvax.evolution.dataset import check_bound, check_single
from dvax.evolution.results import is_success

PLACE = "Solution.plot"
MOST_CURVES = 6
"""Up to this many entries are curves, one for each colour; more are a map, or bands."""
_MOST_MARKS = 60
"""Up to this many times of an event are lines."""
_DENSE_TIMES = 201
"""The times at which recorded steps are drawn where fewer than two were saved."""
_TITLE_PIXELS, _LEGEND_PIXELS, _PIXELS_PER_CHARACTER = 34, 22, 7


def plot_solution(
    sol: Solution,
    states: Names,
    responses: Names,
    *,
    time_unit: str,
    bound: Any,
    title: str | None,
    backend: str,
    axes: Sequence[Axes] | None,
) -> Figure | go.Figure:
    """Return the figure of `Solution.plot`, whose docstring has the arguments."""
    check_single(sol, PLACE)
    if bound is not None:
        check_bound(sol, bound, f"{PLACE}(bound)")
    times, xs, us, ys = _rows(sol, time_unit)
    panels = _panels(times, xs, states, "x", "states")
    box = box_rows(sol, times)
    is_own = _equal(us, ys)
    panels += _panels(times, us, responses, "u", "responses", box if is_own else None)
    if box is not None and not is_own and _is_finite(box):
        panels += _panels(times, ys, None, "y", "responses", box)
    names = _entry_names(us, responses, "u") if is_own else _entry_names(ys, None, "y")
    active = constraint_panel(sol, times, (xs, ys), box, names)
    panels += [] if active is None else [active]
    if bound is not None:
        panels.append(_bound_panel(bound))
    text = _title(sol, time_unit) if title is None else title
    return finished(panels, text, time_unit, backend, axes, PLACE, _marks(sol))


def finished(
    panels: list[AbstractPanel],
    title: str,
    time_unit: str,
    backend: str,
    axes: Sequence[Axes] | None,
    place: str,
    marks: Sequence[TimeMarks] = (),
) -> Figure | go.Figure:
    """Return panels over time as a figure of Matplotlib or Plotly, or drawn into `axes`."""
    if backend not in ("matplotlib", "plotly") or (axes is not None and backend == "plotly"):
        given = f"{backend!r}" + ("" if axes is None else " with axes=")
        raise input_error(
            f"{place}(backend)", given, 'it is "matplotlib" or "plotly"; axes= are of Matplotlib',
            'Write backend="plotly", without axes=',
        )  # fmt: skip
    if axes is not None:
        given_axes = list(np.ravel(np.asarray(axes, object)))
        if len(given_axes) != len(panels):
            raise input_error(
                f"{place}(axes)", f"{len(given_axes)} axes",
                f"there are {len(panels)} panels: {', '.join(p.words for p in panels)}",
                f"Make them with plt.subplots({len(panels)}, sharex=True)[1]",
            )  # fmt: skip
        draw_panels(panels, given_axes, "time", time_unit, marks)
        return given_axes[0].figure
    picture = panels_picture("solution", title, "", panels, "time", time_unit, marks=marks)
    return _with_title(picture) if backend == "plotly" else _shown_by_pyplot(picture.still())


def _shown_by_pyplot(figure: Figure) -> Figure:
    """Return the figure, which `pyplot.show` shows where the program has imported pyplot. A notebook
    shows what a cell returns, and would show it twice."""
    pyplot = sys.modules.get("matplotlib.pyplot")
    if pyplot is not None and "inline" not in pyplot.get_backend():
        pyplot.figure(figure)
    return figure


def entry_panels(
    times: np.ndarray, name: str, values: np.ndarray, unit: str, box: Any = None
) -> list[AbstractPanel]:
    """Return the panel of one array over time: curves up to six entries, a map of a vector of more,
    and quantiles over the entries of an array with several axes."""
    flat = np.asarray(values.reshape(len(times), -1), float)
    entries = flat.shape[1]
    if entries > MOST_CURVES and values.ndim == 2 and len(times) > 1:
        return [MapPanel(times, flat, name, f"entry of {name}", unit)]
    if entries > MOST_CURVES:
        low, quarter, middle, upper, high = np.quantile(flat, (0.0, 0.25, 0.5, 0.75, 1.0), axis=1)
        bands = (
            Band(times, low, high, f"all {entries} entries of {name}"),
            Band(times, quarter, upper, "half of them"),
        )
        return [Panel([Curve(times, middle, "median")], name, unit, bands=bands)]
    labels = _indexed(name, values.shape[1:])
    curves = [Curve(times, flat[:, k], label, k) for k, label in enumerate(labels)]
    return [Panel([*curves, *_box_curves(times, box, entries)], name, unit)]


def _indexed(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return the names of the entries of an array: x[0], x[1], …; the name alone of a number."""
    return [f"{name}[{','.join(map(str, i))}]" if i else name for i in np.ndindex(*shape)]


def _entry_names(rows: Tree, names: Names, symbol: str) -> list[str]:
    """Return a name for each entry of u or y."""
    found = named(rows, names, symbol, f"{PLACE}(responses)")
    return [entry for name, (v, _) in found.items() for entry in _indexed(name, np.shape(v)[1:])]


def _panels(
    times: np.ndarray, rows: Tree, names: Names, symbol: str, argument: str, box: Any = None
) -> list[AbstractPanel]:
    """Return the panels of the states or responses: a panel for each part; entries that have names of
    their own share one if they have the same unit."""
    found = named(rows, names, symbol, f"{PLACE}({argument})")
    parts = jtu.tree_leaves(rows)
    boxes: list[Any] = [None] * len(parts) if box is None else list(zip(*map(jtu.tree_leaves, box)))
    if not names or len(found) == len(parts):
        return [
            panel
            for (name, (values, unit)), own in zip(found.items(), boxes, strict=True)
            for panel in entry_panels(times, name, np.asarray(values), unit or "", own)
        ]
    ends = [None] * len(found)
    if box is not None:
        flat = [
            np.concatenate([np.reshape(v, (len(times), -1)) for v in side], 1)
            for side in zip(*boxes)
        ]
        ends = [(flat[0][:, k], flat[1][:, k]) for k in range(len(found))]
    by_unit: dict[str, list[tuple[str, np.ndarray, Any]]] = {}
    for (name, (values, unit)), own in zip(found.items(), ends, strict=True):
        by_unit.setdefault(unit or "", []).append((name, np.asarray(values, float), own))
    panels: list[AbstractPanel] = []
    for unit, series in by_unit.items():
        for begin in range(0, len(series), MOST_CURVES):
            panels.append(_named_panel(times, series[begin : begin + MOST_CURVES], unit))
    return panels


def _named_panel(times: np.ndarray, series: Sequence[Any], unit: str) -> Panel:
    curves = [Curve(times, values, name, k) for k, (name, values, _) in enumerate(series)]
    for k, (_, _, own) in enumerate(series):
        curves += _box_curves(times, own, 1, None if len(series) == 1 else k)
    # The axis names up to three of them; the legend names all.
    words = ", ".join(name for name, _, _ in series[:3]) + (", …" if len(series) > 3 else "")
    return Panel(curves, words, unit)


def _box_curves(
    times: np.ndarray, box: Any, entries: int, colour: int | None = None
) -> list[Curve]:
    """Return the finite bounds of K as dashed curves: grey where all entries have the same."""
    if box is None:
        return []
    curves: list[Curve] = []
    lower, upper = (np.reshape(side, (len(times), -1)).astype(float) for side in box)
    for word, side in (("lower", lower), ("upper", upper)):
        shared = bool((side == side[:, :1]).all())
        for k in range(1 if shared else entries):
            if np.isfinite(side[:, k]).any():
                shown = np.where(np.isfinite(side[:, k]), side[:, k], np.nan)
                ink = colour if shared else k
                curves.append(Curve(times, shown, f"{word} bound of K", ink, "dash"))
    return curves


def _rows(sol: Solution, time_unit: str) -> tuple[np.ndarray, Tree, Tree, Tree]:
    """Return times and rows of x, u and y: the saved ones, or where fewer than two were saved, those
    of the recorded steps."""
    ts = np.asarray(sol.ts, float)
    if len(ts) >= 2:
        return ts, sol.xs, sol.us, sol.ys
    if sol.records is None or int(sol.stats["steps"]) == 0:
        failed = not is_success(sol.result)
        stop = (
            f"; the run stopped at t = {float(sol.stats['t']):g}: {RESULTS[sol.result]}"
            if failed
            else ""
        )
        raise input_error(
            PLACE, f"a solution with {len(ts)} saved time{'s' * (len(ts) != 1)}{stop}",
            "a curve needs two of them, or the recorded steps",
            "Pass ts=jnp.linspace(t0, t1, 200) to dvax.solve, or dense=True",
        )  # fmt: skip
    begin, end = float(sol.setup.setting["t0"]), float(sol.stats["t"])
    times = np.linspace(begin, end, _DENSE_TIMES)
    xs, us = sol.evaluate(times)
    operator = sol.flow.operator
    ys = jax.vmap(operator.apply)(us)
    return times, xs, us, ys


def _equal(us: Tree, ys: Tree) -> bool:
    pairs = zip(jtu.tree_leaves(us), jtu.tree_leaves(ys), strict=True)
    return all(np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True) for a, b in pairs)


def _is_finite(box: Any) -> bool:
    return any(bool(np.isfinite(np.asarray(v)).any()) for v in jtu.tree_leaves(box))


def _bound_panel(bound: Any) -> Panel:
    ts, curves = np.asarray(bound.ts, float), []
    for k, (name, values, dash) in enumerate((("x", bound.x, "solid"), ("u", bound.u, "dash"))):
        values = np.asarray(values, float)
        above = ~(values <= LARGEST)
        since = f" (states nothing from t = {ts[np.argmax(above)]:.4g} on)" if above.any() else ""
        curves.append(Curve(ts, values, f"bound on the error of {name}{since}", k, dash))
    return Panel(curves, f"error bound<br>({bound.status})", log=True)


def _marks(sol: Solution) -> list[TimeMarks]:
    """Return the times of the events, by name."""
    if sol.events is None:
        return []
    index, ts = np.asarray(sol.events.index), np.asarray(sol.events.ts, float)
    dashes = ("dot", "dashdot", "longdash", "dash")
    found = []
    for k, name in enumerate(sol.events.names):
        if (at := ts[index == k]).size:
            words = name or ("event" if len(sol.events.names) == 1 else f"event {k}")
            if at.size > _MOST_MARKS:
                words, at = f"{words} ({at.size} times, not drawn)", at[:0]
            found.append(TimeMarks(at, words, dashes[k % len(dashes)]))
    return found


def _title(sol: Solution, time_unit: str) -> str:
    """Return the method and the number of steps, and where and why a run stopped early."""
    steps = (
        f"{number(int(sol.stats['steps']))} steps of {str(sol.stats['method']).partition(':')[0]}"
    )
    if sol.result == RESULTS.successful:
        return steps
    stop = quantity(float(sol.stats["t"]), time_unit)
    return f"{steps}, stopped at t = {stop}:\n{RESULTS[sol.result]}"


def _with_title(picture: Picture) -> go.Figure:
    """Return the interactive figure, which stands alone, with its title above the legend."""
    figure = picture.interactive
    names = [str(t.name) for t in figure.data if t.showlegend]
    characters = sum(len(name) + 8 for name in names)
    lines = picture.title.count("\n") + 1
    height = int(figure.layout.height)
    above = _TITLE_PIXELS + 16 * (lines - 1)
    legend = _LEGEND_PIXELS * -(-characters * _PIXELS_PER_CHARACTER // 600) if names else 0
    figure.update_layout(
        height=height + above + legend,
        margin=dict(t=above + legend + 8),
        title=dict(
            text=picture.title.replace("\n", "<br>"), font=dict(size=14), x=0, xref="paper", y=1,
            yref="container", yanchor="top", pad=dict(t=10),
        ),
        legend=dict(
            yref="container", y=1 - above / (height + above + legend), yanchor="top",
        ),
    )  # fmt: skip
    return figure
