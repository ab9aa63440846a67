"""The responses of a solution: computed when they are read, wherever that is."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from tests.once import once

import dvax
from dvax.evolution.responses import Responses

TS = [0.5, 1.0, 2.0]


@once
def cubic():
    """u + u³ = args − 2x where that is positive, else 0: a law that is solved by iteration."""
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(2.0), K=dvax.sets.Box(0.0, 9.0),
        f=lambda t, x, u, args: 1.0 - u, h=lambda t, x, u, args: args - 2.0 * x - u**3,
    )  # fmt: skip


def solve(x0, number=1.0):
    return dvax.solve(cubic(), x0, 0.0, 2.0, jnp.asarray(number), TS)


def law(x, number=1.0):
    """The response by another way: the real root of Cardano's formula."""
    right = np.maximum(number - 2.0 * np.asarray(x), 0.0)
    root = np.sqrt(right**2 / 4 + 1 / 27)
    return np.cbrt(right / 2 + root) + np.cbrt(right / 2 - root)


@pytest.mark.slow
def test_responses_solve_the_law_at_the_saved_states_and_are_computed_once():
    sol = solve(-1.0)
    np.testing.assert_allclose(sol.us, law(sol.xs), atol=1e-8)
    np.testing.assert_allclose(sol.ys, 2.0 * sol.us, rtol=1e-15)
    assert float(jnp.max(sol.law_residual + sol.law_step)) < 1e-8 and sol.law_error is None
    assert sol.us is sol.us and sol.responses() is sol.responses()


@pytest.mark.thorough
def test_responses_of_a_copy_or_of_a_solution_that_left_a_transformation_are_the_same():
    """A batch that left `equinox.filter_vmap` has its axis in front."""
    x0s, numbers = jnp.array([-1.0, 0.2]), jnp.array([1.0, 2.0])
    single = [solve(x0, number) for x0, number in zip(x0s, numbers, strict=True)]
    copy = jtu.tree_map(lambda leaf: leaf, single[0])
    compiled = eqx.filter_jit(solve)(x0s[0], numbers[0])
    batch = eqx.filter_vmap(solve)(x0s, numbers)
    assert isinstance(batch.responses(), Responses) and batch.us.shape == (2, 3)
    for found, k in ((copy.responses(), 0), (compiled.responses(), 0), (batch.responses(), ...)):
        want = [one.responses() for one in single]
        want = jtu.tree_map(lambda *rows, k=k: np.stack(rows)[k], *want)
        for a, b in zip(jtu.tree_leaves(found), jtu.tree_leaves(want), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-8)


@pytest.mark.thorough
def test_responses_of_a_problem_made_in_a_transformation_are_available_outside():
    """h closes over a number that is traced, which the solution takes along."""

    @eqx.filter_jit
    def run(number):
        problem = eqx.tree_at(lambda p: p.h, cubic(), lambda t, x, u, _: number - 2 * x - u**3)
        return dvax.solve(problem, -1.0, 0.0, 2.0, ts=TS)

    for number in (1.0, 2.0):
        sol = run(jnp.asarray(number))
        np.testing.assert_allclose(sol.us, law(sol.xs, number), atol=1e-8)


@pytest.mark.slow
def test_responses_first_read_inside_a_compiled_function_are_constants_and_kept():
    sol = solve(-1.0)
    inside = jax.jit(lambda factor: factor * (sol.us + sol.ys))(2.0)
    np.testing.assert_allclose(inside, 6.0 * law(sol.xs), atol=1e-7)
    assert isinstance(sol.us, jax.Array) and not isinstance(sol.us, jax.core.Tracer)
    np.testing.assert_allclose(sol.us, law(sol.xs), atol=1e-8)


@pytest.mark.thorough
def test_responses_read_in_two_traces_do_not_mix():
    """Of a solution that is traced: a value from inside of a branch is not used outside of it."""

    def total(x0):
        sol = solve(x0)
        inner = jax.lax.cond(x0 < 0, lambda: jnp.sum(sol.us), lambda: jnp.sum(sol.ys))
        return inner + jnp.sum(sol.us)

    us = np.asarray(solve(-1.0).us)
    assert float(jax.jit(total)(-1.0)) == pytest.approx(2 * us.sum(), rel=1e-8)


@pytest.mark.thorough
def test_derivatives_of_responses_agree_in_both_modes_and_with_differences():
    def total(v, adjoint):
        sol = dvax.solve(cubic(), v[0], 0.0, 2.0, v[1], TS, rtol=1e-10, adjoint=adjoint)
        return sol.us[0] + 2.0 * sol.ys[1]

    at, step = jnp.array([-1.0, 1.0]), 1e-4
    reverse = jax.grad(lambda v: total(v, "reverse"))(at)
    forward = jax.jacfwd(lambda v: total(v, "forward"))(at)
    around = [[total(at + s * e, "reverse") for s in (step, -step)] for e in jnp.eye(2)]
    np.testing.assert_allclose(reverse, [(a - b) / (2 * step) for a, b in around], rtol=1e-6)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)


@pytest.mark.thorough
@pytest.mark.parametrize(("iterated", "ts"), [(False, None), (True, [0.5, 1.0])])
def test_response_without_a_value_at_one_saved_time_is_a_failure_of_the_run(iterated, ts):
    """h is 0/0 at t = 1 alone, where no step looks."""

    def h(t, x, u, args):
        return jnp.sin(t - 1.0) / (t - 1.0) - 2.0 * x - (u**3 if iterated else 0.0)

    def end(x0, **options):
        problem = eqx.tree_at(lambda p: p.h, cubic(), h)
        return dvax.solve(problem, x0, 0.0, 1.0, ts=ts, rtol=1e-4, throw=False, **options)

    sol = end(-1.0)
    assert sol.result == dvax.RESULTS.nonfinite and np.isfinite(np.asarray(sol.xs)).all()
    assert np.isnan(sol.law_residual).tolist() == [t == 1.0 for t in sol.ts]
    assert iterated or np.isnan(jax.grad(lambda x0: end(x0).xs[0])(-1.0))


class _Lost(dvax.vi.AbstractSolver):
    """A solver that finds nothing at one residual: that of the saved time."""

    def solve(self, vi, y0, tol):
        answer = dvax.vi.Bracketing().solve(vi, y0, tol)
        lost = vi.F.t == 1.0
        return answer._replace(y=jnp.where(lost, jnp.nan, answer.y))


@pytest.mark.thorough
def test_response_that_the_solver_does_not_find_raises_when_it_is_read():
    """And is NaN with NaN derivatives where it is traced."""
    options = dict(ts=TS, vi_solver=_Lost(), dt=0.3)
    sol = dvax.solve(cubic(), -1.0, 0.0, 2.0, jnp.asarray(1.0), **options)
    assert sol.result == dvax.RESULTS.successful
    with pytest.raises(
        dvax.SolveError, match="no finite solution at the saved time t = 1,"
    ) as caught:
        sol.responses()
    partial = caught.value.solution
    assert np.isnan(partial.us).tolist() == [False, True, False]
    assert partial.result == dvax.RESULTS.nonfinite

    def first(number):
        return dvax.solve(cubic(), -1.0, 0.0, 2.0, number, **options).us[0]

    value, slope = jax.jit(jax.value_and_grad(first))(1.0)
    assert np.isfinite(value) and np.isnan(slope)
