"""Orders of convergence: ETD1 is 1, ETD2RK 2, ETD4RK 4, where f̃ is smooth inside every step."""

import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import C1_KINKS, c1, c1_solution, c3

import dvax

METHODS = [(dvax.ETD1(), 1.0, 64), (dvax.ETD2RK(), 2.0, 64), (dvax.ETD4RK(), 4.0, 16)]
each_method = pytest.mark.parametrize(
    ("method", "order", "fewest"), METHODS, ids=["ETD1", "ETD2RK", "ETD4RK"]
)


def slope(counts, errors):
    return -np.polyfit(np.log(counts), np.log(errors), 1)[0]


@pytest.mark.thorough
@each_method
def test_order_on_the_shrinking_ball(method, order, fewest):
    """The order is nominal while the state is outside the ball."""
    # C3 up to t = 2 < t*: smooth, with a moving curved set, a skew part in A, and a nonlinear f̃.
    case = c3()
    counts = fewest * np.array([1, 2, 4, 8])
    errors = []
    for n in counts:
        sol = dvax.solve(case.problem, jnp.asarray(case.x0), 0.0, 2.0, dt=2.0 / n, method=method)
        assert int(sol.stats["steps"]) == n
        errors.append(np.max(np.abs(np.asarray(sol.xs[-1]) - case.exact(2.0)[0])))
    found = slope(counts, errors)
    print(f"C3: observed order {found:.3f}, errors {errors}")
    assert found == pytest.approx(order, abs=0.05)


@each_method
def test_order_on_the_contact_law_with_its_kinks_on_the_grid(method, order, fewest):
    # C1 is solved piece by piece from kink to kink, so that no step contains one. The worst of the
    # ends counts: at t = 2 alone the errors of the pieces happen to cancel.
    case = c1()
    counts = (2 * fewest if order < 3 else fewest // 4) * np.array([1, 2, 4, 8])
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


@pytest.mark.slow
def test_polynomial_forcing_is_integrated_exactly():
    # f̃ constant: ETD1 is exact; a line in t: ETD2RK is; a parabola: ETD4RK is, in one step, however
    # stiff A is.
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
    parabola = flow + 2 * (np.expm1(a * T) - a * T - (a * T) ** 2 / 2) / a**3
    for method, f, exact in (
        (dvax.ETD1(), lambda t: 3.0, constant),
        (dvax.ETD2RK(), lambda t: t, ramp),
        (dvax.ETD4RK(), lambda t: t**2, parabola),
    ):
        sol = dvax.solve(problem(f), jnp.asarray(x0), 0.0, T, dt=T, method=method)
        assert int(sol.stats["steps"]) == 1
        np.testing.assert_allclose(np.asarray(sol.xs[-1]), exact, rtol=1e-12)


@pytest.mark.slow
def test_order_on_a_field_with_free_boundaries():
    """The order is 2, and the method of order 4 is more accurate."""
    # Heat with a saturated contact law at each point; the free boundaries move through the grid.
    n = 127
    s = (np.arange(n) + 0.5) * np.pi / n
    wave = lambda t: jnp.exp(-t) * jnp.sin(s)  # noqa: E731
    problem = dvax.Problem(
        A=dvax.generators.Elliptic(n, np.pi), P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 0.4), h=lambda t, x, u, args: 1.0 - 1.5 * x - 0.5 * u,
        f=lambda t, x, u, args: 0.2 * wave(t) + jnp.clip((1.0 - 1.5 * wave(t)) / 1.5, 0.0, 0.4)
        - 0.2 * x - u,
    )  # fmt: skip
    # From x* itself x stays x* = e^{−t} sin s, for which f̃ vanishes; so the run starts beside it.
    x0 = wave(0.0) + 0.3 * np.sin(2 * s)

    def end(method, steps):
        return np.asarray(dvax.solve(problem, x0, 0.0, 1.0, dt=1 / steps, method=method).xs[-1])

    counts = np.array([20, 40, 80, 160, 320])
    exact = end(dvax.ETD4RK(), 5120)
    second, fourth = (
        np.array([np.sqrt(np.mean((end(method, k) - exact) ** 2)) for k in counts])
        for method in (dvax.ETD2RK(), dvax.ETD4RK())
    )
    found = slope(counts, second)
    print(f"a field with free boundaries: observed order {found:.3f}, errors {second}, {fourth}")
    assert found == pytest.approx(2.0, abs=0.15)
    assert np.all(fourth < 0.3 * second)
