"""C1 to C4 of `tests.closed_forms`, solved to the requested accuracy."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tests.closed_forms import ALL, C1_KINKS, c1_derivatives, c1_solution
from tests.selection import mostly_thorough

import dvax


@pytest.mark.parametrize("name", mostly_thorough(ALL, ["C4"]))
def test_adaptive_solve_of_closed_forms_reaches_nine_digits(name):
    case = ALL[name]()
    sol = dvax.solve(
        case.problem, jnp.asarray(case.x0), 0.0, case.t1, args=case.args, rtol=1e-10, atol=1e-10
    )
    x, u = case.exact(case.t1)
    error = np.max(np.abs(np.asarray(sol.xs[-1]) - x))
    print(f"{name}: error {error:.1e}, {sol.stats['steps']} steps")
    assert sol.result == dvax.RESULTS.successful
    assert error <= 1e-9
    assert np.max(np.abs(np.asarray(sol.us[-1]) - u)) <= 1e-8


METHODS = {m.__name__: m() for m in (dvax.ETD4RK, dvax.DormandPrince, dvax.ExpRosenbrock)}
PAIRS = [(name, method) for name in ALL for method in METHODS]


@pytest.mark.parametrize(
    ("name", "method"),
    mostly_thorough(PAIRS, [("C1", "DormandPrince")]),
)
def test_error_of_closed_forms_is_below_ten_tolerances(name, method):
    case, ts = ALL[name](), np.linspace(0.0, ALL[name]().t1, 9)
    exact = np.array([case.exact(t)[0] for t in ts])
    for rtol in (1e-4, 1e-7, 1e-10):
        sol = dvax.solve(
            case.problem, jnp.asarray(case.x0), 0.0, case.t1, args=case.args, ts=ts, rtol=rtol,
            atol=1e-3 * rtol, method=METHODS[method],
        )  # fmt: skip
        error = np.abs(np.asarray(sol.xs) - exact) / np.maximum(np.abs(exact).max(), 1e-3)
        print(f"{name}, {method}, {rtol:g}: error {error.max():.1e}, {sol.stats['steps']} steps")
        assert error.max() <= 10 * rtol


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(ALL, ["C3"]))
def test_saved_states_of_closed_forms_are_accurate_and_responses_certified(name):
    case = ALL[name]()
    ts = np.linspace(0.0, case.t1, 33)
    sol = dvax.solve(
        case.problem, jnp.asarray(case.x0), 0.0, case.t1, args=case.args, ts=ts, rtol=1e-7,
        atol=1e-7, constants=case.constants,
    )  # fmt: skip
    exact_x = np.array([case.exact(t)[0] for t in ts])
    exact_u = np.array([case.exact(t)[1] for t in ts])
    np.testing.assert_allclose(np.asarray(sol.xs), exact_x, atol=1e-6)
    # The response moves with x by at most L: its own error is bounded by the law's certificate.
    np.testing.assert_allclose(np.asarray(sol.us), exact_u, atol=3e-6)
    assert np.all(np.asarray(sol.law_error) <= 1e-9)
    P = case.problem.operator()
    for u, y in zip(sol.us, sol.ys, strict=True):
        np.testing.assert_allclose(np.asarray(P.apply(u)), np.asarray(y), atol=1e-13)


def test_closed_forms_agree_with_a_general_ode_solver():
    # The oracles are checked too: DOP853 on the reduced equations, with the law written by hand.
    clip = lambda v, a, b: min(max(v, a), b)  # noqa: E731
    runs = {
        "C1": lambda t, x: 3.0 - 1.5 * x - clip((1 - 2 * x[0]) / 2, 0.0, 0.5),
        "C4": lambda t, x: -x + 0.5 - 0.2 * clip(x[0], 0.0, 1.5 * np.pi),
    }
    for name, rhs in runs.items():
        case = ALL[name]()
        out = solve_ivp(
            rhs, (0, case.t1), [float(case.x0)], method="DOP853", rtol=1e-12, atol=1e-12,
            max_step=1e-3,
        )  # fmt: skip
        assert out.y[0, -1] == pytest.approx(float(case.exact(case.t1)[0]), abs=1e-9)

    def ball(t, x):
        length, r = np.hypot(*x), 0.5 * np.exp(-t / 2)
        u = x * min(1.0, r / length)
        return np.array([-0.5 * x[0] - 3 * x[1], 3 * x[0] - 0.5 * x[1]]) - u

    out = solve_ivp(
        ball, (0, 4), [2.0, 0.0], method="DOP853", rtol=1e-12, atol=1e-12, max_step=0.01
    )
    np.testing.assert_allclose(out.y[:, -1], ALL["C3"]().exact(4.0)[0], atol=1e-9)

    def corner(t, x):
        u = np.linalg.solve([[2, 0.5], [0.5, 1]], [1 + 0.5 * np.sin(t), -1 + 0.25 * np.cos(2 * t)])
        return np.array([[-1, 2], [-2, -1]]) @ x + [1, 0] - np.array([1, 0.5]) * u

    out = solve_ivp(corner, (0, 4), [0.3, -0.2], method="DOP853", rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(out.y[:, -1], ALL["C2"]().exact(4.0)[0], atol=1e-10)


def test_c1_has_the_published_figures():
    assert C1_KINKS == pytest.approx((0.31333575283049, 0.52405678414614), abs=1e-13)
    assert c1_solution(2.0)[0] == pytest.approx(1.8360919559905713, abs=1e-14)
    assert c1_derivatives()[0] == pytest.approx(0.06146551650353571, abs=1e-14)
    assert c1_derivatives()[1] == pytest.approx(0.6402592596, abs=1e-10)
