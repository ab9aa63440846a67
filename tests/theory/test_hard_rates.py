"""Proved bounds hold for functions of time that vary between the ends of a step.

x' = r(t), with a law that stays out of the way: the true solution is ∫ r, by quadrature between the
places where r jumps or bends.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm
from tests.hard_rates import RATES
from tests.selection import mostly_thorough

import dvax

TS = np.array([0.4, 0.75, 1.0])
METHODS = {"ETD1": dvax.ETD1(), "ETD2RK": dvax.ETD2RK()}
ENCLOSED = (
    "a jump in the middle", "a pulse that ends see nothing of", "a dead zone by inequality",
    "a number turned into an integer", "a running count", "a tooth", "a remainder",
)  # fmt: skip
SAMPLED = ("a condition", "rounded to a short type")


def problem(f, h=lambda t, x, u, args: 0.0 * u):
    return dvax.Problem(
        A=dvax.generators.Scalar(0.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=f, h=h,
    )  # fmt: skip


CONSTANTS = dvax.Constants(
    gamma=1.0, L_F=1.0, alpha_h=0.0, beta_h=0.0, alpha_f=0.0, beta_f=0.0, M=1.0, omega=0.0,
    m_P=1.0, norm_P_inv=1.0, status="proved",
)  # fmt: skip


def integral(rate, breaks, t):
    edges = [0.0, *(s for s in breaks if 0.0 < s < t), t]
    one = lambda s: float(rate(jnp.asarray(s)))  # noqa: E731
    return sum(quad(one, a, b, limit=200)[0] for a, b in itertools.pairwise(edges))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "method"),
    mostly_thorough(
        itertools.product(ENCLOSED, METHODS), list(zip(ENCLOSED, itertools.cycle(METHODS)))[::2]
    ),
)
def test_proved_bound_is_above_the_error_for_hard_rates(name, method):
    rate, breaks = RATES[name]
    system = problem(lambda t, x, u, args: rate(t) + 0.0 * u)
    truth = np.array([integral(jax.jit(rate), breaks, t) for t in TS])
    for dt in (1.0, 0.25, 1 / 7):
        sol = dvax.solve(
            system, 0.0, 0.0, 1.0, ts=TS, dt=dt, method=METHODS[method], measure=True, max_steps=16
        )
        bound = dvax.bound_error(system, sol, CONSTANTS)
        error = np.abs(np.asarray(sol.xs) - truth)
        print(
            f"{name}, {method}, dt = {dt:.3f}: error {error.max():.2g}, bound {bound.x.max():.2g}"
        )
        assert bound.status == "proved"
        assert np.all(np.asarray(bound.x) >= error - 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(SAMPLED, SAMPLED[::2]))
def test_bound_without_enclosure_is_estimated(name):
    rate, _ = RATES[name]
    system = problem(lambda t, x, u, args: rate(t) + 0.0 * u)
    sol = dvax.solve(system, 0.0, 0.0, 1.0, dt=0.25, measure=True)
    assert dvax.bound_error(system, sol, CONSTANTS).status == "estimated"


@pytest.mark.slow
def test_adaptive_steps_locate_unannounced_jumps():
    rate, _ = RATES["a jump in the middle"]
    system = problem(lambda t, x, u, args: rate(t) + 0.0 * u)
    sol = dvax.solve(
        system, 0.0, 0.0, 1.0, ts=TS, rtol=1e-4, atol=1e-4, dt0=0.125, method=dvax.ETD2RK()
    )
    bound = dvax.bound_error(system, sol, CONSTANTS)
    error = np.abs(np.asarray(sol.xs) - np.array([0.0, 0.25, 0.5]))
    assert bound.status == "proved" and np.all(np.asarray(bound.x) >= error - 1e-12)
    assert bound.x[-1] < 1e-3


@pytest.mark.slow
def test_bound_of_a_run_without_saved_times_is_empty():
    rate, _ = RATES["a short pulse"]
    system = problem(lambda t, x, u, args: rate(t) + 0.0 * u)
    sol = dvax.solve(
        system,
        0.0,
        0.0,
        1.0,
        ts=TS,
        rtol=1e-9,
        atol=1e-9,
        max_steps=2,
        throw=False,
        method=dvax.ETD2RK(),
    )
    assert sol.result == dvax.RESULTS.max_steps
    assert dvax.bound_error(system, sol, CONSTANTS).x.shape == (0,)


@pytest.mark.slow
def test_bound_integrates_the_norm_of_a_rotating_defect():
    """The norms of the defect add up, while the norm of its mean would be smaller."""
    # The defect swings from one axis to the other while e^{At} turns with it, so that its norms add
    # up: ∫‖δ‖ is 0.81 h, where the norm of the mean is 0.71 h.
    h = 0.25
    A = dvax.generators.Dense((np.pi / 2 / h) * jnp.array([[0.0, -1.0], [1.0, 0.0]]))

    def f(t, x, u, args):
        swing = jnp.stack([2 * h - t, t - h]) / h
        # What floor does is not read off the code as a time, so that the method's step stays whole.
        return jnp.where(jnp.floor(t / h) < 1.0, 0.0, swing) + 0.0 * u

    system = dvax.Problem(
        A=A, P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0), f=f,
        h=lambda t, x, u, args: 0.0 * u,
    )  # fmt: skip
    sol = dvax.solve(system, jnp.zeros(2), 0.0, 2 * h, dt=h, method=dvax.ETD1(), measure=True)
    bound = dvax.bound_error(system, sol, CONSTANTS)
    rotated = lambda s: expm((2 * h - s) * np.asarray(A.matrix)) @ np.array([2 * h - s, s - h]) / h  # noqa: E731
    truth = np.array([quad(lambda s, k=k: rotated(s)[k], h, 2 * h)[0] for k in range(2)])
    error = np.linalg.norm(np.asarray(sol.xs[-1]) - truth)
    assert bound.status == "proved" and error > 0.8 * h
    assert float(bound.x[-1]) >= error


@pytest.mark.slow
def test_enclosure_of_a_root_that_stays_zero_is_finite():
    # Its slope is infinite there, and nothing moves.
    system = problem(lambda t, x, u, args: 1.0 - x + jnp.sqrt(jnp.maximum(t - 5.0, 0.0)) + 0.0 * u)
    fixed = dvax.solve(system, 0.0, 0.0, 1.0, dt=0.1, measure=True)
    bound = dvax.bound_error(system, fixed, CONSTANTS)
    error = abs(float(fixed.xs[-1]) - (1.0 - np.exp(-1.0)))
    assert bound.status == "proved" and error <= float(bound.x[-1]) < 0.1
    adaptive = dvax.solve(system, 0.0, 0.0, 1.0, rtol=1e-6, method=dvax.ETD2RK())
    assert float(adaptive.xs[-1]) == pytest.approx(1.0 - np.exp(-1.0), abs=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("upper", "response"),
    [
        (lambda t: 0.2 - 0.2 * jnp.cos(t), lambda t: 0.2 - 0.2 * np.cos(t)),
        (lambda t: jnp.maximum(0.0, jnp.sin(4.0 * t)), lambda t: np.maximum(0.0, np.sin(4.0 * t))),
    ],
    ids=["opening", "opening and closing"],
)
def test_interval_that_shrinks_to_a_point_is_not_empty(upper, response):
    # u is held at the upper end, so that x = ∫ u.
    system = dvax.Problem(
        A=dvax.generators.Scalar(0.0), P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(0.0, upper(t)), f=lambda t, x, u, args: u + 0.0 * x,
        h=lambda t, x, u, args: 9.0 - u + 0.0 * x,
    )  # fmt: skip
    truth = quad(response, 0.0, 2.0, points=[np.pi / 4, np.pi / 2], limit=200)[0]
    for steps in (dict(dt=0.01, measure=True), dict(rtol=1e-5, atol=1e-7)):
        sol = dvax.solve(system, 0.0, 0.0, 2.0, method=dvax.ETD2RK(), **steps)
        bound = dvax.bound_error(system, sol, CONSTANTS)
        error = abs(float(sol.xs[-1]) - truth)
        assert bound.status == "proved" and error <= float(bound.x[-1]) < 0.1


def test_enclosure_accepts_custom_jvp_functions_of_args():
    system = problem(lambda t, x, u, args: jax.nn.relu(args) - x + 0.0 * u)
    sol = dvax.solve(system, 0.0, 0.0, 1.0, args=jnp.asarray(1.0), dt=0.01, measure=True)
    assert sol.enclosed
    assert float(sol.xs[-1]) == pytest.approx(1.0 - np.exp(-1.0), abs=1e-4)
