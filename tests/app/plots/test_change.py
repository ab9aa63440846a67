"""The figure of a change: its curves are the numbers, and its axes have labels and units."""

from typing import Any, cast

import numpy as np
import pytest

import dvax
from dvax.app.plots.change import change_figure
from dvax.sensitivity.change import Change, Views


def test_change_figure_shows_the_numbers_with_units():
    ts = np.linspace(0.0, 2.0, 5)
    x, u = (Views(a * ts, 1.1 * a * ts, 5 * a * ts, 2 * a * ts) for a in (1.0, 0.5))
    seen = Change(ts, x, u, cast(Any, None), "proved")
    figure = change_figure(seen, time_unit="s", x_unit="mm", u_unit="kPa")
    above, below = figure.axes
    assert (above.get_ylabel(), below.get_ylabel()) == ("‖Δx‖\n [mm]", "‖Δu‖\n [kPa]")
    assert below.get_xlabel() == "time [s]" and above.get_legend() is not None
    assert above.lines[0].get_label() == "actual difference"
    shown = np.asarray(above.lines[0].get_ydata())
    told = np.isfinite(shown)
    np.testing.assert_allclose(shown[told], seen.x.actual[told])


# The example of `dvax.sensitivity.change` has the largest of these numbers.
@pytest.mark.thorough
def test_change_lies_within_its_bounds_and_near_its_prediction():
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, ell: ell - 0.5 * x - u, h=lambda t, x, u, ell: 1.0 - 2.0 * x - u,
    )  # fmt: skip
    bounds = dvax.parameter_bounds(problem, 2.9, 3.1, t1=2.0)
    seen = dvax.sensitivity.change(problem, -1.0, 0.0, 2.0, 3.0, bounds, dargs=0.1)
    for views in (seen.x, seen.u):
        assert views.certified_sharp is not None
        assert np.all(views.actual <= views.certified_sharp + 1e-9)
        assert np.all(views.certified_sharp <= views.certified * (1 + 1e-12))
        assert np.max(np.abs(views.actual - views.predicted)) < 0.05
    assert change_figure(seen).axes
