"""Laws of many coupled unknowns with F′ = aP⁻¹: the active sets are those of the optimality
conditions, and few products with P find them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax

N = 1200


def smoothing(kind, rng):
    """An operator P with the eigenvalues of a coupled surface, 1 to N/2, and its control space."""
    k = np.maximum(np.arange(N // 2 + 1), 1.0)
    if kind == "convolution":
        return dvax.operators.Convolution(jnp.asarray(k), N), dvax.spaces.L2(jnp.full(N, 0.3))
    weights = rng.uniform(0.2, 3.0, N)
    symmetric = np.fft.irfft(k[:, None] * np.fft.rfft(np.eye(N), axis=0), N, axis=0)
    # WP is symmetric, so that P is self-adjoint in the weighted space.
    matrix = symmetric / np.sqrt(weights)[:, None] * np.sqrt(weights)
    return dvax.operators.Dense(jnp.asarray(matrix)), dvax.spaces.L2(jnp.asarray(weights))


@pytest.mark.parametrize("kind", ["convolution", pytest.param("dense", marks=pytest.mark.thorough)])
@pytest.mark.parametrize("cap", [np.inf, 4.0])
def test_law_of_a_coupled_field_satisfies_its_optimality_conditions(kind, cap):
    rng = np.random.default_rng(3)
    P, space = smoothing(kind, rng)
    waves = np.cumsum(rng.normal(size=N))
    drive = waves - np.linspace(0.0, waves[-1], N) + 1.0
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=P, K=dvax.sets.Box(0.0, cap), f=lambda t, x, u, args: 0.0 * x,
        h=lambda t, x, u, args: x - 0.5 * u, control_space=space,
    )  # fmt: skip
    law = jax.jit(lambda x: problem.law(0.0, x, tol=1e-9))
    answer = law(jnp.asarray(drive))
    y = np.asarray(answer.y)
    F = 1.5 * np.asarray(P.inverse(answer.y)) - drive
    held, capped = y == 0.0, y == cap
    assert held.mean() > 0.1 and (np.isinf(cap) or capped.mean() > 0.05)
    assert (y >= 0).all() and (y <= cap).all()
    assert np.abs(F[~held & ~capped]).max() < 1e-8
    assert F[held].min() > -1e-8 and F[capped].max(initial=-1.0) < 1e-8
    assert int(answer.evaluations) < 40
