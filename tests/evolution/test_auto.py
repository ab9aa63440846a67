"""The method of a plain call: chosen by structure, changed where stability limits the steps."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tests.closed_forms as closed_forms
from scipy.integrate import solve_ivp
from tests.selection import mostly_thorough

import dvax
from dvax.evolution.auto import choose

TOLERANCES = [1e-4, 1e-6, 1e-8, 1e-10]
CASES = [(name, tol) for name in closed_forms.ALL for tol in TOLERANCES]


@pytest.mark.parametrize(("name", "tol"), mostly_thorough(CASES, [("C1", 1e-6), ("C4", 1e-8)]))
def test_plain_call_meets_its_tolerance_in_few_steps(name, tol):
    case = closed_forms.ALL[name]()
    sol = dvax.solve(case.problem, case.x0, 0.0, case.t1, case.args, rtol=tol, atol=tol)
    exact = case.exact(case.t1)[0]
    error = np.sqrt(np.mean((np.asarray(sol.xs[-1]) - exact) ** 2))
    assert error <= tol * (1.0 + np.sqrt(np.mean(exact**2)))
    assert int(sol.stats["steps"]) <= 700


def spring(stiffness, push, power=1):
    """A spring of this stiffness holds x above 1.5, while a force moves it against a drag x^power."""
    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1e6),
        f=lambda t, x, u, args: push(t) - x**power + u,
        h=lambda t, x, u, args: -stiffness * (x - 1.5) - u,
    )  # fmt: skip


STIFFNESSES = [3e3, 1e4, 1e5, 1e6]


@pytest.mark.slow
@pytest.mark.parametrize("power", mostly_thorough([1, 2], [1]))
@pytest.mark.parametrize("stiffness", mostly_thorough(STIFFNESSES, [1e4]))
def test_stiff_law_is_solved_by_a_method_without_a_limit_of_stability(stiffness, power):
    """Constant slopes are read from the code; others show in the run."""
    problem = spring(stiffness, lambda t: 1.0 + jnp.sin(t), power)
    sol = dvax.solve(problem, 4.0, 0.0, 8.0)
    reason = "the constant slope" if power == 1 else "stability limited the steps"
    assert sol.stats["method"].startswith(f"ExpRosenbrock: {reason}")
    assert int(sol.stats["steps"]) < 2000

    def by_hand(t, x):
        return 1.0 + np.sin(t) - x**power + np.maximum(0.5 * stiffness * (1.5 - x), 0.0)

    want = solve_ivp(by_hand, (0.0, 8.0), [4.0], method="Radau", rtol=1e-10, atol=1e-12).y[0, -1]
    assert abs(float(sol.xs[-1]) - want) <= 2e-6 * (1.0 + abs(want))


def test_affine_problem_is_solved_exactly_between_kinks():
    case = closed_forms.c1()
    sol = dvax.solve(case.problem, case.x0, 0.0, case.t1, case.args)
    assert sol.stats["method"].startswith("ExpRosenbrock: ")
    assert int(sol.stats["steps"]) < 40


@pytest.mark.thorough
def test_oscillation_is_not_taken_for_stiffness():
    turning = dvax.Problem(
        A=dvax.generators.Dense(jnp.array([[-0.1, 20.0], [-20.0, -0.1]])),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-0.5, 0.5),
        f=lambda t, x, u, args: jnp.stack([u, jnp.sin(t)]),
        h=lambda t, x, u, args: -3.0 * x[0] ** 3 - u,
        control_space=dvax.spaces.Euclidean(()),
    )  # fmt: skip
    sol = dvax.solve(turning, jnp.array([1.0, 0.0]), 0.0, 5.0)
    assert sol.stats["method"].startswith("DormandPrince: ")


@pytest.mark.slow
def test_known_constants_and_fixed_steps_keep_the_method_whose_defect_is_enclosed():
    case = closed_forms.c1()
    known = dvax.solve(
        case.problem, case.x0, 0.0, 1.0, case.args, rtol=1e-3, constants=case.constants
    )
    assert known.enclosed and known.stats["method"].startswith("ETD2RK: ")
    fixed = dvax.solve(case.problem, case.x0, 0.0, 1.0, case.args, dt=0.1)
    assert fixed.stats["method"] == "ETD2RK: the steps are given"


@pytest.mark.thorough
def test_named_method_is_kept_however_stiff():
    problem = spring(1e4, lambda t: 1.0 + jnp.sin(t))
    sol = dvax.solve(problem, 4.0, 0.0, 1.5, method=dvax.DormandPrince(), rtol=1e-4)
    assert sol.stats["method"] == "DormandPrince" and bool(sol.result == dvax.RESULTS.successful)


@pytest.mark.thorough
def test_result_does_not_depend_on_transformations_which_may_change_the_method():
    problem = spring(3e3, lambda t: 1.0 + jnp.sin(t), power=2)

    def last(x0):
        sol = dvax.solve(problem, x0, 0.0, 4.5)
        return sol.xs[-1], sol.stats["method"]

    # Traced, a run cannot be followed by another: it goes on as it began.
    value, label = jax.jit(last)(4.0)
    assert label.startswith("DormandPrince: ")
    # The derivative limits the steps too: more of them are left, and another method pays off.
    slope, label = jax.grad(last, has_aux=True)(4.0)
    assert label.startswith("ExpRosenbrock: stability limited the steps of DormandPrince")
    np.testing.assert_allclose(value, last(4.0)[0], atol=1e-5)
    # In contact, x has forgotten where it began.
    assert abs(float(slope)) < 1e-6


@pytest.mark.thorough
def test_constant_slopes_are_read_under_transformations():
    problem = spring(3e3, lambda t: 1.0 + jnp.sin(t))

    def last(x0):
        sol = dvax.solve(problem, x0, 0.0, 4.5)
        return sol.xs[-1], sol.stats["method"]

    for call in (last, jax.jit(last), lambda x0: jax.grad(last, has_aux=True)(x0)):
        assert call(4.0)[1].startswith("ExpRosenbrock: the constant slope")


SLOPES = list(itertools.product((-1.0, 3.0), (2.0, -2.0), (-40.0, 70.0), (-1.0, 0.5)))


@pytest.mark.parametrize("slopes", SLOPES)
def test_largest_slope_is_that_of_the_free_or_of_the_held_response(slopes):
    fx, fu, hx, hu = slopes
    problem = dvax.Problem(
        A=dvax.generators.Scalar(0.5), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: fx * x + fu * u + jnp.cos(t),
        h=lambda t, x, u, args: hx * x + hu * u + t,
    )  # fmt: skip
    choice = choose(problem, jnp.asarray(0.1), None, 0.0, 3.0, 1e-6, False, False)
    largest = 3.0 * max(abs(0.5 + fx), abs(0.5 + fx + fu * hx / (1.0 - hu)))
    assert f"the span is {largest:.2g}" in choice.reason


@pytest.mark.parametrize("where", ["K", "f", "h"])
@pytest.mark.parametrize("read", ["closure", "args"])
def test_data_that_begins_at_t0_is_not_read_before(where, read):
    """A table is NaN outside of its hours, and log(t) at 0."""
    hours = np.arange(5.0, 8.0)
    own = {"hours": jnp.asarray(hours), "values": jnp.asarray(1.0 + 0.3 * np.cos(hours))}

    def data(t, args):
        table = own if args is None else args
        return dvax.signals.Table(table["hours"], table["values"])(t) + jnp.log(t - 4.0)

    at = lambda name, t, args: data(t, args) if name == where else 1.0  # noqa: E731
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-0.5), P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(-1.0, at("K", t, args)),
        f=lambda t, x, u, args: u + at("f", t, args),
        h=lambda t, x, u, args: 2.0 * at("h", t, args) - 0.5 * u - x,
    )  # fmt: skip
    args = own if read == "args" else None
    choice = choose(problem, jnp.asarray(0.3), args, 5.0, 2.0, 1e-6, False, False)
    assert choice.text().startswith("DormandPrince")


@pytest.mark.thorough
def test_function_that_closes_over_a_traced_number_is_followed_to_the_end():
    def last(pull):
        problem = spring(3e3, lambda t: pull + jnp.sin(t))
        return dvax.solve(problem, 4.0, 0.0, 4.5).xs[-1]

    rest = lambda pull: (pull + np.sin(4.5) + 1.5e3 * 1.5) / (1.0 + 1.5e3)  # noqa: E731
    np.testing.assert_allclose(jax.jit(last)(1.0), rest(1.0), atol=1e-3)


def field(n, generator=None):
    """n points with x' = Ax + c − 1.5 x − clip(g − 2x, 0, ½), each with its own c and g."""
    s = jnp.linspace(0.0, 1.0, n)
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0) if generator is None else generator,
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: 3.0 + s + 0.3 * jnp.sin(5.0 * t) - 0.5 * x - u,
        h=lambda t, x, u, args: 0.5 + 0.2 * jnp.sin(6.0 * s) - x,
    )  # fmt: skip


