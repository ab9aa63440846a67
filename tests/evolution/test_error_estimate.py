"""Steps may add what earlier errors lose, and the error stays below the tolerance: rates of decay of 1
to 10⁴, slow and fast parts, and trajectories that approach each other first and separate later."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tests.once import once
from tests.selection import mostly_thorough

import dvax
from dvax.evolution.error_estimate import counted, probe, with_decay

METHODS = {
    "default": None,
    "ETD4RK": dvax.ETD4RK(),
    "DormandPrince": dvax.DormandPrince(),
    "ExpRosenbrock": dvax.ExpRosenbrock(),
}


def test_error_estimate_is_that_of_the_linearised_system():
    # f̃ = Bx with eigenvalues −1 and −4: e + ¼hBe, part by part.
    space, h = dvax.spaces.Euclidean((2,)), 0.5
    x0, e, rates = jnp.array([1.0, 2.0]), jnp.array([3e-9, -1e-9]), jnp.array([-1.0, -4.0])
    near = probe(space, h, x0, e, rates * x0)
    assert 1e-10 < np.linalg.norm(near - x0) < 1e-6
    found = with_decay(space, h, x0, e, rates * near, rates * x0)
    np.testing.assert_allclose(found, e * (1.0 + 0.25 * h * rates), rtol=1e-6)
    # Nothing is known of no error, and nothing decays over a kink or at the limit of stability.
    zero = jnp.zeros(2)
    assert not np.any(with_decay(space, h, x0, zero, rates * x0, rates * x0))
    np.testing.assert_array_equal(counted(e, 0.5 * e, True, None), e)
    np.testing.assert_array_equal(counted(e, 0.5 * e, False, 2.5), e)
    np.testing.assert_array_equal(counted(e, 0.5 * e, False, jnp.nan), 0.5 * e)


@once
def held():
    """x' = u, u = μ(t)(sin t − x) within wide limits, and a second part that is slow: y' = ½x − y."""
    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1e6, 1e6),
        f=lambda t, x, u, p: jnp.stack([u, 0.5 * x[0] - x[1]]),
        h=lambda t, x, u, p: jnp.where(t < p["turn"], p["before"], p["after"]) * (jnp.sin(t) - x[0]),
        control_space=dvax.spaces.Euclidean(()),
    )  # fmt: skip


def truth(before, after, turn, end):
    def field(rate):
        return lambda t, x: [rate * (np.sin(t) - x[0]), 0.5 * x[0] - x[1]]

    x = np.array([0.5, 0.0])
    for rate, span in ((before, (0.0, min(turn, end))), (after, (turn, end))):
        if span[1] > span[0]:
            found = solve_ivp(field(rate), span, x, "Radau", rtol=1e-12, atol=1e-14)
            x = found.y[:, -1]
    return x


def error(before, after, turn, end, tol, method):
    args = {"before": before, "after": after, "turn": turn}
    sol = dvax.solve(
        held(), jnp.array([0.5, 0.0]), 0.0, end, args, rtol=tol, atol=tol, method=METHODS[method]
    )
    exact = truth(before, after, turn, end)
    scale = tol * (1.0 + np.sqrt(np.mean(exact**2)))
    # The parts one by one: the fast one must not hide the slow one.
    return np.abs(np.asarray(sol.xs[-1]) - exact) / scale, int(sol.stats["steps"])


@pytest.mark.slow
@pytest.mark.parametrize("method", mostly_thorough(METHODS, ["default"]))
@pytest.mark.parametrize("rate", mostly_thorough([1.0, 10.0, 1e2, 1e3, 1e4], [1e2]))
@pytest.mark.parametrize("tol", mostly_thorough([1e-4, 1e-6, 1e-8], [1e-6]))
def test_error_stays_below_the_tolerance_where_errors_decay(method, rate, tol):
    found, _ = error(rate, rate, 100.0, 10.0, tol, method)
    assert np.all(found < 1.0)


@pytest.mark.thorough
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("growth", mostly_thorough([0.5, 1.0, 2.0, 4.0], [2.0]))
@pytest.mark.parametrize("rate", mostly_thorough([10.0, 1e2, 1e3], [1e2]))
def test_error_is_the_tolerance_times_the_growth_after_a_decay(method, growth, rate):
    # Errors decay at first, so that steps owe much; from t = 8 on they grow to e^{2 growth}.
    found, _ = error(rate, -growth, 8.0, 10.0, 1e-6, method)
    assert np.all(found < np.exp(2.0 * growth))


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["ETD4RK", "DormandPrince"])
def test_decay_saves_steps(method):
    # A certificate integrates the norm of the defect, so that with constants nothing is owed.
    tol, args = 1e-8, {"before": 50.0, "after": 50.0, "turn": 100.0}
    constants = SimpleNamespace(gamma=1.0, L_F=1.0, norm_P_inv=1.0)
    _, steps = error(50.0, 50.0, 100.0, 10.0, tol, method)
    strict = dvax.solve(
        held(), jnp.array([0.5, 0.0]), 0.0, 10.0, args, rtol=tol, atol=tol, method=METHODS[method],
        constants=constants,
    )  # fmt: skip
    assert 2 * steps < int(strict.stats["steps"])
