"""`Implicit`: Diffrax's accuracy on closed forms, and errors for unsupported options."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import c1, c1_derivatives, c1_solution

import dvax
from dvax import generators, signals

PLAIN = dvax.operators.Scaling(1.0)


@pytest.mark.slow
def test_implicit_solves_the_contact_law_across_kinks():
    case, ts = c1(), np.linspace(0.0, 2.0, 9)
    sol = dvax.solve(
        case.problem, case.x0, 0.0, 2.0, args=case.args, ts=ts, rtol=1e-8, method=dvax.Implicit(),
        constants=case.constants,
    )  # fmt: skip
    for t, x, u in zip(ts, sol.xs, sol.us, strict=True):
        np.testing.assert_allclose((float(x), float(u)), c1_solution(t), atol=1e-6)
    assert sol.result == dvax.RESULTS.successful and sol.defect is None
    assert float(np.max(sol.law_error)) < 1e-9


def stiff(n):
    """A chain with a fast reaction that couples neighbours, relaxing to a known field."""
    target = jnp.linspace(0.2, 0.8, n)
    laplacian = 100.0 * (jnp.eye(n, k=1) + jnp.eye(n, k=-1) - 2.0 * jnp.eye(n))
    return target, dvax.Problem(
        A=generators.Dense(laplacian), P=PLAIN, K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: 1e6 * (u - x) - laplacian @ target,
        h=lambda t, x, u, args: 2.0 * target - u,
    )  # fmt: skip


@pytest.mark.thorough
def test_implicit_solves_a_stiff_system():
    target, problem = stiff(300)
    sol = dvax.solve(problem, jnp.zeros(300), 0.0, 1.0, method=dvax.Implicit(diffrax.Kvaerno3()))
    np.testing.assert_allclose(np.asarray(sol.xs[0]), np.asarray(target), atol=1e-6)
    assert int(sol.stats["steps"]) < 400


@pytest.mark.slow
def test_implicit_accepts_the_law_as_explicit_part():
    # The tests turn off the optimisation with which Diffrax's own root finder rejects every step here.
    case = c1()
    sol = dvax.solve(
        case.problem, case.x0, 0.0, 2.0, args=case.args, rtol=1e-7,
        method=dvax.Implicit(diffrax.KenCarp4()),
    )  # fmt: skip
    assert int(sol.stats["steps"]) < 200
    assert float(sol.xs[0]) == pytest.approx(c1_solution(2.0)[0], abs=1e-5)


@pytest.mark.thorough
def test_implicit_has_derivatives_in_both_modes():
    # A step over a kink, where Diffrax makes it short and no more, has a derivative of its own.
    case = c1()

    def end(x0, ell, adjoint):
        return dvax.solve(
            case.problem, x0, 0.0, 2.0, args=(ell,), rtol=1e-9, method=dvax.Implicit(),
            adjoint=adjoint, max_steps=4096,
        ).xs[-1]  # fmt: skip

    given = jnp.asarray(-1.0), jnp.asarray(3.0)
    back = jax.grad(lambda v: end(*v, "reverse"))(given)
    there = jax.jacfwd(lambda v: end(*v, "forward"))(given)
    np.testing.assert_allclose([float(v) for v in back], c1_derivatives(), rtol=2e-3)
    np.testing.assert_allclose([float(v) for v in there], [float(v) for v in back], rtol=2e-3)


def pushed(times, values):
    table = signals.Table(times, values, kind="constant")
    return dvax.Problem(
        A=generators.Zero(), P=PLAIN, K=dvax.sets.WholeSpace(), f=lambda t, x, u, args: table(t),
        h=lambda t, x, u, args: -u,
    )  # fmt: skip


@pytest.mark.slow
def test_implicit_steps_end_at_jumps_of_data():
    problem = pushed([0.0, 0.37, 1.0], [1.0, -3.0, 0.0])
    sol = dvax.solve(problem, 0.0, 0.0, 1.0, method=dvax.Implicit(diffrax.Kvaerno3()))
    assert float(sol.xs[0]) == pytest.approx(0.37 - 3.0 * 0.63, abs=1e-12)
    assert int(sol.stats["rejected"]) == 0


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (dict(dense=True), "no polynomials of their steps"),
        (dict(measure=True), "no polynomials of their steps"),
        (dict(dt=0.1), "by rtol and atol"),
    ],
)
def test_implicit_rejects_unsupported_options(asked, words):
    case = c1()
    with pytest.raises(dvax.InputError, match=words):
        dvax.solve(case.problem, case.x0, 0.0, 2.0, args=case.args, method=dvax.Implicit(), **asked)
    with pytest.raises(dvax.InputError, match="must be an implicit solver"):
        dvax.Implicit(diffrax.Tsit5())


@pytest.mark.thorough
def test_implicit_failures_have_messages():
    case = c1()
    run = lambda **how: dvax.solve(  # noqa: E731
        case.problem, case.x0, 0.0, 2.0, args=case.args, method=dvax.Implicit(), throw=False, **how
    )
    assert run(max_steps=3, rtol=1e-9).result == dvax.RESULTS.max_steps
    broken = dvax.Problem(
        A=generators.Zero(), P=PLAIN, K=dvax.sets.WholeSpace(),
        f=lambda t, x, u, args: jnp.where(t > 0.5, jnp.nan, 1.0), h=lambda t, x, u, args: -u,
    )  # fmt: skip
    with pytest.raises(dvax.SolveError) as failure:
        dvax.solve(broken, 0.0, 0.0, 1.0, ts=[0.25, 0.75], method=dvax.Implicit(), max_steps=2000)
    assert "Stopped at t = 0.25" in str(failure.value) and "f is nan" in str(failure.value)
    assert failure.value.solution.result == dvax.RESULTS.implicit_unsolved
    partial = failure.value.solution
    np.testing.assert_allclose(np.asarray(partial.ts), [0.25])
    np.testing.assert_allclose(np.asarray(partial.xs), [0.25], atol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("solver", [diffrax.Kvaerno5(), diffrax.KenCarp4()])
def test_knots_outside_of_the_run_change_nothing(solver):
    # x' = −x + u + 0.1 (t > b), u = x + 0.3 throughout; no b lies inside of the run.
    problem = dvax.Problem(
        A=generators.Scalar(-1.0), P=PLAIN, K=dvax.sets.Box(-9.0, 9.0),
        f=lambda t, x, u, b: u + jnp.where(t > b, 0.1, 0.0), h=lambda t, x, u, b: x + 0.3,
    )  # fmt: skip

    def end(t1, b):
        sol = dvax.solve(problem, 0.4, 0.0, t1, b, rtol=1e-6, method=dvax.Implicit(solver))
        assert int(sol.stats["rejected"]) <= 20
        return sol.xs[-1]

    for b, slope in ((2.0001, 0.3), (9.0, 0.3), (1e9, 0.3), (-1e-3, 0.4), (-9.0, 0.4)):
        found = jax.value_and_grad(end)(2.0, b)
        np.testing.assert_allclose(found, [0.4 + 2.0 * slope, slope], atol=1e-6)


def test_derivatives_in_the_ends_of_a_run_over_kinks_are_those_of_the_flow():
    # The solution x(t₁; t₀, x₀) has ∂x/∂t₁ = x'(t₁) and ∂x/∂t₀ = −∂x/∂x₀ x'(t₀), at any tolerance.
    def rate(t, x):
        return 1.0 - x + jnp.sin(3.0 * t) * jnp.clip(-8.0 * (x - 1.2 * jnp.sin(3.0 * t)), 0.0, 9.0)

    problem = dvax.Problem(
        A=generators.Zero(), P=PLAIN, K=dvax.sets.Box(0.0, 9.0),
        f=lambda t, x, u, args: 1.0 - x + jnp.sin(3.0 * t) * u,
        h=lambda t, x, u, args: -16.0 * (x - 1.2 * jnp.sin(3.0 * t)) - u,
    )  # fmt: skip

    def end(x0, t0, t1):
        return dvax.solve(problem, x0, t0, t1, rtol=1e-4, method=dvax.Implicit()).xs[-1]

    for at in ((0.4, 0.1, 2.3), (0.4, 0.1, 1.7), (0.9, 0.6, 2.3)):
        x1, (by_x0, by_t0, by_t1) = jax.value_and_grad(end, (0, 1, 2))(*at)
        np.testing.assert_allclose(by_t1, rate(at[2], x1), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(by_t0, -by_x0 * rate(at[1], at[0]), rtol=1e-6, atol=1e-9)
