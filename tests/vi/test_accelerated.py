"""Nesterov's accelerated projected gradient method, where F is a gradient."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import dvax
from dvax.sets import Ball, Box
from dvax.vi import RESULTS, Accelerated


@pytest.mark.slow
def test_accelerated_minimises_an_ill_conditioned_quadratic_on_simplices():
    # Made from its answer: y* with the multipliers of three simplices, κ = 10⁴.
    rng = np.random.default_rng(6)
    basis = np.linalg.qr(rng.normal(size=(60, 60)))[0]
    matrix = basis * np.geomspace(1.0, 1e4, 60) @ basis.T
    used = rng.uniform(size=60) < 0.5
    y = np.where(used, rng.exponential(size=60), 0.0)
    levels = np.repeat(rng.normal(size=3), 20)
    drive = jnp.asarray(matrix @ y - levels - np.where(used, 0.0, rng.exponential(size=60)))
    K = dvax.sets.Simplex(jnp.asarray(y.reshape(3, 20).sum(axis=1)), sizes=(20, 20, 20))
    M = jnp.asarray(matrix)
    for least in (0.0, 1e-2):
        vi = dvax.solve_vi(
            lambda y, args: M @ y - drive, K, jnp.zeros(60), tol=1e-7, gamma=1.0,
            solver=Accelerated(least=least),
        )  # fmt: skip
        assert vi.result == RESULTS.successful
        assert float(np.linalg.norm(vi.y - y)) <= float(vi.error_bound) <= max(1e-7, least)
        # √κ ln(1/ε) = 1600, where the method without momentum takes κ ln(1/ε) = 160 000.
        assert 100 < int(vi.iterations) < 2000
    assert float(vi.error_bound) > 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("K", [Box(-0.1, 0.2), Ball(0.0, 0.5)], ids=["box", "ball"])
def test_accelerated_minimises_a_convex_function(K):
    # ψ(y) = Σ log(1 + e^(Gy − b)) + ½|y|²: γ = 1, by L-BFGS-B or SLSQP.
    rng = np.random.default_rng(3)
    G, b = 3.0 * rng.normal(size=(40, 12)), rng.normal(size=40)

    def psi(y):
        return np.logaddexp(0.0, G @ y - b).sum() + 0.5 * y @ y

    def slope(y):
        return G.T @ (1.0 / (1.0 + np.exp(b - G @ y))) + y

    matrix, drive = jnp.asarray(G), jnp.asarray(b)
    vi = dvax.solve_vi(
        lambda y, args: matrix.T @ (1.0 / (1.0 + jnp.exp(drive - matrix @ y))) + y,
        K, jnp.zeros(12), tol=1e-9, gamma=1.0, solver=Accelerated(),
    )  # fmt: skip
    assert vi.result == RESULTS.successful
    if isinstance(K, Box):
        least = scipy.optimize.minimize(
            psi, np.zeros(12), jac=slope, bounds=[(-0.1, 0.2)] * 12, tol=1e-15
        )
    else:
        held = {"type": "ineq", "fun": lambda y: 0.25 - y @ y, "jac": lambda y: -2 * y}
        least = scipy.optimize.minimize(
            psi, np.zeros(12), jac=slope, constraints=held, method="SLSQP", tol=1e-15
        )
    y = np.asarray(vi.y)
    # ψ(v) ≥ ψ(y) + ½|v − y|² − ‖w‖|v − y| on K, whatever v a peer has found there.
    assert psi(y) <= psi(least.x) + 1e-12
    np.testing.assert_allclose(y, least.x, atol=1e-5)


@pytest.mark.parametrize(
    ("F", "K", "result"),
    [
        (lambda y: y * jnp.nan, Ball(0.0, 1.0), RESULTS.nonfinite),
        (lambda y: -y - 1.0, Box(0.0, jnp.inf), RESULTS.diverging),
        (lambda y: jnp.where(y < 0.5, -10.0, 1.0) + 0.0 * y, Ball(0.0, 1.0), None),
    ],
    ids=["NaN", "no solution", "a jump"],
)  # fmt: skip
def test_accelerated_failure_is_not_reported_as_success(F, K, result):
    vi = dvax.solve_vi(lambda y, args: F(y), K, jnp.full(2, 0.5), solver=Accelerated())
    assert vi.result != RESULTS.successful
    assert result is None or vi.result == result
    assert not float(vi.residual) < 0.5


def test_accelerated_certificate_holds_if_f_is_not_a_gradient():
    # A strong rotation with γ = 1: nothing is known of the method, all is known of its bound.
    matrix = jnp.array([[1.0, 20.0], [-20.0, 1.0]])
    F = lambda y, args: matrix @ y - 1.0  # noqa: E731
    K = Box(-5.0, 5.0)
    vi = dvax.solve_vi(F, K, jnp.zeros(2), gamma=1.0, solver=Accelerated(max_steps=500))
    y = np.linalg.solve(np.asarray(matrix), np.ones(2))
    assert float(np.linalg.norm(vi.y - y)) <= float(vi.error_bound) + 1e-14
