"""`DormandPrince`: orders on the whole right-hand side, across kinks, and of the dense output."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import RK45, solve_ivp
from tests.closed_forms import C1_KINKS, c1, c1_derivatives, c1_solution, c3
from tests.evolution.test_order import slope

import dvax
from dvax import generators

METHOD = dvax.DormandPrince()
PLAIN = dvax.operators.Scaling(1.0)


def pendulum(A):
    """The problem x' = Ax + f, with a law whose bounds are never active."""
    return dvax.Problem(
        A=A, P=PLAIN, K=dvax.sets.WholeSpace(),
        f=lambda t, x, u, args: jnp.stack([jnp.cos(t), u[0]]) - 0.2 * x * x,
        h=lambda t, x, u, args: -jnp.sin(x[:1]) + 0.0 * u,
        control_space=dvax.spaces.Euclidean(1),
    )  # fmt: skip


def test_dormand_prince_step_and_dense_output_equal_those_of_scipy_rk45():
    # SciPy's method of the same name, written by others from the same paper; Shampine's dense output.
    matrix = np.array([[-0.3, 1.2], [-0.9, 0.1]])
    x0, h = np.array([0.4, -0.7]), 0.4

    def rate(t, x):
        return matrix @ x + np.array([np.cos(t), -np.sin(x[0])]) - 0.2 * x * x

    peer = RK45(rate, 0.0, x0, 1.0, first_step=h, rtol=1.0, atol=1.0)
    peer.step()
    sol = dvax.solve(
        pendulum(generators.Dense(jnp.asarray(matrix))), x0, 0.0, h, dt=h, method=METHOD, dense=True
    )
    assert int(sol.stats["steps"]) == 1
    np.testing.assert_allclose(np.asarray(sol.xs[-1]), peer.y, rtol=0, atol=1e-14)
    for theta in (0.1, 0.5, 0.9):
        x, _ = sol.evaluate(theta * h)
        np.testing.assert_allclose(
            np.asarray(x), peer.dense_output()(theta * h), rtol=0, atol=1e-14
        )


