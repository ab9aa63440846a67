"""An exponential method written outside the library works as those inside do: the exercise of
CONTRIBUTING.md."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.evolution.method import TWO_SAMPLES, combined


class ETD3RK(dvax.evolution.AbstractMethod):
    """Cox and Matthews' third order method (2002, eq. 23 to 25)."""

    order: ClassVar[int] = 3
    degree: ClassVar[int] = 2
    samples: ClassVar[tuple[float, ...]] = TWO_SAMPLES
    safety: ClassVar[float] = 1.0
    has_half_stage: ClassVar[bool] = True

    def coefficients(self, evaluate, propagate, first, drift):
        middle = evaluate(0.5, propagate(0.5, (first,)))
        last = evaluate(1.0, propagate(1.0, (combined((-1.0, first), (2.0, middle)),)))
        slope = combined((-3.0, first), (4.0, middle), (-1.0, last))
        return first, slope, combined((2.0, first), (-4.0, middle), (2.0, last))


PROBLEM = dvax.Problem(
    A=dvax.generators.Dense(jnp.array([[-1.0, 2.0], [-2.0, -1.0]])),
    P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-9.0, 9.0),
    f=lambda t, x, u, args: u + jnp.sin(x[::-1]),
    h=lambda t, x, u, args: jnp.cos(t) - 0.3 * x - u,
)  # fmt: skip
X0 = jnp.array([1.0, -0.5])


@pytest.mark.slow
def test_new_exponential_method_has_its_order_with_fixed_steps():
    exact = dvax.solve(PROBLEM, X0, 0.0, 2.0, rtol=1e-12, atol=1e-12, method=dvax.ETD4RK()).xs[-1]
    errors = [
        float(
            jnp.max(
                jnp.abs(dvax.solve(PROBLEM, X0, 0.0, 2.0, dt=dt, method=ETD3RK()).xs[-1] - exact)
            )
        )
        for dt in (0.05, 0.025)
    ]
    assert np.log2(errors[0] / errors[1]) > 2.7


@pytest.mark.slow
def test_new_exponential_method_meets_the_tolerance_with_adaptive_steps():
    exact = dvax.solve(PROBLEM, X0, 0.0, 2.0, rtol=1e-12, atol=1e-12, method=dvax.ETD4RK()).xs[-1]
    sol = dvax.solve(PROBLEM, X0, 0.0, 2.0, rtol=1e-7, atol=1e-7, method=ETD3RK())
    assert float(jnp.max(jnp.abs(sol.xs[-1] - exact))) <= 2e-7
    assert sol.stats["method"] == "ETD3RK"
