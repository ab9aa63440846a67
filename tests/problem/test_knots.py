"""The knots of tables are found anywhere in a problem, and steps end at them."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax.signals import Function, Product, Table


def problem(f=None, h=None, K=None):
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=K or dvax.sets.Box(0.0, 1.0),
        f=f or (lambda t, x, u, args: -u),
        h=h or (lambda t, x, u, args: x - u),
    )


ZERO = jnp.zeros(())
DATA = Table([-1.0, 0.5, 1.5, 9.0], [0.0, 1.0, 0.0, 1.0])


@pytest.mark.parametrize(
    "made",
    [
        problem(f=lambda t, x, u, args: DATA(t) - u),
        problem(h=lambda t, x, u, args: DATA(t) - u),
        problem(K=lambda t, args: dvax.sets.Box(0.0, 2.0 + DATA(t))),
        problem(f=lambda t, x, u, args: Product(DATA, 3.0)(t)),
    ],
    ids=["f", "h", "K", "a product"],
)
def test_knots_of_a_table_are_found_anywhere_in_the_problem(made):
    assert made.knots(0.0, 2.0, ZERO).tolist() == [0.5, 1.5]
    assert made.knots(0.5, 1.5, ZERO).tolist() == []


def test_knots_of_a_table_in_args_are_found():
    made = problem(f=lambda t, x, u, args: args["load"](t) - u)
    assert made.knots(0.0, 2.0, ZERO, {"load": DATA}).tolist() == [0.5, 1.5]


def test_knots_of_several_signals_are_merged_once():
    other = Function(lambda t: t, knots=[0.5, 0.75])
    made = problem(f=lambda t, x, u, args: DATA(t) + other(t) - u, h=lambda t, x, u, a: DATA(t) - u)
    assert made.knots(0.0, 2.0, ZERO).tolist() == [0.5, 0.75, 1.5]


def test_knots_of_a_table_at_a_shifted_time_give_a_warning():
    made = problem(f=lambda t, x, u, args: DATA(t - 0.25) - u)
    with pytest.warns(UserWarning, match="other than t itself"):
        assert made.knots(0.0, 2.0, ZERO).tolist() == []


@pytest.mark.thorough
def test_data_that_do_not_cover_the_run_are_rejected():
    made = problem(f=lambda t, x, u, args: DATA(t) - u)
    for t0, t1 in ((0.0, 9.5), (-1.5, 2.0)):
        with pytest.raises(dvax.InputError, match="never extrapolated"):
            dvax.solve(made, 0.0, t0, t1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "dt"),
    mostly_thorough(
        itertools.product(("constant", "linear"), (None, 0.4)),
        [("constant", None), ("linear", 0.4)],
    ),
)
def test_knots_resolve_a_pulse_narrower_than_a_step(kind, dt):
    # x' = −x + pulse, from rest: a load of a millionth of the run, which every step would miss.
    start, width, height, end = 3.0, 1e-5, 1e5, 10.0
    if kind == "constant":
        times, values = [0.0, start, start + width, end], [0.0, height, 0.0, 0.0]
        # ∫ e^{−(T−s)} height ds over the pulse.
        exact = height * np.exp(-(end - start)) * np.expm1(width)
    else:
        half = width / 2
        times, values = [0.0, start, start + half, start + width, end], [0, 0, height, 0, 0]
        s = np.linspace(0, half, 2001)
        tent = np.trapezoid(np.exp(s) * s / half, s) + np.trapezoid(
            np.exp(half + s) * (1 - s / half), s
        )
        exact = height * np.exp(-(end - start)) * tent
    load = Table(times, values, kind)
    made = problem(f=lambda t, x, u, args: load(t) - u * 0.0)
    sol = dvax.solve(made, 0.0, 0.0, end, rtol=1e-9, atol=1e-12, dt=dt)
    assert float(sol.xs[-1]) == pytest.approx(exact, rel=1e-6, abs=1e-9)
