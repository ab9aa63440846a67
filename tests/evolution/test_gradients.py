"""Derivatives of the solution map against the closed form of C1."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import C1_KINKS, c1, c1_derivatives

import dvax

CASE = c1()


def end(x0, ell, adjoint):
    # Adaptive steps are short where a kink is: a kink inside a step of length h costs the derivative
    # O(h), so that fixed steps would have to be as short everywhere.
    sol = dvax.solve(CASE.problem, x0, 0.0, 2.0, args=(ell,), rtol=1e-8, atol=1e-8, adjoint=adjoint)
    return sol.xs[-1]


def test_reverse_derivatives_of_c1_agree_with_the_closed_form():
    found = jax.grad(end, argnums=(0, 1))(-1.0, 3.0, "reverse")
    for value, exact in zip(found, c1_derivatives(), strict=True):
        assert float(value) == pytest.approx(exact, abs=1e-8)


def test_forward_derivatives_of_c1_agree_with_the_closed_form():
    for k, exact in enumerate(c1_derivatives()):
        tangent = (1.0, 0.0) if k == 0 else (0.0, 1.0)
        _, found = jax.jvp(lambda a, b: end(a, b, "forward"), (-1.0, 3.0), tangent)
        assert float(found) == pytest.approx(exact, abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["reverse", "forward"])
def test_derivative_with_fixed_steps_is_of_first_order_across_kinks(adjoint):
    def last(x0, dt):
        return dvax.solve(CASE.problem, x0, 0.0, 2.0, args=CASE.args, dt=dt, adjoint=adjoint).xs[-1]

    jacobian = jax.jacrev if adjoint == "reverse" else jax.jacfwd
    for dt in (1e-2, 1e-3):
        error = abs(float(jacobian(lambda x, dt=dt: last(x, dt))(-1.0)) - c1_derivatives()[0])
        assert error < 0.05 * dt


@pytest.mark.slow
def test_response_is_differentiable():
    # In contact u = ½ − x, so du/dx0 = −dx/dx0; dx/dx0 there is e^{−1.5 t₁} e^{−(t−t₁)/2}.
    t = 0.45
    assert C1_KINKS[0] < t < C1_KINKS[1]
    exact = np.exp(-1.5 * C1_KINKS[0] - 0.5 * (t - C1_KINKS[0]))

    def both(x0):
        sol = dvax.solve(CASE.problem, x0, 0.0, t, args=CASE.args, rtol=1e-8, atol=1e-8)
        return jnp.stack([sol.xs[-1], sol.us[-1]])

    found = jax.jacrev(both)(-1.0)
    np.testing.assert_allclose(np.asarray(found), [exact, -exact], atol=1e-7)


@pytest.mark.slow
def test_wrong_adjoint_raises_an_error_that_names_the_right_one():
    with pytest.raises(dvax.DifferentiationError, match='adjoint="forward"'):
        jax.jvp(lambda x: end(x, 3.0, "reverse"), (-1.0,), (1.0,))
    with pytest.raises(dvax.DifferentiationError, match='adjoint="reverse"'):
        jax.grad(lambda x: end(x, 3.0, "forward"))(-1.0)