@pytest.mark.slow
def test_dormand_prince_orders_of_steps_dense_output_and_defect():
    case = c3()
    counts = np.array([20, 40, 80, 160])
    ends, between, defects = [], [], []
    for n in counts:
        sol = dvax.solve(
            case.problem, jnp.asarray(case.x0), 0.0, 2.0, dt=2.0 / n, method=METHOD, dense=True,
            measure=True, ts=np.linspace(0.0, 2.0, 6), max_steps=200,
        )  # fmt: skip
        ends.append(max(np.max(np.abs(x - case.exact(t)[0])) for t, x in zip(sol.ts, sol.xs)))
        inner = (np.arange(8, n, n // 10) + 0.37) * 2.0 / n
        found = [np.asarray(sol.evaluate(t)[0]) - case.exact(t)[0] for t in inner]
        between.append(np.max(np.abs(found)))
        defects.append(float(sol.defect[-1]))
    orders = [slope(counts, np.array(errors)) for errors in (ends, between, defects)]
    print(f"C3: orders {orders}; {ends}, {between}, {defects}")
    # On coarse steps the errors fall faster still.
    assert 4.85 <= orders[0] <= 5.6
    assert 4.85 <= orders[1] <= 5.6
    assert orders[2] == pytest.approx(4.0, abs=0.15)


def test_dormand_prince_order_on_a_smooth_system_agrees_with_scipy():
    matrix = np.array([[-0.3, 1.2], [-0.9, 0.1]])
    x0 = np.array([0.4, -0.7])
    exact = solve_ivp(
        lambda t, x: matrix @ x + np.array([np.cos(t), -np.sin(x[0])]) - 0.2 * x * x,
        (0.0, 1.0), x0, method="DOP853", rtol=1e-13, atol=1e-14,
    ).y[:, -1]  # fmt: skip
    problem = pendulum(generators.Dense(jnp.asarray(matrix)))
    counts = np.array([10, 20, 40, 80])
    errors = [
        np.max(np.abs(np.asarray(
            dvax.solve(problem, x0, 0.0, 1.0, dt=1.0 / n, method=METHOD).xs[-1]) - exact))
        for n in counts
    ]  # fmt: skip
    found = slope(counts, np.array(errors))
    print(f"observed order {found:.3f}, errors {errors}")
    assert found == pytest.approx(5.0, abs=0.15)


@pytest.mark.slow
def test_dormand_prince_keeps_order_five_across_unannounced_kinks():
    case = c1()
    steps, errors = [], []
    for rtol in (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9):
        sol = dvax.solve(
            case.problem, jnp.asarray(case.x0), 0.0, 2.0, args=case.args, rtol=rtol, atol=rtol,
            ts=np.linspace(0.0, 2.0, 41), method=METHOD,
        )  # fmt: skip
        errors.append(max(abs(float(x) - c1_solution(t)[0]) for t, x in zip(sol.ts, sol.xs)))
        steps.append(int(sol.stats["steps"]))
        # Three attempts that are refused, at most, for either kink; and the first steps.
        assert int(sol.stats["rejected"]) <= 3 * len(C1_KINKS) + 5
        assert errors[-1] <= rtol
    found = slope(np.array(steps[-3:]), np.array(errors[-3:]))
    print(f"C1, adaptive: order {found:.2f}, steps {steps}, errors {errors}")
    assert found > 4.5


@pytest.mark.slow
def test_dormand_prince_regimes_are_those_of_the_closed_form():
    case = c1()
    sol = dvax.solve(
        case.problem, jnp.asarray(case.x0), 0.0, 2.0, args=case.args, rtol=1e-9, method=METHOD,
        dense=True, max_steps=1000,
    )  # fmt: skip
    times, positive = sol.regimes()
    np.testing.assert_allclose(times, [0.0, *C1_KINKS, 2.0], atol=1e-8)
    assert positive.tolist() == [[True, False], [True, True], [False, True]]


@pytest.mark.thorough
def test_dormand_prince_derivatives_are_those_of_the_closed_form():
    case = c1()

    def end(x0, args, adjoint):
        return dvax.solve(
            case.problem, x0, 0.0, 2.0, args=args, rtol=1e-9, method=METHOD, adjoint=adjoint
        ).xs[-1]

    x0, exact = jnp.asarray(case.x0), c1_derivatives()
    for mode, adjoint in ((jax.grad, "reverse"), (jax.jacfwd, "forward")):
        found = mode(lambda x: end(x, case.args, adjoint))(x0)  # noqa: B023
        assert float(found) == pytest.approx(exact[0], rel=1e-6)


@pytest.mark.slow
def test_dormand_prince_is_accurate_on_a_stiff_system():
    """A stiff system needs more steps, and is as accurate."""
    problem = dvax.Problem(
        A=generators.Diagonal(jnp.array([-2e3, -1.0])), P=PLAIN, K=dvax.sets.Box(-0.5, 0.5),
        f=lambda t, x, u, args: u[::-1], h=lambda t, x, u, args: jnp.sin(3.0 * t) - x - u,
    )  # fmt: skip
    x0 = jnp.array([1.0, -1.0])
    sol = dvax.solve(problem, x0, 0.0, 2.0, rtol=1e-6, method=METHOD)
    peer = dvax.solve(problem, x0, 0.0, 2.0, rtol=1e-9, method=dvax.ETD4RK())
    np.testing.assert_allclose(np.asarray(sol.xs[-1]), np.asarray(peer.xs[-1]), atol=1e-6)
    # Its steps cannot be longer than 3.3 / 2000, up to what is refused.
    assert 2.0 * 2e3 / 3.4 <= int(sol.stats["steps"]) <= 3.0 * 2.0 * 2e3 / 3.3


@pytest.mark.thorough
def test_dormand_prince_solves_an_iterated_law_with_a_tuple_state():
    turn = jnp.array([[0.0, 1.0], [-1.0, 0.0]])
    coupled = dvax.Problem(
        A=generators.Product(generators.Scalar(-1.0), generators.Dense(turn)), P=PLAIN,
        K=dvax.sets.Ball(0.0, 1.0),
        f=lambda t, x, u, args: (u[0] + 0.1 * x[1][0], u - 0.2 * x[1]),
        h=lambda t, x, u, args: jnp.stack([jnp.cos(t), x[0]]) - jnp.tanh(u) - 0.3 * u[::-1],
        control_space=dvax.spaces.Euclidean(2),
    )  # fmt: skip
    x0 = (jnp.asarray(0.5), jnp.array([1.0, 0.0]))
    run = lambda rtol, method: dvax.solve(coupled, x0, 0.0, 1.0, rtol=rtol, method=method)  # noqa: E731
    found, peer = run(1e-7, METHOD), run(1e-8, dvax.ETD4RK())
    for mine, theirs in zip(found.xs, peer.xs, strict=True):
        np.testing.assert_allclose(np.asarray(mine), np.asarray(theirs), atol=2e-7)
