"""A field with moving free boundaries: orders, tolerances, and the position of the boundaries."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tests.closed_forms import c7, c7_solution

import dvax

N = 64


def mean(v):
    return float(np.sqrt(np.mean(np.asarray(v) ** 2)))


@functools.cache
def disturbed():
    """The same system from another start, where f̃ is not smooth along the solution, and its end by
    a method of scipy on the matrix of A."""
    s = (np.arange(N) + 0.5) * np.pi / N
    k = np.arange(1, N + 1)
    waves = np.sin(np.outer(s, k)) * np.where(k == N, np.sqrt(0.5), 1.0) * np.sqrt(2 / N)
    A = -(waves * k**2) @ waves.T

    def field(t, x):
        star, u = c7_solution(N, t)
        load = 0.2 * star + u
        return A @ x + load - 0.2 * x - np.clip((1.0 - 1.5 * x) / 1.5, 0.0, 0.4)

    x0 = np.sin(s) + 0.3 * np.sin(2.0 * s)
    ts = np.linspace(0.0, 1.0, 6)
    exact = solve_ivp(field, (0.0, 1.0), x0, method="LSODA", rtol=1e-12, atol=1e-13, t_eval=ts)
    return x0, ts, exact.y.T


def test_rod_with_free_boundaries_is_solved_exactly_along_its_closed_form():
    """The reduced map is zero along the closed form, so that only rounding remains."""
    # x = e^{tA}x₀ there, and f̃ is zero: what is left is rounding, whatever the kinks beside it.
    case = c7(N)
    sol = dvax.solve(case.problem, case.x0, 0.0, 1.0, dt=0.05)
    np.testing.assert_allclose(sol.xs[-1], c7_solution(N, 1.0)[0], atol=1e-14)


def errors(method, counts):
    """Return the largest error at the saved times, for each number of steps."""
    case, (x0, ts, exact) = c7(N), disturbed()
    runs = (
        dvax.solve(case.problem, x0, 0.0, 1.0, ts=ts, dt=1.0 / k, method=method) for k in counts
    )
    return [max(map(mean, np.asarray(sol.xs) - exact)) for sol in runs]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "order"),
    [pytest.param(dvax.ETD1(), 1.0, marks=pytest.mark.thorough), (dvax.ETD2RK(), 2.0)],
)
def test_order_of_convergence_over_moving_boundaries(method, order):
    counts = (10, 20, 40, 80, 160, 320, 640)
    slope = np.polyfit(np.log2(counts), np.log2(errors(method, counts)), 1)[0]
    assert abs(-slope - order) < 0.15


@pytest.mark.slow
def test_etd4rk_is_more_accurate_than_etd2rk_over_moving_boundaries():
    counts = (10, 40, 160)
    second, fourth = (errors(method, counts) for method in (dvax.ETD2RK(), dvax.ETD4RK()))
    assert all(f < 0.5 * s for f, s in zip(fourth, second, strict=True))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("method", "rtol"),
    [
        pytest.param(dvax.ETD2RK(), 1e-4, marks=pytest.mark.thorough),
        pytest.param(dvax.ETD2RK(), 1e-7, marks=pytest.mark.thorough),
        (dvax.ETD4RK(), 1e-7),
        pytest.param(dvax.ETD4RK(), 1e-10, marks=pytest.mark.thorough),
    ],
)
def test_error_over_moving_boundaries_is_below_twice_the_tolerance(method, rtol):
    case, (x0, ts, exact) = c7(N), disturbed()
    sol = dvax.solve(case.problem, x0, 0.0, 1.0, ts=ts, rtol=rtol, atol=1e-3 * rtol, method=method)
    # What the steps promise is twice the tolerance, relative to |x| ≤ 1.
    assert max(map(mean, np.asarray(sol.xs) - exact)) < 2.0 * rtol


@pytest.mark.slow
def test_free_boundaries_agree_with_the_closed_form():
    case = c7(N)
    ts = np.array([0.0, 0.15, 0.3])
    sol = dvax.solve(case.problem, case.x0, 0.0, 0.3, ts=ts, rtol=1e-7)
    s = (np.arange(N) + 0.5) * np.pi / N
    for t, u in zip(ts, np.asarray(sol.us), strict=True):
        full, none = np.arcsin(4 / 15 * np.exp(t)), np.arcsin(2 / 3 * np.exp(t))
        from_end = np.minimum(s, np.pi - s)
        near = np.abs(from_end - full) < 1e-3, np.abs(from_end - none) < 1e-3
        np.testing.assert_array_equal((u == 0.4)[~near[0]], (from_end < full)[~near[0]])
        np.testing.assert_array_equal((u == 0.0)[~near[1]], (from_end > none)[~near[1]])


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [pytest.param(dvax.ETD1(), marks=pytest.mark.thorough), dvax.ETD2RK()]
)
def test_error_bound_holds_over_moving_boundaries(method):
    case = c7(N)
    ts = np.linspace(0.0, 1.0, 11)
    sol = dvax.solve(
        case.problem, case.x0, 0.0, 1.0, ts=ts, dt=0.01, measure=True, method=method,
        constants=case.constants,
    )  # fmt: skip
    bound = dvax.bound_error(case.problem, sol, case.constants)
    for k, t in enumerate(ts):
        x, u = c7_solution(N, t)
        norm = lambda v: float(jnp.sqrt(jnp.sum(v**2) * np.pi / N))  # noqa: E731
        assert norm(sol.xs[k] - x) <= float(bound.x[k]) * (1 + 1e-9) + 1e-14
        assert norm(sol.us[k] - u) <= float(bound.u[k]) * (1 + 1e-9) + 1e-14
