"""The default picture of a solution: what its panels show, and what is refused."""

import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import plotly.graph_objects as go
import pytest
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from tests.once import once

import dvax
from dvax.app.plots.map_panel import MapPanel
from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.app.plots.solution import entry_panels
from dvax.app.plots.span_panel import SpanPanel, Spans
from dvax.ensembles import Moments
from dvax.evolution import Events

TS = np.linspace(0.0, 2.0, 21)


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


@once
def solved():
    """u in a moving box, whose second upper bound is infinite; u = 0.5 sin 4t before it is clipped."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(
            jnp.array([-0.2, 0.0]), jnp.stack([0.1 + 0.1 * t, jnp.inf])
        ),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: 0.5 * jnp.sin(4 * t) + 0.0 * x,
    )  # fmt: skip
    start = jnp.array([1.0, -1.0])
    return dvax.solve(problem, start, 0.0, 2.0, ts=TS, method=dvax.ETD1(), dt=0.1, measure=True)


def lines_of(axes: Axes) -> dict[str, np.ndarray]:
    return {str(line.get_label()): np.asarray(line.get_ydata()) for line in axes.lines}


@pytest.mark.slow
def test_pyplot_shows_the_figure():
    figure = solved().plot()
    assert plt.gcf() is figure
    assert solved().plot(axes=figure.axes) is figure and plt.get_fignums() == [1]


@pytest.mark.slow
def test_panels_show_states_responses_their_bounds_and_active_constraints():
    sol = solved()
    figure = sol.plot()
    states, responses, constraints = figure.axes
    lines = lines_of(states)
    np.testing.assert_array_equal(lines["x[1]"], sol.xs[:, 1])
    lines = lines_of(responses)
    np.testing.assert_array_equal(lines["u[0]"], sol.us[:, 0])
    np.testing.assert_allclose(
        lines["upper bound of K"], 0.1 + 0.1 * TS
    )  # the infinite one is none
    names = [label.get_text() for label in constraints.get_yticklabels()]
    assert names == [
        "u[0] at the lower bound",
        "u[1] at the lower bound",
        "u[0] at the upper bound",
    ]
    first = [path.get_extents() for path in constraints.collections[0].get_paths()]
    clipped = 0.5 * np.sin(4 * TS) <= -0.2
    inside = [any(box.x0 <= t <= box.x1 for box in first) for t in TS]
    assert inside == clipped.tolist()
    assert "21 steps" in figure.get_suptitle() or "20 steps" in figure.get_suptitle()


@pytest.mark.slow
def test_bounds_and_conditions_of_a_constrained_box_are_named():
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        K=dvax.sets.ConstrainedBox(0.0, 1.0, jnp.ones((1, 2)), jnp.zeros(1), jnp.full(1, 1.5)),
        f=lambda t, x, u, args: 2.0 * jnp.sin(t + jnp.array([0.0, 1.5])) - u,
        h=lambda t, x, u, args: 2.0 * x + 0.3,
    )  # fmt: skip
    sol = dvax.solve(problem, jnp.zeros(2), 0.0, 6.0, ts=np.linspace(0.0, 6.0, 61), dense=True)
    rows = sol.plot(responses={"a": "MW", "b": "MW"}).axes[-1]
    names = [label.get_text() for label in rows.get_yticklabels()]
    assert {"a at the lower bound", "b at the upper bound", "row 0"} <= set(names)


def test_panel_of_a_bound_that_is_infinite_says_so_and_has_no_numbers():
    never = np.full(3, np.inf)
    drawn = [Panel([Curve(np.arange(3.0), values, "a")], "a", log=True) for values in
             (never, np.array([1e-16, np.inf, np.inf]), np.array([1e-3, 1e-2, np.inf]))]  # fmt: skip
    figures = [panels_picture("a", "", "", [panel], "time") for panel in drawn]
    has_ticks = [bool(figure.still().axes[0].get_yticks().size) for figure in figures]
    assert has_ticks == [False, False, True]
    assert [f.interactive.layout.yaxis.showticklabels for f in figures] == [False, False, True]


def test_names_of_one_unit_share_a_panel_with_the_bounds_of_their_entries():
    figure = solved().plot(
        {"a": "mm", "b": "mm/s"}, ["force", "torque"], time_unit="s", title="run"
    )
    labels = [axes.get_ylabel().split() for axes in figure.axes]
    assert labels == [["a", "[mm]"], ["b", "[mm/s]"], ["force,", "torque"], ["constraints"]]
    assert figure.axes[-1].get_xlabel() == "time [s]" and figure.get_suptitle() == "run"
    names = [label.get_text() for label in figure.axes[-1].get_yticklabels()]
    assert names[0] == "force at the lower bound"


def test_bound_is_logarithmic_and_has_its_status():
    sol = solved()
    zero = jnp.full_like(sol.ts, 1e-7)
    bound = dvax.Bound(sol.ts, zero, 2.0 * zero, zero, zero, None, None, "estimated")
    last = sol.plot(bound=bound).axes[-1]
    assert last.get_yscale() == "log" and "(estimated)" in last.get_ylabel()
    with pytest.raises(dvax.InputError, match="at the 21 saved times"):
        sol.plot(bound=eqx.tree_at(lambda b: b.ts, bound, sol.ts[1:]))


def test_plotly_has_the_same_panels_and_each_name_once():
    sol = solved()
    figure = sol.plot(backend="plotly")
    assert isinstance(figure, go.Figure)
    named = [trace.name for trace in figure.data if trace.showlegend]
    assert named == ["x[0]", "x[1]", "u[0]", "u[1]", "lower bound of K", "upper bound of K"]
    assert figure.layout.title.text.endswith("steps of ETD1")
    assert [trace.type for trace in figure.data][-3:] == ["bar"] * 3
    figure.to_json()


def test_axes_of_ones_own_are_drawn_into():
    own, axes = plt.subplots(3, sharex=True)
    assert solved().plot(axes=axes) is own
    assert len(axes[0].lines) == 2
    plt.close(own)
    with pytest.raises(dvax.InputError, match="there are 3 panels: x, u, constraints"):
        solved().plot(axes=axes[:2])


def test_events_are_lines_with_their_names_and_a_failed_run_says_where_it_stopped():
    sol = solved()
    index, rows = jnp.array([0, 1, 1]), jnp.zeros((3, 2))
    events = Events(jnp.array([0.5, 1.0, 1.5]), index, rows, rows, ("hit", None))
    stopped = eqx.tree_at(
        lambda s: (s.result, s.events), sol, (dvax.RESULTS.nonfinite, events),
        is_leaf=lambda leaf: leaf is None or isinstance(leaf, dvax.RESULTS),
    )  # fmt: skip
    figure = stopped.plot(time_unit="s")
    assert "stopped at t = 2 s:\nf, h or K returned NaN" in figure.get_suptitle()
    legend = figure.axes[0].get_legend()
    assert {"hit", "event 1"} <= {text.get_text() for text in legend.get_texts()}
    drawn = [line.get_xdata()[0] for line in figure.axes[0].lines if len(line.get_xdata()) == 2]
    assert drawn == [0.5, 1.0, 1.5]
    assert len(stopped.plot(backend="plotly").layout.shapes) == 9


def test_too_few_saved_times_and_wrong_arguments_are_refused():
    sol = solved()
    one = eqx.tree_at(lambda s: (s.ts, s.xs), sol, (sol.ts[:1], sol.xs[:1]))
    with pytest.raises(
        dvax.InputError, match="with 1 saved time;.*Pass ts=jnp.linspace.*dense=True"
    ):
        one.plot()
    failed = eqx.tree_at(lambda s: s.result, one, dvax.RESULTS.nonfinite)
    with pytest.raises(dvax.InputError, match="the run stopped at t = 2: f, h or K returned NaN"):
        failed.plot()
    with pytest.raises(dvax.InputError, match='"matplotlib" or "plotly"'):
        sol.plot(backend="bokeh")
    with pytest.raises(dvax.InputError, match=r"Solution.plot\(states\)"):
        sol.plot(["a", "b", "c"])


@pytest.mark.parametrize("missing", ["matplotlib", "plotly"])
def test_missing_package_names_the_extra(missing, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ModuleNotFoundError, match=rf"{missing}.*pip install 'dvax\[app\]'"):
        solved().plot()


def test_many_entries_are_a_map_of_means_or_quantiles():
    """Time cells and space cells are at most those of a screen, and keep the mean of all values."""
    times = np.linspace(0.0, 1.0, 1000)
    field = np.random.default_rng(0).normal(size=(1000, 720))
    (panel,) = entry_panels(times, "x", field, "K")
    assert isinstance(panel, MapPanel)
    (trace,) = panel.traces("time", "s")
    assert trace.z.shape == (360, 480)
    assert trace.x[0] < 0 and trace.x[-1] > 1 and (trace.y[0], trace.y[-1]) == (-0.5, 719.5)
    assert np.isclose(np.average(trace.z), field.mean(), atol=1e-3)
    (panel,) = entry_panels(times, "x", field.reshape(1000, 20, 36), "K")
    assert isinstance(panel, Panel)
    whole, half = panel.bands
    np.testing.assert_array_equal(whole.low, field.min(axis=1))
    assert (half.low >= whole.low).all() and (panel.curves[0].y <= half.high).all()
    figure = panels_picture("a", "title", "", [panel], "time").still()
    assert len(figure.axes[0].collections) == 2


def test_map_has_a_colour_bar_beside_its_own_panel():
    times = np.linspace(0.0, 1.0, 5)
    maps = [MapPanel(times, np.outer(times, np.arange(8.0)), n, f"entry of {n}") for n in "ab"]
    rows = SpanPanel((Spans("row", np.array([0.1]), np.array([0.4])),), "constraints")
    picture = panels_picture("a", "title", "", [*maps, rows], "time")
    upper, lower = (trace.colorbar for trace in picture.interactive.data[:2])
    assert upper.y > lower.y and upper.len < 0.5
    figure = picture.still()
    figure.draw_without_rendering()
    widths = {round(axes.get_position().width, 3) for axes in figure.axes[:3]}
    assert len(widths) == 1  # panels share the axis of time


def test_ensemble_has_the_mean_between_quantiles_of_its_members():
    values = jnp.arange(11.0)[:, None] * jnp.ones((11, 21))
    zero = jnp.zeros(11)
    moments = Moments(jnp.array(11), jnp.full(21, 5.0), jnp.ones(21))
    every = dvax.Ensemble(
        values, zero > 1, dvax.RESULTS.successful, zero, zero, zero, zero > 1, "ETD1", moments, {}
    )
    figure = every.plot(TS, (0.1, 0.9), name="force", unit="N")
    (axes,) = figure.axes
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), 5.0)
    extents = axes.collections[0].get_paths()[0].get_extents()
    assert (extents.y0, extents.y1) == (1.0, 9.0)
    assert figure.get_suptitle() == "11 members" and "[N]" in axes.get_ylabel()
    three = eqx.tree_at(
        lambda e: (e.values, e.moments.mean, e.moments.squares),
        every,
        (jnp.stack([values] * 3, axis=-1), jnp.full((21, 3), 5.0), jnp.ones((21, 3))),
    )
    rooms, heat = three.plot(TS, names={"room": "degC", "hall": "degC", "heat": "kW"}).axes
    assert "room, hall" in rooms.get_ylabel() and "[kW]" in heat.get_ylabel()
    handles = rooms.get_legend_handles_labels()[1]
    assert handles == ["90 % of the members", "room, mean", "hall, mean"]
    with pytest.raises(dvax.InputError, match="a name of its own for each of the 3 entries"):
        three.plot(TS, names=["room", "hall"])
    with pytest.raises(dvax.InputError, match="Pass the same ts"):
        every.plot(TS[1:])
    with pytest.raises(dvax.InputError, match="keep=False"):
        eqx.tree_at(lambda e: e.values, every, None).plot(TS)
