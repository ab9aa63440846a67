"""Derivatives in amplitudes that are zero: nothing of the wave is in the state, and no step that the
state asks for resolves it. Oracle: the linearised equation, solved by SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tests.selection import mostly_thorough

import dvax

METHODS = {
    "None": None,
    "DormandPrince": dvax.DormandPrince(),
    "ETD4RK": dvax.ETD4RK(),
    "ETD2RK": dvax.ETD2RK(),
    "ExpRosenbrock": dvax.ExpRosenbrock(),
}

RATES = [1.0, 5.0, 20.0, 60.0, 200.0]
END = 6.0


def waves(t, rates, a):
    """Σ aₖ sin(ωₖ t + k)."""
    return jnp.sum(a * jnp.sin(rates * t + jnp.arange(len(a), dtype=float)))


PENDULUM = dvax.Problem(
    A=dvax.generators.Zero(),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(-10.0, 10.0),
    control_space=dvax.spaces.Euclidean(()),
    f=lambda t, x, u, args: jnp.stack([x[1], -jnp.sin(x[0]) + u]),
    h=lambda t, x, u, args: waves(t, args["rates"], args["a"]) - 0.3 * x[1] - 0.5 * u,
)
"""u = (wave − 0.3 x₁)/1.5 inside of K."""


def exact(rates, x0):
    """The derivative of x(END) in each amplitude at zero."""

    def rate(t, z):
        x, v = z[:2], z[2:].reshape(2, -1)
        wave = np.sin(np.asarray(rates) * t + np.arange(len(rates))) / 1.5
        dv = np.stack([v[1], -np.cos(x[0]) * v[0] - 0.2 * v[1] + wave])
        return np.concatenate([[x[1], -np.sin(x[0]) - 0.2 * x[1]], dv.ravel()])

    start = np.concatenate([x0, np.zeros(2 * len(rates))])
    return solve_ivp(rate, (0.0, END), start, rtol=1e-11, atol=1e-13).y[2:, -1].reshape(2, -1)


CASES = [(m, r, x) for m in METHODS for r in RATES for x in ([0.0, 0.0], [1.0, 0.0])]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rate", "x0"),
    mostly_thorough(
        CASES,
        [
            ("None", 20.0, [1.0, 0.0]),
            ("DormandPrince", 200.0, [0.0, 0.0]),
            ("ETD4RK", 60.0, [1.0, 0.0]),
            ("ExpRosenbrock", 20.0, [0.0, 0.0]),
        ],
    ),
)
def test_the_derivative_in_an_amplitude_of_zero_resolves_the_wave(name, rate, x0):
    rates = np.array([rate, 0.37 * rate])

    def end(a):
        args = {"a": a, "rates": jnp.asarray(rates)}
        return dvax.solve(PENDULUM, jnp.asarray(x0), 0.0, END, args, method=METHODS[name]).xs[-1]

    found, expected = jax.jacrev(end)(jnp.zeros(2)), exact(rates, x0)
    # The size of v is that of the forcing divided by its frequency.
    scale = np.abs(expected) + 1.0 / np.minimum(rates, 100.0)
    assert np.max(np.abs(found - expected) / scale) <= 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 12])
def test_a_wave_around_the_law_and_many_parameters_are_resolved_in_both_modes(count):
    """Amplitudes in a closure and in args: parameters beyond seven share a direction."""
    rates = np.linspace(3.0, 40.0, count)

    def end(a, adjoint="reverse"):
        parts = {f"a{k:02d}": a[k] for k in range(count)}
        problem = dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Simplex(1.0),
            f=lambda t, x, u, args: (
                u - x + sum(p * jnp.sin(r * t) for p, r in zip(args.values(), rates))
            ),
            h=lambda t, x, u, args: a[0] * jnp.cos(rates[-1] * t) + jnp.array([1.2, 0.9]) - u,
        )  # fmt: skip
        start = jnp.array([0.325, 0.175])
        return dvax.solve(problem, start, 0.0, END, parts, adjoint=adjoint).xs[-1]

    # x' = −2x + u + Σ aₖ sin ωₖt, where u moves along (1, 1) by nothing: the sum of u is one.
    def alone(r):
        return (np.exp(-2 * END) * r + 2 * np.sin(r * END) - r * np.cos(r * END)) / (4 + r * r)

    expected = np.array([alone(r) for r in rates])
    found = jax.jacrev(end)(jnp.zeros(count))
    np.testing.assert_allclose(found, np.stack([expected, expected]), atol=2e-5)
    if count == 1:
        forward = jax.jacfwd(lambda a: end(a, "forward"))(jnp.zeros(1))
        np.testing.assert_allclose(forward, np.stack([expected, expected]), atol=2e-5)