FIELDS = list(itertools.product((65, 100, 256, 257, 2000), TOLERANCES))


@pytest.mark.thorough
@pytest.mark.parametrize(("n", "tol"), mostly_thorough(FIELDS, [(100, 1e-8), (257, 1e-4)]))
def test_field_meets_its_tolerance_in_few_steps(n, tol):
    problem = field(n)
    sol = dvax.solve(problem, -jnp.ones(n), 0.0, 2.0, rtol=tol, atol=tol)
    assert sol.stats["method"].startswith("DormandPrince: f̃ acts entry by entry")
    s = np.linspace(0.0, 1.0, n)

    def by_hand(t, x):
        u = np.clip(0.5 + 0.2 * np.sin(6.0 * s) - x, 0.0, 0.5)
        return 3.0 + s + 0.3 * np.sin(5.0 * t) - 1.5 * x - u

    exact = solve_ivp(by_hand, (0.0, 2.0), -np.ones(n), "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    error = np.sqrt(np.mean((np.asarray(sol.xs[-1]) - exact) ** 2))
    assert error <= 2.0 * tol * (1.0 + np.sqrt(np.mean(exact**2)))
    # Each point has two kinks; steps of order 2 become 1.5e3, 3e3, 1.5e4 and 1.5e5.
    assert int(sol.stats["steps"]) <= 0.3 * tol**-0.5 + 4 * min(n, 300) + 100


@pytest.mark.thorough
def test_field_is_left_to_its_exponential_by_a_method_that_suits_the_tolerance():
    n = 80
    heat = field(n, dvax.generators.Elliptic(n, 1.0, boundary="dirichlet"))
    solved = lambda tol: dvax.solve(heat, jnp.zeros(n), 0.0, 0.3, rtol=tol, atol=tol)  # noqa: E731
    loose, tight = solved(1e-4), solved(1e-7)
    assert loose.stats["method"].startswith("ETD2RK: A discretises an operator")
    assert tight.stats["method"].startswith("ETD4RK: A discretises an operator")
    np.testing.assert_allclose(loose.xs, tight.xs, atol=1e-4)
    # Under `jax.jit` the tolerance is traced.
    traced = jax.jit(lambda tol: dvax.solve(heat, jnp.zeros(n), 0.0, 0.3, rtol=tol, atol=tol).xs)
    np.testing.assert_allclose(traced(1e-7), tight.xs, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("A", "name"),
    [
        (dvax.generators.Scalar(-1.0), "ETD4RK: f̃ couples 80 states"),
        pytest.param(
            dvax.generators.Dense(-np.eye(80)),
            "DormandPrince: f̃ couples 80 states",
            marks=pytest.mark.thorough,
        ),
        pytest.param(
            dvax.generators.Elliptic(80, 1.0, boundary="neumann"),
            "ETD4RK: A discretises an operator",
            marks=pytest.mark.thorough,
        ),
    ],
    ids=["number", "matrix", "operator"],
)
def test_field_with_a_coupled_law_has_order_four(A, name):
    n = 80
    problem = dvax.Problem(
        A=A, P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: jnp.cos(t) - u,
        h=lambda t, x, u, args: x - 0.1 * (jnp.roll(u, 1) + jnp.roll(u, -1)),
    )  # fmt: skip
    solved = lambda **kw: dvax.solve(problem, jnp.linspace(0.0, 1.0, n), 0.0, 0.5, **kw)  # noqa: E731
    sol, second = solved(rtol=1e-5, atol=1e-6), solved(rtol=1e-5, atol=1e-6, method=dvax.ETD2RK())
    assert sol.stats["method"].startswith(name)
    # Kinks at any time cost steps of order 4 too, but fewer.
    assert int(sol.stats["evaluations"]) < int(second.stats["evaluations"])
    np.testing.assert_allclose(sol.xs, second.xs, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("A", "name"),
    [
        pytest.param(dvax.generators.Scalar(-1.0), "DormandPrince", marks=pytest.mark.thorough),
        (dvax.generators.Elliptic(4, 1.0, boundary="neumann", diffusion=0.1), "ETD4RK"),
    ],
    ids=["number", "operator"],
)
def test_method_is_chosen_for_a_traced_end_of_the_run(A, name):
    problem = dvax.Problem(
        A=A, P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: args + 0.1 * x * (1.0 - x) - u,
        h=lambda t, x, u, args: 4.0 * (x - 0.25),
    )  # fmt: skip
    chosen = []

    def end(t1):
        sol = dvax.solve(problem, jnp.full(4, 0.1), 0.0, t1, 1.0)
        chosen.append(str(sol.stats["method"]))
        return sol.xs[-1]

    np.testing.assert_allclose(jax.jit(end)(2.0), end(2.0), rtol=1e-6)
    assert all(text.startswith(name) for text in chosen)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gain", "rtol", "name"),
    mostly_thorough(
        [
            (0.2, 1e-3, "ETD2RK"),
            (40.0, 1e-3, "ETD4RK"),
            (2.0, 1e-3, "ETD2RK"),
            (2.0, 1e-5, "ETD4RK"),
        ],
        [(40.0, 1e-3, "ETD4RK"), (2.0, 1e-3, "ETD2RK")],
    ),
)
def test_steep_laws_take_steps_of_order_four_at_loose_tolerances(gain, rtol, name):
    problem = dvax.Problem(
        A=dvax.generators.Elliptic(8, 1.0, boundary="neumann", diffusion=0.01),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.2),
        f=lambda t, x, u, args: jnp.exp(-t) + 0.1 * x * (1.0 - x) - u,
        h=lambda t, x, u, args: args * (x - 0.25),
    )  # fmt: skip
    sol = dvax.solve(problem, jnp.zeros(8), 0.0, 2.0, gain, rtol=rtol)
    assert str(sol.stats["method"]).startswith(name)


