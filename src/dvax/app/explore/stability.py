"""A map of stability: the certified boundary and the observed rate over the plane of two parameters.

The distance of two trajectories decays at the certified rate at least, α + d_x − d_u b_x/(1 + b_u) or,
with the constants of the paper, α − d_x − d_u b_x/(1 + b_u). The observed rate is that of two computed
trajectories, −log(‖Δx(t)‖/‖Δx(0)‖)/t, at some points of the boundary.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from dvax.app.explore.contact_data import Data
from dvax.app.explore.drawing import POWERS, layout, single
from dvax.app.explore.subject import Drawing, Parameter, Values
from dvax.app.plots.theme import BLUE, INK, VERMILLION, axis_title
from dvax.app.runs.settings import Config
from dvax.evolution import ETD2RK, solve

CELLS, POINTS, STEPS = 25, 12, 400
_RATES = [[0.0, VERMILLION], [0.5, "#f4f4f2"], [1.0, BLUE.lower()]]
"""From trajectories that part to those that approach each other."""
_FLOOR = 1e-9
"""A distance, relative to the first one, below which it is roundoff."""


def plane(
    data: Data, companion_x0: np.ndarray, times: np.ndarray, config: Config, values: Values,
    axes: tuple[Parameter, Parameter],
) -> Drawing:  # fmt: skip
    """Return the map over the ranges of two parameters; the others have these values."""
    spans = [
        (np.geomspace if axis.log else np.linspace)(axis.low, axis.high, CELLS) for axis in axes
    ]
    first, second = (grid.ravel() for grid in np.meshgrid(*spans, indexing="ij"))
    arrays = {key: jnp.full(first.shape, float(value)) for key, value in values.items()}
    arrays |= {axes[0].key: jnp.asarray(first), axes[1].key: jnp.asarray(second)}
    few = _some_points(data, config)
    starts = jnp.asarray(np.stack([np.asarray(data.x0), companion_x0])[:, _some(data)])
    step = config.solver.dt or float(times[-1]) / STEPS
    paper, sharp, distance = _rates(arrays, few, starts, times, float(times[-1]), step)
    observed = _observed(times, np.asarray(distance)).reshape(CELLS, CELLS).T
    limit = float(np.nanmax(np.abs(observed)))
    x, y = map(single, spans)
    rate = f"1/{config.units.time}"
    curves: list[Any] = [
        {
            "type": "heatmap", "x": x, "y": y, "z": single(observed), "colorscale": _RATES,
            "zmin": -limit, "zmax": limit, "zsmooth": False,
            "colorbar": {"title": {"text": axis_title("observed rate", rate), "side": "right"},
                         "thickness": 12},
            "hovertemplate": "(%{x:.3g}, %{y:.3g}): observed rate %{z:.3g} " + rate
            + "<extra></extra>",
        },
        _boundary(x, y, sharp, "certified, rate with signs", "solid"),
        _boundary(x, y, paper, "certified, constants of the paper", "dash"),
        {
            "type": "scatter", "mode": "markers", "name": "the present values",
            "x": [values[axes[0].key]], "y": [values[axes[1].key]], "hoverinfo": "skip",
            "marker": {"symbol": "circle", "size": 13, "color": VERMILLION,
                       "line": {"width": 2, "color": "white"}},
        },
    ]  # fmt: skip
    titles = [(axis.label.partition(",")[0], axis.unit) for axis in axes]
    kinds = [{**POWERS, "dtick": "D2"} if axis.log else {} for axis in axes]
    return Drawing(
        "stability",
        "Stability in a plane of parameters",
        "Colour: the observed rate at which two trajectories approach each other (blue) or part "
        "(orange), at some points of the boundary. Lines: where the certified rate is zero; on the "
        "side that it certifies, trajectories approach for all data. Click to move both sliders there.",
        curves,
        layout(
            480, titles[0], titles[1], xaxis={**kinds[0], "showgrid": False},
            yaxis={**kinds[1], "showgrid": False}, showlegend=True,
        ),
    )  # fmt: skip


def _boundary(x: Any, y: Any, rate: Any, name: str, dash: str) -> dict[str, Any]:
    """Return the line where a rate is zero."""
    values = np.asarray(rate).reshape(CELLS, CELLS).T
    return {
        "type": "contour", "x": x, "y": y, "z": single(values), "name": name, "showscale": False,
        "autocontour": False, "contours": {"coloring": "none", "start": 0.0, "end": 0.0, "size": 1.0},
        "line": {"color": INK, "width": 2.5, "dash": dash}, "hoverinfo": "skip", "showlegend": True,
    }  # fmt: skip


def _some(data: Data) -> np.ndarray:
    count = data.x0.shape[0]
    return np.unique(np.linspace(0, count - 1, min(count, POINTS)).astype(int))


def _some_points(data: Data, config: Config) -> Data:
    """Return the data at a few points: the law holds at each point by itself."""
    count, some = data.x0.shape[0], _some(data)

    def at_some(leaf: Any) -> Any:
        # Fields have the points as their last axis; times and factors do not.
        fits = eqx.is_array(leaf) and leaf.ndim > 0 and leaf.shape[-1] == count
        return leaf[..., some] if fits else leaf

    return jtu.tree_map(at_some, data)


@eqx.filter_jit
def _rates(
    values: dict[str, jax.Array],
    data: Data,
    starts: jax.Array,
    times: Any,
    end: float,
    step: float,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return both certified rates and the distance of two trajectories, for all rows of `values`."""

    def one(values: dict[str, Any]) -> tuple[Any, Any, Any]:
        model = data.model(values)
        problem, constants = model.problem, model.constants

        def run(x0: jax.Array) -> Any:
            return solve(
                problem, x0, 0.0, end, None, times, method=ETD2RK(), dt=step,
                throw=False,
            ).xs  # fmt: skip

        first, second = jax.vmap(run)(starts)
        distance = jax.vmap(problem.spaces(first[0])[0].norm)(first - second)
        return constants.decay_rate, constants.sharp_decay_rate, distance

    return jax.vmap(one)(values)


def _observed(times: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return the mean rate of decay up to the last time at which the distance is above roundoff."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = distance / distance[:, :1]
        above = np.isfinite(relative) & (relative > _FLOOR)
        above[:, 0] = True
        last = distance.shape[1] - 1 - np.argmax(above[:, ::-1], axis=1)
        rows = np.arange(len(distance))
        return -np.log(relative[rows, last]) / times[last]
