"""`to_xarray` of every result over time, events, intervals or members: names, units, attributes."""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.once import once

import dvax
from dvax.ensembles import Moments
from dvax.evolution import Events
from dvax.evolution.regimes import Regimes

pytest.importorskip("xarray", reason="the extra dvax[app] is not installed")

TS = [0.0, 0.5, 1.0, 2.0]


@once
def pair():
    """x = (a number, a vector of two), u a number in [0, 1/2]."""
    return dvax.Problem(
        A=dvax.generators.Product(dvax.generators.Zero(), dvax.generators.Scalar(-1.0)),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, load: (-load - u, u * jnp.ones(2)),
        h=lambda t, x, u, load: 1.0 - x[0] - u,
        control_space=dvax.spaces.Euclidean(()),
    )  # fmt: skip


@once
def solved():
    start = (jnp.array(1.0), jnp.array([1.0, 2.0]))
    return dvax.solve(pair(), start, 0.0, 2.0, 0.25, TS, method=dvax.ETD1(), dt=0.25, measure=True)


def test_parts_are_numbered_and_attributes_describe_the_run():
    sol = solved()
    data = sol.to_xarray()
    assert {"x0", "x1", "u", "y", "defect"} <= set(data) and data["x1"].dims == ("time", "x1_dim0")
    np.testing.assert_array_equal(data["x1"], sol.xs[1])
    np.testing.assert_array_equal(data["time"], TS)
    assert data["x0"].attrs == {"long_name": "state x0"} and "units" not in data["time"].attrs
    assert data.attrs["result"] == "The end time was reached."
    assert data.attrs["method"] == "ETD1" and data.attrs["steps"] == int(sol.stats["steps"])
    assert data.attrs["Conventions"] == "CF-1.11" and data.attrs["source"].startswith("dvax ")


def test_names_of_entries_or_parts_have_their_units(tmp_path):
    sol = solved()
    data = sol.to_xarray({"a": "mm", "b": "mm/s", "c": ""}, ["force"], time_unit="s")
    units = {name: data[name].attrs.get("units") for name in ("a", "b", "c", "force", "time")}
    assert units == {"a": "mm", "b": "mm/s", "c": "1", "force": None, "time": "s"}
    np.testing.assert_array_equal(data["c"], sol.xs[1][:, 1])
    parts = sol.to_xarray(["depth", "field"])
    assert parts["field"].dims == ("time", "field_dim0")
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")  # every attribute can be stored


@pytest.mark.parametrize(("given", "words"), [
    ({"states": ["a", "b", "c", "d"]}, "for each of the 3 entries, or for each of the 2 parts"),
    ({"states": ["a", "a", "b"]}, "a name of its own"),
    ({"states": ["a", "b"], "responses": ["a"]}, "stands for another variable"),
    ({"responses": ["time"]}, "stands for another variable"),
    ({"states": "ab"}, "a dictionary of names and units"),
])  # fmt: skip
def test_names_that_do_not_fit_are_refused(given, words):
    with pytest.raises(dvax.InputError, match=words):
        solved().to_xarray(**given)


def test_events_and_regimes_are_datasets():
    ts, index = jnp.array([0.5, 1.5, jnp.inf]), jnp.array([1, 0, -1])
    xs = (jnp.arange(3.0), jnp.ones((3, 2)))
    events = Events(ts, index, xs, xs, ("fall", None)).to_xarray()
    assert events["name"].values.tolist() == ["", "fall"]
    assert events["x1"].dims == ("event", "x1_dim0")
    np.testing.assert_array_equal(events["time"], [0.5, 1.5])
    regimes = Regimes(np.array([0.0, 0.7, 2.0]), np.array([[True, False], [True, True]]))
    data = regimes.to_xarray(time_unit="s")
    np.testing.assert_array_equal(data["positive"], regimes.positive)
    assert data["start"][0] == 0.0 and data["end"][-1] == 2.0
    assert data["end"].attrs["units"] == "s"


def test_bound_is_joined_and_has_a_dataset_of_its_own():
    sol = solved()
    twice = 2.0 * sol.ts
    bound = dvax.Bound(sol.ts, sol.ts, twice, sol.ts, twice, None, None, "estimated")
    data = sol.to_xarray(bound=bound)
    np.testing.assert_array_equal(data["error_bound_u"], 2 * sol.ts)
    assert data["error_bound_x"].attrs["status"] == "estimated"
    own = bound.to_xarray(x_unit="mm")
    assert set(own) == {f"error_bound_{n}" for n in ("x", "u", "x_paper", "u_paper")}
    assert own["error_bound_x"].attrs["units"] == "mm"
    shorter = jax.tree.map(lambda leaf: leaf[1:], bound)
    for wrong in (shorter, 3.0):
        with pytest.raises(dvax.InputError, match="at the 4 saved times"):
            sol.to_xarray(bound=wrong)


def test_members_of_an_ensemble_are_a_dimension():
    values = {"end": jnp.arange(3.0), "path": jnp.ones((3, 4, 2))}
    zero = jnp.zeros(3)
    moments = Moments(
        jnp.array(3),
        {"end": jnp.array(1.0), "path": jnp.ones((4, 2))},
        {"end": jnp.array(2.0), "path": jnp.zeros((4, 2))},
    )
    every = dvax.Ensemble(
        values, zero > 1, dvax.RESULTS.successful, zero, zero, zero, zero > 1, "ETD1", moments, {}
    )
    data = every.to_xarray(TS)
    assert data["path"].dims == ("member", "time", "path_dim0") and data["end"].dims == ("member",)
    assert {"failed", "steps", "reached_time", "switched"} <= set(data)
    reduced = eqx.tree_at(lambda e: e.values, every, None).to_xarray(TS)
    assert reduced["path_mean"].dims == ("time", "path_dim0")
    assert reduced["end_std"].values == pytest.approx(1.0)


def test_traced_solutions_and_batches_are_refused():
    sol = solved()
    batch = eqx.tree_at(lambda s: s.ts, sol, sol.ts[None])
    with pytest.raises(dvax.InputError, match="a batch of solutions"):
        batch.to_xarray()

    def inside(ts):
        return eqx.tree_at(lambda s: s.ts, sol, ts).to_xarray()

    with pytest.raises(dvax.InputError, match="inside a compiled program"):
        jax.jit(inside)(sol.ts)


def test_missing_xarray_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'dvax\[app\]'"):
        solved().to_xarray()