@pytest.mark.slow
def test_matrix_of_a_vibrating_chain_is_judged_by_its_frequencies():
    n = 6
    stiffness = 400.0 * (2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, -0.3 * np.eye(n)]])
    problem = dvax.Problem(
        A=dvax.generators.Dense(A), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, args: jnp.concatenate([jnp.zeros(n), jnp.sin(t) - u * jnp.cos(x[:n])]),
        h=lambda t, x, u, args: 50.0 * x[n:], control_space=dvax.spaces.Euclidean(n),
    )  # fmt: skip
    # Frequencies up to 40, and a norm of 1,600.
    sol = dvax.solve(problem, jnp.zeros(2 * n), 0.0, 2.0)
    assert str(sol.stats["method"]).startswith("DormandPrince")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "span", "name"),
    mostly_thorough(
        [(20, 1.0, "DormandPrince"), (80, 0.05, "DormandPrince"), (80, 2.0, "ETD4RK")],
        [(20, 1.0, "DormandPrince"), (80, 2.0, "ETD4RK")],
    ),
)
def test_matrix_is_left_to_its_exponential_only_where_that_costs_less_than_stable_steps(
    n, span, name
):
    # Heat as a matrix: 600, 400 and 16,000 explicit steps. An exponential is formed for each step size.
    h = 1.0 / (n + 1)
    heat = (np.eye(n, k=1) + np.eye(n, k=-1) - 2.0 * np.eye(n)) / h**2
    problem = dvax.Problem(
        A=dvax.generators.Dense(heat), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 2.0),
        f=lambda t, x, u, args: jnp.sin(5.0 * t) + u - x**3, h=lambda t, x, u, args: 5.0 * (0.5 - x),
    )  # fmt: skip
    x0 = jnp.asarray(np.sin(np.pi * h * np.arange(1, n + 1)))
    sol = dvax.solve(problem, x0, 0.0, span, rtol=1e-5, atol=1e-5)
    assert sol.stats["method"].startswith(name)

    def by_hand(t, x):
        return heat @ x + np.sin(5.0 * t) + np.clip(5.0 * (0.5 - x), 0.0, 2.0) - x**3

    exact = solve_ivp(by_hand, (0.0, span), x0, "Radau", rtol=1e-9, atol=1e-10).y[:, -1]
    assert np.sqrt(np.mean((np.asarray(sol.xs[-1]) - exact) ** 2)) < 3e-5
