"""Derivatives in the shape of K: bounds of the box of C2, radius and centre of the ball of C3."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tests.closed_forms import P2, c2, c3
from tests.selection import mostly_thorough

import dvax

SETTINGS = dict(method=dvax.ETD4RK(), rtol=1e-8, atol=1e-10, max_steps=2**14)


@pytest.mark.thorough
def test_derivative_in_the_bounds_of_c2_solves_a_linear_equation():
    """y rides a corner, so that z = x₁ + ix₂ has z' = (−1 − 2i)z − (P⁻¹ of what the bound moves by)."""
    case = c2()
    t1, rate = 2.0, -1.0 - 2.0j

    def end(shift):
        box = lambda t, s: dvax.sets.Box(  # noqa: E731
            jnp.stack([jnp.full_like(t, -5.0), -1 + 0.25 * jnp.cos(2 * t) + s[1]]),
            jnp.stack([1 + 0.5 * jnp.sin(t) + s[0], jnp.full_like(t, 5.0)]),
        )
        problem = dvax.Problem(
            A=case.problem.A, P=case.problem.P, K=box, f=case.problem.f, h=case.problem.h
        )
        return dvax.solve(problem, jnp.asarray(case.x0), 0.0, t1, shift, **SETTINGS).xs[-1]

    found = np.asarray(jax.jit(jax.jacrev(end))(jnp.zeros(2)))
    push = -np.diag([1.0, 0.5]) @ np.linalg.inv(P2)
    for k in range(2):
        z = (push[0, k] + 1j * push[1, k]) * (np.exp(rate * t1) - 1.0) / rate
        np.testing.assert_allclose(found[:, k], [z.real, z.imag], rtol=1e-6)


def ball(center, radius, t1):
    """C3 with another ball, by scipy; the clip is written by hand."""

    def rate(t, x):
        away, R = x - center, radius * np.exp(-t / 2)
        size = np.linalg.norm(away)
        u = x if size <= R else center + R * away / size
        return np.array([[-0.5, -3.0], [3.0, -0.5]]) @ x - u

    run = solve_ivp(rate, (0.0, t1), [2.0, 0.0], "DOP853", rtol=1e-12, atol=1e-13, max_step=0.02)
    return run.y[:, -1]


@pytest.mark.slow
@pytest.mark.parametrize("t1", mostly_thorough([2.0, 4.0], {4.0}))
def test_derivative_in_radius_and_centre_of_c3_is_the_closed_form(t1):
    """|x| = (2 − rt)e^{−t/2} until it meets the ball at 2/r − 1, and from there r e^{…}: at t = 4,
    d|x|/dr = (1/r − 2/r²)|x|, so that the kink moves as well."""
    case = c3()

    def end(p):
        problem = dvax.Problem(
            A=case.problem.A, P=case.problem.P,
            K=lambda t, p: dvax.sets.Ball(p["c"], p["r"] * jnp.exp(-t / 2)),
            f=case.problem.f, h=case.problem.h,
        )  # fmt: skip
        return dvax.solve(problem, jnp.asarray(case.x0), 0.0, t1, p, **SETTINGS).xs[-1]

    found = jax.jit(jax.jacrev(end))({"c": jnp.zeros(2), "r": jnp.asarray(0.5)})
    direction = np.array([np.cos(3 * t1), np.sin(3 * t1)])
    by_radius = -t1 * np.exp(-t1 / 2) if t1 < 3 else -6.0 * 0.5 * np.exp(-3.0)
    np.testing.assert_allclose(np.asarray(found["r"]), by_radius * direction, rtol=1e-6)
    for k in range(2):
        step = 1e-4 * np.eye(2)[k]
        exact = (ball(step, 0.5, t1) - ball(-step, 0.5, t1)) / 2e-4
        np.testing.assert_allclose(np.asarray(found["c"])[:, k], exact, rtol=1e-5, atol=1e-6)
