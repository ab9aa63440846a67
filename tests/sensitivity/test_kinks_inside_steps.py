"""Derivatives over kinks: the state does not show that a kink lies in the first or the last part of a
step, where one stage of the method has the slope of the other side. So a step ends at it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax

H = jnp.array([[1.0, 0.15], [0.15, 0.8]])

SETS = {
    "box": lambda t, c: dvax.sets.Box(jnp.zeros(2), c * jnp.ones(2)),
    "constrained box": lambda t, c: dvax.sets.ConstrainedBox(
        jnp.zeros(2), jnp.full(2, 10.0), jnp.array([[0.9, 0.5]]), jnp.array([-jnp.inf]), c[None]
    ),
    "polyhedron": lambda t, c: dvax.sets.Polyhedron(
        jnp.array([[-1.0, 0.0], [0.0, -1.0], [0.9, 0.5]]), jnp.stack([0.0 * c, 0.0 * c, c])
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rtol"),
    mostly_thorough(
        [(name, rtol) for name in SETS for rtol in (1e-6, 1e-8, 1e-10, 1e-11)],
        always=[("box", 1e-6)],
    ),
)
def test_derivative_in_a_limit_does_not_depend_on_where_kinks_lie_in_a_step(name, rtol):
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-0.1),
        P=dvax.operators.Scaling(1.0),
        K=SETS[name],
        f=lambda t, x, u, c: 0.3 * u,
        h=lambda t, x, u, c: u - (H @ u - (1.5 + jnp.sin(t)) + 0.3 * x),
    )

    def last(c, rtol):
        x0 = jnp.array([0.1, 0.2])
        run = dvax.solve(problem, x0, 0.0, 6.0, c, rtol=rtol, atol=1e-3 * rtol)
        return run.xs[-1, 0] + 2.0 * run.xs[-1, 1]

    # Limits that are reached and left within the run, at other places of the steps for each.
    limits = jnp.concatenate([jnp.linspace(0.9, 1.5, 41), jnp.array([0.96, 1.332])])
    found = jax.jit(jax.vmap(jax.grad(lambda c: last(c, rtol))))(limits)
    values = jax.jit(jax.vmap(lambda c: last(c, 1e-12)))
    step = 1e-5
    differences = (values(limits + step) - values(limits - step)) / (2.0 * step)
    assert np.max(np.abs(found / differences - 1.0)) <= max(30.0 * rtol, 1e-7)
