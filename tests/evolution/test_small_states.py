"""A state that is smaller than atol is named, in any unit and space, and no other is."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.evolution import first_run

TIMES = np.linspace(0.0, 3.0, 7)


def problem(scale, space=None):
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-0.5 * scale, 0.5 * scale), state_space=space, control_space=space,
        f=lambda t, x, u, args: scale * jnp.cos(3.0 * t) + u, h=lambda t, x, u, args: -x,
    )  # fmt: skip


def run(scale, space=None, size=2, **options):
    first_run._SEEN.clear()
    return dvax.solve(problem(scale, space), jnp.zeros(size), 0.0, 3.0, ts=TIMES, **options)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-9, 1e-12, 1e-30])
def test_state_below_atol_is_named_with_the_tolerance_that_resolves_it(scale):
    with pytest.warns(UserWarning, match="atol = 1e-09 hides the solution") as found:
        run(scale)
    text = str(found[0].message)
    better = float(text.split("Pass atol = ")[1].split()[0])
    exact = np.asarray(run(1.0, atol=1e-12, rtol=1e-10).xs) * scale
    close = np.asarray(run(scale, atol=better).xs)
    assert np.max(np.abs(close - exact)) < 1e-2 * np.max(np.abs(exact))


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-7, 1.0, 1e6])
def test_larger_states_are_not_named(scale):
    run(scale)


@pytest.mark.slow
def test_weights_of_the_state_space_count():
    small = dvax.spaces.L2(jnp.full(2, 1e-18))
    with pytest.warns(UserWarning, match="hides the solution"):
        run(1.0, small)
    run(1e-9, dvax.spaces.L2(jnp.full(2, 1e18)))


@pytest.mark.slow
def test_a_state_that_stays_0_is_exact_and_one_that_decays_was_large():
    run(0.0)
    first_run._SEEN.clear()
    dvax.solve(problem(0.0), jnp.ones(2), 0.0, 40.0)


@pytest.mark.slow
def test_run_that_ended_before_the_first_saved_time_is_not_examined():
    first_run._SEEN.clear()
    own = problem(1e-12)
    sol = dvax.solve(own, jnp.zeros(2), 0.0, 3.0, ts=TIMES[1:], max_steps=2, throw=False)
    assert sol.xs.shape == (0, 2)


def test_fixed_steps_have_no_tolerance_and_traced_states_no_size():
    run(1e-12, dt=0.01)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        first_run._SEEN.clear()
        jax.eval_shape(lambda x: dvax.solve(problem(1e-12), x, 0.0, 3.0).xs, jnp.zeros(2))


@pytest.mark.slow
@pytest.mark.parametrize("modulus", [1.0, 1e3, 1e9])
@pytest.mark.parametrize("viscosity", [1e-2, 7e3])
def test_rounding_errors_of_rates_that_cancel_are_not_named(modulus, viscosity):
    """An elastic load h: x' = 1.1 (u − h)/η with u = h within K."""
    direction = jnp.array([0.3, 0.7, -0.1])
    elastic = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Ball(0.0, modulus),
        f=lambda t, x, u, args: (1.1 * u - modulus * t * direction * 1.1) / viscosity,
        h=lambda t, x, u, args: modulus * (t * direction - x),
    )  # fmt: skip
    first_run._SEEN.clear()
    atol = 1e-9 * modulus / viscosity
    sol = dvax.solve(elastic, jnp.zeros(3), 0.0, 0.9, ts=np.linspace(0.0, 0.9, 5), atol=atol)
    assert np.max(np.abs(sol.xs)) < atol
