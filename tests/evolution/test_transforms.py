"""`dvax.solve` under `jit` and `vmap`: it compiles once, and all ways of calling agree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import c1

import dvax


def counted():
    """C1 with a counter of the traces of f."""
    traces = []

    def f(t, x, u, args):
        traces.append(1)
        return args - 0.5 * x - u

    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 0.5),
        f=f,
        h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )
    return problem, traces


@pytest.mark.slow
@pytest.mark.parametrize("number", [float, jnp.asarray], ids=["Python numbers", "arrays"])
def test_new_tolerances_times_states_and_parameters_do_not_recompile(number):
    problem, traces = counted()
    ts = np.linspace(0, 2, 5)
    x0, ell = number(-1.0), number(3.0)
    first = dvax.solve(problem, x0, 0.0, 2.0, args=ell, ts=ts, rtol=1e-4, method=dvax.ETD2RK())
    before = len(traces)
    assert before > 0
    same = dict(method=dvax.ETD2RK())
    second = dvax.solve(problem, x0, 0.0, 2.0, args=ell, ts=ts, rtol=1e-5, atol=1e-7, **same)
    dvax.solve(problem, number(-0.5), 0.0, 2.0, args=number(2.5), ts=ts, **same)
    dvax.solve(problem, x0, 0.5, 3.0, args=ell, ts=ts / 2 + 0.7, rtol=1e-3, **same)
    assert len(traces) == before
    # And the new numbers were used, not the ones that were there when it was compiled.
    assert int(second.stats["steps"]) > int(first.stats["steps"])


def test_fixed_steps_of_another_length_do_not_recompile():
    problem, traces = counted()
    dvax.solve(problem, -1.0, 0.0, 2.0, args=3.0, dt=0.01)
    before = len(traces)
    sol = dvax.solve(problem, -1.0, 0.0, 2.0, args=3.0, dt=0.009)
    assert len(traces) == before
    assert int(sol.stats["steps"]) == 223


@pytest.mark.slow
def test_vmap_over_states_and_parameters_equals_a_loop():
    case = c1()
    x0s, ells = jnp.array([-1.0, 0.2, 3.0]), jnp.array([3.0, 1.0, 0.1])

    def one(x0, ell):
        sol = dvax.solve(
            case.problem, x0, 0.0, 2.0, args=(ell,), ts=np.array([0.5, 2.0]), rtol=1e-6
        )
        return sol.xs, sol.us

    together = jax.vmap(one)(x0s, ells)
    for k in range(3):
        for whole, single in zip(together, one(x0s[k], ells[k]), strict=True):
            np.testing.assert_allclose(np.asarray(whole[k]), np.asarray(single), atol=1e-12)


def test_solve_inside_jit_equals_the_solve_outside():
    case = c1()
    run = lambda x0: dvax.solve(case.problem, x0, 0.0, 2.0, args=case.args, rtol=1e-6).xs  # noqa: E731
    np.testing.assert_allclose(jax.jit(run)(-1.0), run(-1.0), rtol=0, atol=1e-14)


def test_run_in_two_halves_equals_the_whole_run():
    case = c1()
    whole = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, dt=1 / 64)
    half = dvax.solve(case.problem, -1.0, 0.0, 1.0, args=case.args, dt=1 / 64)
    rest = dvax.solve(case.problem, half.xs[-1], 1.0, 2.0, args=case.args, dt=1 / 64)
    np.testing.assert_allclose(np.asarray(rest.xs), np.asarray(whole.xs), rtol=0, atol=1e-14)


@pytest.mark.slow
def test_f_may_use_fourier_transforms():
    n = 32
    s = jnp.arange(float(n)) * (2.0 * jnp.pi / n)
    symbol = jnp.exp(-(jnp.arange(n // 2 + 1.0) ** 2) / 50.0).astype(complex)
    problem = dvax.Problem(
        A=dvax.generators.Elliptic(n, 2.0 * jnp.pi, boundary="periodic"),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.4),
        f=lambda t, x, u, args: jnp.fft.irfft(jnp.fft.rfft(x) * symbol, n) - u,
        h=lambda t, x, u, args: 1.0 - 1.5 * x - 0.5 * u,
    )  # fmt: skip
    found = dvax.solve(problem, jnp.sin(s), 0.0, 1.0, rtol=1e-5)
    fine = dvax.solve(problem, jnp.sin(s), 0.0, 1.0, dt=1e-3)
    assert int(found.stats["steps"]) < 1000
    assert float(jnp.max(jnp.abs(found.xs[-1] - fine.xs[-1]))) < 1e-4
