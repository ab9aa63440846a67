"""Derivatives do not depend on the space in which errors are measured, in both modes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax

W = jnp.array([0.2, 0.5, 0.3])
SPACES = {
    "L2": dvax.spaces.L2(W),
    "L2 and Euclidean": dvax.spaces.Product(dvax.spaces.L2(W), dvax.spaces.Euclidean(2)),
}
METHODS = {"ETD2RK": dvax.ETD2RK(), "DormandPrince": dvax.DormandPrince(), "the default": None}
CASES = [(s, m, a) for s in SPACES for m in METHODS for a in ("forward", "reverse")]
ALWAYS = [("L2 and Euclidean", "the default", "reverse")]


@pytest.mark.slow
@pytest.mark.parametrize(("space", "method", "adjoint"), mostly_thorough(CASES, ALWAYS))
def test_derivative_of_an_adaptive_run_is_that_of_the_closed_form(space, method, adjoint):
    """x' = −x + u with 2u = ax, so that x(1) = e^{a/2 − 1} x₀; a second part is 0."""
    whole = space != "L2"
    like = (jnp.zeros(3), jnp.zeros(2)) if whole else jnp.zeros(3)
    A = dvax.generators.Scalar(-1.0)
    problem = dvax.Problem(
        A=dvax.generators.Product(A, A) if whole else A, P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-9.0, 9.0),
        f=(lambda t, x, u, a: (u, 0.0 * x[1])) if whole else (lambda t, x, u, a: u),
        h=lambda t, x, u, a: a * (x[0] if whole else x) - u,
        state_space=SPACES[space], control_space=dvax.spaces.L2(W),
    )  # fmt: skip
    start = jnp.array([0.3, -0.7, 1.1])

    def end(start, a):
        x0 = (start, like[1]) if whole else start
        sol = dvax.solve(
            problem, x0, 0.0, 1.0, a, method=METHODS[method], rtol=1e-8, atol=1e-8, adjoint=adjoint
        )
        return jnp.sum(jnp.array([1.0, 2.0, 3.0]) * (sol.xs[0] if whole else sol.xs)[-1])

    derivative = jax.jacfwd if adjoint == "forward" else jax.grad
    by_start, by_a = jax.jit(derivative(end, argnums=(0, 1)))(start, jnp.asarray(0.8))
    grown = np.exp(0.4 - 1.0)
    np.testing.assert_allclose(by_start, grown * np.array([1.0, 2.0, 3.0]), rtol=1e-6)
    assert float(by_a) == pytest.approx(0.5 * grown * (0.3 - 1.4 + 3.3), rel=1e-6)
