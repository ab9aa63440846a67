"""What is refused before the first run of a problem is compiled."""

import sys

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import dvax
from dvax import generators, operators, sets, signals

SHORT = signals.Table(jnp.array([0.0, 0.5, 0.9]), jnp.array([1.0, 2.0, 1.0]))


UNIT = sets.Box(0.0, 1.0)


def problem(f, K=UNIT):
    return dvax.Problem(
        A=generators.Zero(), P=operators.Scaling(1.0), K=K, f=f,
        h=lambda t, x, u, args: x - u,
    )  # fmt: skip


@pytest.fixture
def nothing_compiled(monkeypatch):
    def compiled(*args):
        raise AssertionError("a run was compiled")

    monkeypatch.setattr(sys.modules["dvax.evolution.solve"], "compiled", compiled)


@pytest.mark.usefixtures("nothing_compiled")
@pytest.mark.parametrize("method", [None, dvax.DormandPrince(), dvax.ETD2RK()])
@pytest.mark.parametrize(
    ("own", "args", "words"),
    [
        (problem(lambda t, x, u, args: SHORT(t) - u), None, "a Table in f"),
        (problem(lambda t, x, u, args: args["load"](t) - u), {"load": SHORT}, "0 to 0.9"),
        (
            problem(lambda t, x, u, args: -u, lambda t, args: sets.Box(0.0, SHORT(t))),
            None,
            "a Table in K",
        ),
        (problem(lambda t, x, u, args: args["a"] * x), {"a": np.nan, "b": 1.0}, "nan in ['a']"),
        (
            problem(lambda t, x, u, args: args[1] * x),
            (1.0, jnp.array([1.0, np.nan])),
            "nan in component (1,)",
        ),
        (problem(lambda t, x, u, args: args["a"] * x), pd.Series({"a": 1.0}), "a Series of pandas"),
        (
            problem(lambda t, x, u, args: args["a"] * x),
            {"a": pd.Series([1.0, 2.0])},
            "jnp.asarray(v.to_numpy())",
        ),
    ],
    ids=["table", "table in args", "table in K", "number", "vector", "args", "part of args"],
)
def test_data_that_make_a_run_fail_are_refused_before_it_is_compiled(own, args, words, method):
    with pytest.raises(dvax.InputError) as caught:
        dvax.solve(own, jnp.ones(2), 0.0, 1.0, args, method=method)
    assert words in str(caught.value)


@pytest.mark.slow
def test_data_that_are_not_used_may_be_nan():
    own = problem(lambda t, x, u, args: args["a"] * x - u)
    args = {"a": -1.0, "missing": np.array([np.nan])}
    assert np.isfinite(dvax.solve(own, jnp.ones(2), 0.0, 1.0, args).xs).all()


FRAME = pd.DataFrame({"t": [0.0, 1.0], "load": [1.0, 2.0]})
SERIES = FRAME["load"]


@pytest.mark.parametrize(
    ("f", "name"),
    [
        (lambda t, x, u, args: SERIES - u, "`SERIES`, a Series"),
        (lambda t, x, u, args: jnp.interp(t, FRAME.t, FRAME.load) - u, "`FRAME`, a DataFrame"),
    ],
)
def test_a_table_of_pandas_in_a_function_is_named(f, name):
    with pytest.raises(dvax.InputError) as caught:
        dvax.solve(problem(f), jnp.ones(2), 0.0, 1.0)
    message = str(caught.value)
    assert name in message and "to_numpy()" in message and "test_first_run.py" in message


@pytest.mark.usefixtures("nothing_compiled")
def test_saved_times_in_the_place_of_args_are_refused():
    own = problem(lambda t, x, u, args: -u)
    for times in (np.linspace(0.0, 1.0, 11), jnp.array([0.5, 1.0])):
        with pytest.raises(dvax.InputError, match="no function of the problem uses it.*ts="):
            dvax.solve(own, jnp.ones(2), 0.0, 1.0, times)


@pytest.mark.parametrize("x0", [(0.0, 1.0), (1.0, 2.0, 3.0)])
def test_a_vector_that_is_given_as_a_tuple_is_named(x0):
    own = problem(lambda t, x, u, args: -x - u)
    with pytest.raises(dvax.InputError) as caught:
        dvax.solve(own, x0, 0.0, 1.0)
    listed = ", ".join(f"{v:g}" for v in x0)
    assert f"a tuple of {len(x0)} numbers" in str(caught.value).splitlines()[0]
    assert f"x0 = [{listed}]" in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    "args",
    [np.array([0.0, 0.5, 1.0]), np.array([3.0, 2.0]), np.array([0.5, 7.0]), np.array([0.5])],
    ids=["used", "falling", "later", "one"],
)
def test_arrays_in_args_that_may_be_parameters_are_accepted(args):
    own = problem(lambda t, x, u, args: -u)
    if args.size == 3:
        own = problem(lambda t, x, u, args: args[:2] - u)
    assert np.isfinite(dvax.solve(own, jnp.ones(2), 0.0, 1.0, args).xs).all()
