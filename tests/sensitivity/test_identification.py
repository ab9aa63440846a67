"""Applications of derivatives: a fit of four contact parameters with standard errors, and linearisation
against sampling."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import dvax

NAMES = ("b_u", "kappa0", "d_x", "ell")
TRUTH = jnp.array([0.8, 0.5, 0.6, 2.6])
TIMES = np.linspace(0.0, 10.0, 101)[1:]
NOISE = 0.01

problem = dvax.Problem(
    A=dvax.generators.Scalar(-1.0),
    P=dvax.operators.Scaling(1.0),
    K=lambda t, p: dvax.sets.Box(0.0, p[1]),
    f=lambda t, x, u, p: p[3] * (1.0 + 0.8 * jnp.sin(1.3 * t)) - p[2] * x - u,
    h=lambda t, x, u, p: 2.2 - 1.2 * x - p[0] * u,
)
"""Opens, closes and saturates some ten times in the record."""


def observed(p):
    """x and u at 100 times: 200 numbers."""
    sol = dvax.solve(
        problem, 0.2, 0.0, 10.0, p, TIMES, dt=0.02, method=dvax.ETD4RK(), adjoint="forward"
    )
    return jnp.concatenate([sol.xs, sol.us])


@jax.jit
def fitted(data):
    """(parameters, standard errors) by least squares."""
    solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    found = optimistix.least_squares(
        lambda p, _: observed(p) - data, solver, jnp.array([1.0, 0.6, 0.5, 2.4]), throw=False
    ).value
    J, rest = jax.jacfwd(observed)(found), observed(found) - data
    variance = jnp.sum(rest**2) / (data.size - found.size)
    return found, jnp.sqrt(variance * jnp.diag(jnp.linalg.inv(J.T @ J)))


@pytest.mark.thorough
def test_fit_of_four_contact_parameters_to_a_noisy_record():
    noise = NOISE * np.random.default_rng(0).normal(size=(1, 200))
    found, error = fitted(observed(TRUTH) + noise[0])
    for name, value, spread, true in zip(NAMES, found, error, TRUTH, strict=True):
        print(f"{name}: {float(value):.4f} ± {float(spread):.4f} ({float(true)})")
        assert abs(float(value - true)) <= 3 * float(spread)
        assert 0.0 < float(spread) < 0.1


@pytest.mark.thorough
def test_standard_errors_agree_with_the_spread_of_repeated_fits():
    exact = np.asarray(observed(TRUTH))
    rng = np.random.default_rng(1)
    data = [exact + NOISE * rng.normal(size=200) for _ in range(100)]
    fitted(data[0])[0].block_until_ready()
    started = time.perf_counter()
    results = [jax.device_get(fitted(d)) for d in data]
    print(f"a fit takes {(time.perf_counter() - started) / 100:.3f} s")
    off = np.array([(p - TRUTH) / e for p, e in results])
    within = np.sum(np.all(np.abs(off) <= 3.0, axis=1))
    print(f"{within} of 100 within three standard errors; spread of the ratio {off.std(axis=0)}")
    assert within >= 95
    # Errors twice as large as they should be would pass the first as well.
    assert np.all((off.std(axis=0) > 0.7) & (off.std(axis=0) < 1.4))


@pytest.mark.thorough
def test_linearised_uncertainty_agrees_with_samples_for_small_spread():
    """The spread of x and u at every time from that of the parameters, by J Σ Jᵀ and by 2 000
    samples."""
    spread = jnp.array([0.02, 0.005, 0.02, 0.03])
    J = jax.jit(jax.jacfwd(observed))(TRUTH)
    linear = np.sqrt(np.sum((np.asarray(J) * np.asarray(spread)) ** 2, axis=1))
    rng = np.random.default_rng(2)
    samples = jnp.asarray(np.asarray(TRUTH) + np.asarray(spread) * rng.normal(size=(2000, 4)))
    sampled = np.asarray(jax.jit(jax.vmap(observed))(samples)).std(axis=0)
    print(f"x: {np.quantile(linear[:100] / sampled[:100], (0, 0.5, 1)).round(2)}")
    # Of u as well, but where it sits at zero, and where kinks pass within the spread.
    moves = sampled[100:] > 1e-3
    of_u = linear[100:][moves] / sampled[100:][moves]
    print(f"u: {np.quantile(of_u, (0, 0.5, 1)).round(2)}")
    assert abs(np.median(of_u) - 1.0) < 0.1
    assert np.all(np.abs(linear[:100] / sampled[:100] - 1.0) < 0.15)
