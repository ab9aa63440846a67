"""The `repr` of results: the numbers that they hold, also where these are traced or many."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.once import once

import dvax
from dvax._repr import value_text


@once
def problem():
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, load: load - 0.5 * x - u,
        h=lambda t, x, u, load: 1.0 - 2.0 * x - u,
    )  # fmt: skip


def solve(load, **options):
    return dvax.solve(problem(), -1.0, 0.0, 2.0, load, method=dvax.ETD2RK(), **options)


def test_solution_is_shown_with_its_result_method_and_numbers():
    sol = solve(3.0)
    shown = repr(sol)
    assert shown.startswith("Solution: The end time was reached.")
    for text in ("ETD2RK", "[1.836092]", f"{int(sol.stats['steps'])}", "enclosed over every step"):
        assert text in shown
    assert "f64[" not in shown and len(shown.splitlines()) < 12


def test_failed_solution_is_shown_with_its_failure_and_its_last_time():
    sol = solve(3.0, max_steps=3, throw=False)
    shown = repr(sol).splitlines()
    assert shown[0] == "Solution: The largest number of steps was reached before t1."
    assert ["t", f"{float(sol.stats['t']):.7g}"] in [line.split() for line in shown]


@pytest.mark.slow
def test_solutions_of_a_batch_and_of_a_trace_are_shown():
    assert repr(eqx.filter_vmap(solve)(jnp.linspace(2.0, 4.0, 3))).startswith(
        "Solution: 3 runs, 0 failed"
    )
    shown = []

    def final(load):
        sol = solve(load)
        shown.append(repr(sol))
        return sol.xs[-1]

    jax.jit(final)(3.0)
    assert "Solution: a traced run" in shown[0] and "f64[1]" in shown[0]
    shape = eqx.filter_eval_shape(solve, 3.0)
    assert repr(shape).startswith("Solution: ")


@pytest.mark.slow
def test_constants_verification_and_bound_are_shown_with_statuses():
    check, sol = dvax.verify(problem(), -1.0, 0.0, 2.0, 3.0), solve(3.0)
    bound = dvax.bound_error(problem(), sol, check.constants)
    assert "gamma       2 " in repr(check.constants) and repr(check.constants).count("proved") == 11
    assert repr(check).startswith("Verification: proved, route: variational inequality")
    assert check.table() in repr(check)
    assert repr(bound).startswith("Bound: proved") and f"{float(bound.x[-1]):.3g}" in repr(bound)
    region = dvax.verify(problem(), -1.0, 0.0, 2.0, 3.0, x=(-2.0, 1.0)).constants
    left = repr(dvax.bound_error(problem(), sol, region))
    assert "≤ ∞" in left and "region" in left
    # A verification without constants, and constants of a batch.
    assert "None" not in repr(check._replace(constants=None))
    batch = eqx.filter_vmap(lambda g: dvax.Constants(
        gamma=g, L_F=2.0, alpha_h=2.0, beta_h=1.0, alpha_f=0.5, beta_f=1.0, M=1.0, omega=-1.0, m_P=1.0,
        norm_P_inv=1.0))(jnp.array([1.0, 2.0]))  # fmt: skip
    assert "[1, 2]" in repr(batch)


@pytest.mark.slow
def test_ensemble_is_shown_with_mean_and_failures():
    found = dvax.ensemble(problem(), -1.0, 0.0, 2.0, jnp.linspace(2.0, 4.0, 5))
    assert repr(found).startswith("Ensemble: 5 members, 0 failed")
    assert f"{float(found.mean):.7g}" in repr(found)


@pytest.mark.slow
def test_events_are_shown_with_times_and_names():
    half = dvax.Event(lambda t, x, u, load: x - 0.5, name="half")
    other = dvax.Event(lambda t, x, u, load: x)
    shown = repr(solve(3.0, events=[half, other]).events).splitlines()
    assert shown[0] == "Events: 2"
    assert shown[1].endswith("events[1]") and shown[2].endswith("half")
    shape = eqx.filter_eval_shape(lambda load: solve(load, events=[half]).events, 3.0)
    assert repr(shape).startswith("Events: a trace or a batch")


def test_parameter_bounds_are_shown_with_their_numbers():
    shown = repr(dvax.parameter_bounds(problem(), 2.9, 3.1, -1.0, t1=2.0))
    assert shown.startswith("ParameterBounds: proved") and "C_f0       3.1" in shown


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.0, "1"),
        (np.float64("nan"), "NaN"),
        (np.array([1.0, -np.inf]), "[1, −∞]"),
        (np.arange(10.0), "float64 (10,), 0 to 9"),
        (np.array([[1.0, np.nan]]), "float64 (1, 2), 1 not finite"),
        (np.zeros((0, 3)), "float64 (0, 3)"),
        ((1.0, np.array([2.0])), "1; [2]"),
        (None, ""),
        (np.int64(3), "3"),
    ],
)
def test_values_are_shown_as(value, text):
    assert value_text(value) == text


def test_deleted_array_is_shown_by_its_type():
    array = jnp.arange(8.0)
    array.delete()
    assert value_text(array) == "f64[8]"
