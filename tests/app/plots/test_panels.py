"""Axes do not show roundoff, and curves beside each other differ without their colours."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvax.app.plots.applications import application_pictures
from dvax.app.plots.downsample import centres, rounded
from dvax.app.plots.field import field_pictures
from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.app.plots.section import Axis

X = np.linspace(0.0, 1.0, 50)


def ends(y: np.ndarray, log: bool = False) -> Any:
    """The ends of the vertical axis of a curve; None where Plotly chooses them."""
    panel = Panel([Curve(X, y, "y")], "y", "mm", log=log)
    return panels_picture("a", "A", "", [panel], "x").interactive.layout.yaxis.range


def test_logarithmic_axis_of_nearly_equal_values_has_a_whole_decade() -> None:
    assert ends(np.linspace(8.28e-15, 8.305e-15, 50), log=True) == (-15.0, -14.0)
    assert ends(np.geomspace(0.9, 1.1, 50), log=True) == (-1.0, 1.0)
    assert ends(np.geomspace(1e-9, 1e-3, 50), log=True) is None


def test_linear_axis_of_nearly_equal_values_begins_at_zero() -> None:
    assert ends(2.0 + 1e-12 * np.sin(9 * X)) == pytest.approx((0.0, 2.4))
    assert ends(np.full(50, -3.0)) == pytest.approx((-3.6, 0.0))
    assert ends(np.zeros(50)) is None
    assert ends(np.sin(9 * X)) is None
    assert ends(np.full(50, np.nan)) is None


def test_path_in_a_plane_has_a_margin_and_no_common_read_out() -> None:
    loop = Panel([Curve(np.cos(9 * X), np.sin(9 * X), "loop")], "y")
    layout = panels_picture("a", "A", "", [loop], "x").interactive.layout
    assert layout.hovermode is None
    assert layout.xaxis.range[0] < np.cos(9 * X).min() and layout.xaxis.range[1] > 1.0
    over_time = panels_picture("a", "A", "", [Panel([Curve(X, X, "y")], "y")], "time", "s")
    assert over_time.interactive.layout.hovermode == "x unified"
    assert over_time.zoom == "time [s]"


def test_alternative_names_axes_ranges_and_curves() -> None:
    panels = [Panel([Curve(X, 2 * X, "force"), Curve(X, -X, "limit")], "load", "kN")]
    picture = panels_picture("a", "A test", "", panels, "time", "s")
    assert picture.description == ("A test. Over time [s]: load [kN] from -1 to 2: force, limit.")


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True, width=32), min_size=1))
def test_rounded_values_have_four_digits_and_keep_gaps(values: list[float]) -> None:
    given_values = np.array(values, np.float32)
    near = rounded(given_values)
    finite = np.isfinite(given_values)
    np.testing.assert_array_equal(near[~finite], given_values[~finite])
    # Below the normal numbers, steps are absolute.
    size = np.maximum(np.abs(given_values[finite]), np.finfo(np.float32).tiny)
    apart = np.abs(near[finite].astype(float) - given_values[finite].astype(float))
    assert (apart <= 2.0**-13 * size).all()


def test_profile_of_a_field_is_a_column_of_its_map() -> None:
    times, places = np.linspace(0.0, 3.0, 7), np.linspace(0.0, 1.0, 5)
    values = np.outer(times, places)
    whole, profile = field_pictures(
        "heat", "Heat", times, places, values, Axis("place", "m"), Axis("heat", "K"), "s"
    )
    assert profile.frames is not None and profile.frames.labels[2] == "t = 1 s"
    np.testing.assert_array_equal(profile.frames.times, times)
    (change,) = profile.frames.changes
    assert change.section == ("heat", 0)
    z = np.asarray(whole.interactive.data[0].z)
    np.testing.assert_allclose(z, values.T, rtol=2e-4)
    np.testing.assert_array_equal(profile.interactive.data[0].x, places)
    # All profiles fit the axis, which stays the same over time.
    low, high = profile.interactive.layout.yaxis.range
    assert low < values.min() and values.max() < high


def test_centres_of_cells_are_their_points_or_middles() -> None:
    edges = np.array([0.0, 1.0, 4.0])
    np.testing.assert_array_equal(centres(edges, np.array([0.1, 3.0])), [0.1, 3.0])
    np.testing.assert_array_equal(centres(edges, np.arange(5.0)), [0.5, 2.5])


def variable(values: np.ndarray) -> Any:
    return SimpleNamespace(values=values, unit="K", status="")


def test_many_series_of_one_unit_are_drawn_as_a_field() -> None:
    t = np.linspace(0.0, 1.0, 9)
    few = {f"T{k}": variable(k * t) for k in range(12)}
    many = {f"T{k}": variable(k * t) for k in range(13)}
    keys = [p.key for p in application_pictures("python", {"time": variable(t), **few})]
    assert keys == ["histories"]
    keys = [p.key for p in application_pictures("python", {"time": variable(t), **many})]
    assert keys == ["field-0", "field-0-section"]


def test_curves_of_the_same_panel_differ_in_colour_or_dash() -> None:
    t = np.linspace(0.0, 1.0, 9)
    data = {"time": variable(t), **{f"T{k}": variable(k * t) for k in range(12)}}
    (picture,) = application_pictures("python", data)
    styles = [(trace.line.color, trace.line.dash) for trace in picture.interactive.data]
    assert len(set(styles)) == 12
