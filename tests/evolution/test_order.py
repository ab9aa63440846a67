"""Orders of convergence: ETD1 is 1, ETD2RK is 2, where f̃ is smooth inside every step."""

import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import C1_KINKS, c1, c1_solution, c3

import dvax

METHODS = [(dvax.ETD1(), 1.0), (dvax.ETD2RK(), 2.0)]


def slope(counts, errors):
    return -np.polyfit(np.log(counts), np.log(errors), 1)[0]


@pytest.mark.parametrize(("method", "order"), METHODS, ids=["ETD1", "ETD2RK"])
def test_order_on_the_shrinking_ball_while_the_state_is_outside_it(method, order):
    # C3 up to t = 2 < t*: smooth, with a moving curved set, a skew part in A, and a nonlinear f̃.
    case = c3()
    counts = (64, 128, 256, 512)
    errors = []
    for n in counts:
        sol = dvax.solve(case.problem, jnp.asarray(case.x0), 0.0, 2.0, dt=2.0 / n, method=method)
        assert int(sol.stats["steps"]) == n
        errors.append(np.max(np.abs(np.asarray(sol.xs[-1]) - case.exact(2.0)[0])))
    found = slope(counts, errors)
    print(f"C3: observed order {found:.3f}, errors {errors}")
    assert found == pytest.approx(order, abs=0.05)


@pytest.mark.parametrize(("method", "order"), METHODS, ids=["ETD1", "ETD2RK"])
def test_order_on_the_contact_law_with_its_kinks_on_the_grid(method, order):
    # C1 is solved piece by piece from kink to kink, so that no step contains one. The worst of the
    # ends counts: at t = 2 alone the errors of the pieces happen to cancel.
    case = c1()
    counts = (128, 256, 512, 1024)
    errors = []
    for n in counts:
        x, worst = jnp.asarray(case.x0), 0.0
        for start, end in zip((0.0, *C1_KINKS), (*C1_KINKS, 2.0), strict=True):
            dt = (end - start) / n
            sol = dvax.solve(case.problem, x, start, end, args=case.args, dt=dt, method=method)
            x = sol.xs[-1]
            worst = max(worst, abs(float(x) - c1_solution(end)[0]))
        errors.append(worst)
    found = slope(counts, errors)
    print(f"C1: observed order {found:.3f}, errors {errors}")
    assert found == pytest.approx(order, abs=0.05)


def test_a_law_that_is_polynomial_in_time_is_integrated_exactly():
    # f̃ constant: ETD1 is exact; f̃ a line in t: ETD2RK is, in one step, however stiff A is.
    def problem(f):
        return dvax.Problem(
            A=dvax.generators.Diagonal(jnp.array([-1e4, -0.3])),
            P=dvax.operators.Scaling(1.0),
            K=dvax.sets.WholeSpace(),
            f=lambda t, x, u, args: f(t) * jnp.ones(2),
            h=lambda t, x, u, args: jnp.zeros(2),
        )

    a, x0, T = np.array([-1e4, -0.3]), np.array([1.0, -2.0]), 1.5
    flow = np.exp(a * T) * x0
    constant = flow + 3.0 * np.expm1(a * T) / a
    ramp = flow + (np.expm1(a * T) - a * T) / a**2
    for method, f, exact in (
        (dvax.ETD1(), lambda t: 3.0, constant),
        (dvax.ETD2RK(), lambda t: t, ramp),
    ):
        sol = dvax.solve(problem(f), jnp.asarray(x0), 0.0, T, dt=T, method=method)
        assert int(sol.stats["steps"]) == 1
        np.testing.assert_allclose(np.asarray(sol.xs[-1]), exact, rtol=1e-12)
