"""Functions without a finite derivative somewhere, or without any, and random keys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dvax


def tanks(gain=4.0, limit=1.2):
    """Two tanks in a row, fed by a pump: outflow ∝ √level has an infinite slope where one is empty."""

    def f(t, x, u, a):
        q = a * jnp.sqrt(jnp.maximum(x, 0.0))
        return jnp.stack([u - q[0], q[0] - q[1]])

    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, limit), f=f,
        h=lambda t, x, u, a: gain * (jnp.where(t < 8.0, 1.5, 0.0) - x[1]),
        control_space=dvax.spaces.Euclidean(()),
    )  # fmt: skip


def exact_levels(x0, a, end, gain=4.0, limit=1.2):
    def rate(t, x, target):
        q = a * np.sqrt(np.maximum(x, 0.0))
        u = np.clip(gain * (target - x[1]), 0.0, limit)
        return [u - q[0], q[0] - q[1]]

    x = np.asarray(x0, float)
    for start, stop, target in ((0.0, min(8.0, end), 1.5), (8.0, end, 0.0)):
        if stop > start:
            found = solve_ivp(rate, (start, stop), x, args=(target,), rtol=1e-9, atol=1e-11)
            x = found.y[:, -1]
    return x


@pytest.mark.slow
@pytest.mark.parametrize("x0", [(0.0, 0.0), (1.0, 0.5), (0.0, 2.0)])
@pytest.mark.parametrize("a", [0.5, 0.9, 2.0])
def test_tanks_that_start_or_run_empty_are_solved_by_default(x0, a):
    for end in (6.0, 20.0):
        sol = dvax.solve(tanks(), jnp.array(x0), 0.0, end, a)
        np.testing.assert_allclose(sol.xs[-1], exact_levels(x0, a, end), atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("x0", [(0.0, 0.0), (1.0, 0.5)])
def test_exponential_rosenbrock_goes_on_where_the_jacobian_is_infinite(x0):
    sol = dvax.solve(tanks(), jnp.array(x0), 0.0, 6.0, 0.9, method=dvax.ExpRosenbrock())
    np.testing.assert_allclose(sol.xs[-1], exact_levels(x0, 0.9, 6.0), atol=2e-5)


@pytest.mark.slow
def test_an_ensemble_of_tanks_has_no_failure():
    x0s = jnp.array([[0.0, 0.0], [1.0, 0.5], [0.3, 0.1]])
    found = dvax.ensemble(tanks(), x0s, 0.0, 20.0, 0.9)
    assert not np.any(found.failed)


def sine(x):
    """By a callback, of which JAX has no derivative."""
    return jax.pure_callback(
        lambda v: np.sin(v), jax.ShapeDtypeStruct(x.shape, x.dtype), x, vmap_method="sequential"
    )


def coupled(g):
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, args: g(x, args) + 0.1 * u, h=lambda t, x, u, args: 0.3 * x,
    )  # fmt: skip


@pytest.mark.slow
def test_a_callback_is_solved_by_a_method_that_needs_no_derivative():
    x0 = jnp.array([0.3, 0.5])
    sol = dvax.solve(coupled(lambda x, args: sine(x)), x0, 0.0, 2.0)
    same = dvax.solve(coupled(lambda x, args: jnp.sin(x)), x0, 0.0, 2.0, rtol=1e-10)
    np.testing.assert_allclose(sol.xs, same.xs, rtol=1e-5)
    assert str(sol.stats["method"]).startswith("DormandPrince")
    found = dvax.verify(coupled(lambda x, args: sine(x)), x0, 0.0, 2.0)
    assert dict(found.constants.statuses)["alpha_f"] == "estimated"


KEY = jax.random.key(1)
RANDOM = {
    "args": (lambda x, key: jnp.tanh(jax.random.normal(key, (2, 2)) @ x), KEY),
    "closure": (lambda x, args: jnp.tanh(jax.random.normal(KEY, (2, 2)) @ x), None),
    "inside": (lambda x, args: jnp.tanh(jax.random.normal(jax.random.key(1), (2, 2)) @ x), None),
}


@pytest.mark.slow
@pytest.mark.parametrize("where", RANDOM)
def test_random_keys_are_parameters_as_others(where):
    g, args = RANDOM[where]
    W = jax.random.normal(KEY, (2, 2))
    same = dvax.solve(coupled(lambda x, args: jnp.tanh(W @ x)), jnp.ones(2), 0.0, 1.0)
    sol = dvax.solve(coupled(g), jnp.ones(2), 0.0, 1.0, args)
    np.testing.assert_allclose(sol.xs, same.xs, rtol=1e-6)
    found = dvax.verify(coupled(g), jnp.ones(2), 0.0, 1.0, args)
    assert found.constants.alpha_f >= 0.99 * np.linalg.norm(W, 2)
    assert float(dvax.bound_error(coupled(g), sol).x[-1]) < 1e-4


@pytest.mark.slow
def test_where_each_method_fails_the_reason_is_told_and_not_stability():
    """Stability limits the first method long before √(2 − t) ends every run."""

    def f(t, x, u, args):
        away = x - jnp.cos(t)
        return -1e4 * away**3 - 1e5 * away + u * jnp.sqrt(2.0 - t)

    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0), f=f,
        h=lambda t, x, u, args: 0.3 * x,
    )  # fmt: skip
    with pytest.raises(dvax.SolveError, match="NaN") as caught:
        dvax.solve(problem, 1.0, 0.0, 4.0)
    assert caught.value.solution.result == dvax.RESULTS.nonfinite
