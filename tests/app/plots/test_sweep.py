"""The report of a sweep: which axes are logarithmic, and which arrays of its store are figures."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import zarr

from dvax.app.plots.sweep import _PANELS, _Axis, _members, _omission, _with_numbers

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("values", "is_wide"),
    [
        ([0.1, 0.3, 1.0, 3.0, 10.0], True),
        (np.geomspace(1.0, 10.0, 7), True),
        (10.0 ** RNG.uniform(-3.0, 1.0, 50), True),
        (np.linspace(0.1, 10.0, 5), False),
        (RNG.uniform(1.0, 100.0, 50), False),
        ([1.0, 2.0, 4.0], False),
        ([0.0, 1.0, 10.0, 100.0], False),
        ([-1.0, 10.0, 100.0], False),
        ([0.1, 10.0], False),
        ([0.1, 1e5], True),
        ([np.nan, 1.0, np.inf, 10.0, 100.0], True),
        ([np.nan], False),
        ([1e10, 1e188, 1e190, 1e192], True),
    ],
)
def test_axis_is_logarithmic_where_values_spread_by_their_ratios(values, is_wide):
    assert _Axis("a", np.asarray(values), "", "").is_wide == is_wide


def test_entries_of_short_vectors_are_figures_and_variables_over_time_are_not(tmp_path):
    group = zarr.open_group(tmp_path / "sweep.zarr", mode="w", zarr_format=3)
    for name, values, dims in (
        ("status", np.array([1, 2, 1]), ["member"]),
        ("rate", np.array([1.0, 2.0, 3.0]), ["member"]),
        ("peak", np.array([0.1, np.nan, 0.3]), ["member"]),
        ("end", np.arange(6.0).reshape(3, 2), ["member", "end_0"]),
        ("long", np.zeros((3, 40)), ["member", "long_0"]),
        ("x", np.zeros((3, 5)), ["member", "time"]),
    ):
        group.create_array(name, data=values, dimension_names=dims, attributes={"units": "m"})
    found = _members(tmp_path / "sweep.zarr", ["rate"])
    assert found is not None
    assert [figure.name for figure in found.figures] == ["end[0]", "end[1]", "peak"]
    np.testing.assert_array_equal(found.figures[1].values, [1.0, 3.0, 5.0])
    np.testing.assert_array_equal(found.finished, [True, False, True])


def test_figures_of_the_author_come_before_final_states_and_omissions_are_stated(tmp_path):
    group = zarr.open_group(tmp_path / "sweep.zarr", mode="w", zarr_format=3)
    finals = [f"final_{k}" for k in range(_PANELS)]
    for name in ("status", "rate", "steps", "yield_total", *finals):
        group.create_array(name, data=np.array([1, 1]), dimension_names=["member"])
    found = _members(tmp_path / "sweep.zarr", ["rate"])
    assert found is not None
    assert [f.name for f in found.figures] == ["yield_total", *finals, "steps"]
    assert f"{_PANELS} of {_PANELS + 2} figures are drawn" in _omission(found)
    assert _omission(replace(found, figures=found.figures[:_PANELS])) == ""


def test_names_are_in_the_order_of_their_numbers():
    names = ["final_q10", "final_q2", "final_q1", "x²", "final_p[2]", "3d"]
    expected = ["3d", "final_p[2]", "final_q1", "final_q2", "final_q10", "x²"]
    assert sorted(names, key=_with_numbers) == expected


def test_texts_are_read_as_values_of_an_axis(tmp_path):
    """Methods, or quantities with units, are texts of any length, which zarr reads as such."""
    group = zarr.open_group(tmp_path / "sweep.zarr", mode="w", zarr_format=3)
    texts = np.array(["ETD2RK", "20 N/m", "4"], dtype=np.dtypes.StringDType())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the type is no part of the specification of zarr yet
        group.create_array("model.method", data=texts, dimension_names=["member"])
    group.create_array("status", data=np.array([1, 1, 2]), dimension_names=["member"])
    group.create_array("peak", data=np.array([0.1, 0.2, 0.3]), dimension_names=["member"])
    found = _members(tmp_path / "sweep.zarr", ["model.method"])
    assert found is not None
    assert [axis.values.tolist() for axis in found.parameters] == [["ETD2RK", "20 N/m", "4"]]
