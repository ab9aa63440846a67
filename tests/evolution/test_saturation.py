"""While u is saturated, an embedded error estimate is zero; the step-size control must not rely on it.

Three systems whose u is constant for long and then leaves its bound briefly. An estimate that is
blind there has an error that does not shrink with the tolerance at all.
"""

import itertools
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from tests.selection import mostly_thorough

import dvax

TOLERANCES = [1e-4, 1e-6, 1e-8]


def forced(h, lower, upper):
    """x' = −x + u with u = clip(h(t)): a linear filter of a saturated signal."""
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(lower, upper),
        f=lambda t, x, u, args: u,
        h=lambda t, x, u, args: h(t) + 0.0 * x,
    )


def filtered(h, lower, upper, kinks, T, x0):
    """x(T) of `forced` by quadrature between the known kinks."""
    pieces = np.unique(np.clip([0.0, *kinks, T], 0.0, T))
    integrand = lambda s: np.exp(s - T) * np.clip(h(s), lower, upper)  # noqa: E731
    parts = [
        quad(integrand, a, b, epsabs=1e-13, epsrel=1e-12, limit=200)[0] for a, b in pairwise(pieces)
    ]
    return np.exp(-T) * x0 + sum(parts)


def crossings(h, level, T):
    """The times at which a smooth h crosses a level, to rounding."""
    from scipy.optimize import brentq

    grid = np.linspace(0, T, 20_001)
    values = h(grid) - level
    at = np.flatnonzero(np.sign(values[:-1]) != np.sign(values[1:]))
    return [brentq(lambda s: h(s) - level, grid[i], grid[i + 1], xtol=1e-15) for i in at]


def swings():
    """±1 nearly always, with fast transitions: 10 sin 7t."""
    h, T = lambda t: 10 * np.sin(7 * t), 4.0
    exact = filtered(h, -1.0, 1.0, crossings(h, 1.0, T) + crossings(h, -1.0, T), T, 0.3)
    return forced(lambda t: 10 * jnp.sin(7 * t), -1.0, 1.0), 0.3, T, np.array(exact)


def pulses():
    """0 for most of each period, and a full pulse at its maximum."""
    h, T = lambda t: 300 * (np.sin(t) - 0.97), 9.0
    exact = filtered(h, 0.0, 1.0, crossings(h, 1.0, T) + crossings(h, 0.0, T), T, 0.0)
    return forced(lambda t: 300 * (jnp.sin(t) - 0.97), 0.0, 1.0), 0.0, T, np.array(exact)


def bumper():
    """An oscillator that touches a stiff bumper at its maximum: u depends on the state."""
    A = np.array([[-0.02, 1.0], [-1.0, -0.02]])
    problem = dvax.Problem(
        A=dvax.generators.Dense(A),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: jnp.stack([jnp.zeros_like(u), -u]),
        h=lambda t, x, u, args: 40.0 * (x[0] - 0.97),
        state_space=dvax.spaces.Euclidean(2),
        control_space=dvax.spaces.Euclidean(),
    )

    def rhs(t, x):
        return A @ x - np.array([0.0, np.clip(40.0 * (x[0] - 0.97), 0.0, 0.5)])

    out = solve_ivp(
        rhs, (0, 8.0), [1.05, 0.0], method="DOP853", rtol=1e-12, atol=1e-12, max_step=2e-3
    )
    return problem, np.array([1.05, 0.0]), 8.0, out.y[:, -1]


SYSTEMS = {"swings": swings, "pulses": pulses, "bumper": bumper}
METHODS = {m.__name__: m() for m in (dvax.ETD2RK, dvax.ETD4RK, dvax.DormandPrince)}
RUNS = list(itertools.product(SYSTEMS, METHODS))
OFTEN = [("bumper", "ETD2RK"), ("pulses", "DormandPrince")]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method"), mostly_thorough(RUNS, OFTEN))
def test_error_follows_the_tolerance_through_saturation(name, method):
    problem, x0, T, exact = SYSTEMS[name]()
    for tol in TOLERANCES if method == "ETD2RK" else (*TOLERANCES, 1e-10):
        sol = dvax.solve(problem, x0, 0.0, T, rtol=tol, atol=tol, method=METHODS[method])
        error = np.max(np.abs(np.asarray(sol.xs[-1]) - exact))
        print(f"{name}, {method}: tol {tol:.0e}, error {error:.1e}, {sol.stats['steps']} steps")
        assert error <= 10 * tol


@pytest.mark.parametrize("dt", [None, 0.3])
def test_jumps_of_data_at_knots_are_integrated_exactly(dt):
    # x' = −x + load, the load a staircase: x is a sum of exponentials, and no step is too long.
    times = np.array([0.0, 0.31, 0.32, 1.7, 2.9, 4.0])
    values = np.array([1.0, -50.0, 2.0, 0.0, 7.0, 7.0])
    load = dvax.signals.Table(times, values, "constant")
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.WholeSpace(),
        f=lambda t, x, u, args: load(t) + u,
        h=lambda t, x, u, args: 0.0 * x,
    )
    x = 0.5
    for a, b, v in zip(times[:-1], times[1:], values[:-1], strict=True):
        x = v + (x - v) * np.exp(a - b)
    sol = dvax.solve(problem, 0.5, 0.0, 4.0, dt=dt, rtol=1e-6, atol=1e-6, method=dvax.ETD2RK())
    assert float(sol.xs[-1]) == pytest.approx(x, abs=1e-13)
    assert int(sol.stats["steps"]) < 100
