"""`Picard` over windows: order, tolerance, bound and failures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import c1, c1_derivatives, c2, c3
from tests.selection import mostly_thorough

import dvax
from dvax import generators, signals
from dvax.evolution.picard import accumulate_by_doubling, accumulate_sequentially

PLAIN = dvax.operators.Scaling(1.0)


def solve(case, **how):
    ts = np.linspace(0.0, case.t1, 6)
    sol = dvax.solve(
        case.problem, case.x0, 0.0, case.t1, args=case.args, ts=ts, method=dvax.Picard(), **how
    )
    exact = [case.exact(t)[0] for t in ts]
    off = [np.sqrt(np.sum((np.asarray(x) - e) ** 2)) for x, e in zip(sol.xs, exact, strict=True)]
    return sol, np.array(off)


@pytest.mark.slow
def test_picard_has_order_two_on_the_shrinking_ball():
    case = c3()
    counts = np.array([64, 128, 256, 512])
    errors = []
    for n in counts:
        sol = dvax.solve(case.problem, case.x0, 0.0, 2.0, dt=2.0 / n, method=dvax.Picard())
        assert int(sol.stats["steps"]) == n and int(sol.stats["windows"]) == n // 64
        errors.append(np.max(np.abs(np.asarray(sol.xs[-1]) - case.exact(2.0)[0])))
    found = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    print(f"C3 by windows: observed order {found:.3f}, errors {errors}")
    assert found == pytest.approx(2.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("make", mostly_thorough([c1, c2, c3], [c1]))
def test_picard_error_is_below_its_bound_and_near_the_tolerance(make):
    case = make()
    sol, off = solve(case, rtol=1e-5, atol=1e-5)
    bound = dvax.bound_error(case.problem, sol, case.constants)
    assert np.all(off <= np.asarray(bound.x) * (1 + 1e-12) + 1e-14)
    assert np.max(off) < 2e-5 * (1 + np.max(np.abs(np.asarray(sol.xs))))
    assert 0 <= float(sol.stats["contraction"]) < 1
    assert int(sol.stats["sweeps"]) < 20 * int(sol.stats["windows"])


@pytest.mark.slow
def test_picard_bound_of_the_contact_law_is_proved():
    case = c1()
    sol, _ = solve(case, rtol=1e-4, atol=1e-4)
    assert sol.enclosed


def test_picard_sweeps_converge_superlinearly():
    # x' = −3u, u = x: the k-th correction is at most (3W)^k/k! of the first.
    problem = dvax.Problem(
        A=generators.Zero(), P=PLAIN, K=dvax.sets.WholeSpace(),
        f=lambda t, x, u, args: -3.0 * u, h=lambda t, x, u, args: 2.0 * x - u,
    )  # fmt: skip
    sol = dvax.solve(problem, 1.0, 0.0, 1.0, dt=1 / 64, method=dvax.Picard())
    assert float(sol.xs[0]) == pytest.approx(np.exp(-3.0), rel=1e-3)
    # 3^k/k! < 20 ε at k = 26.
    assert int(sol.stats["windows"]) == 1 and 15 <= int(sol.stats["sweeps"]) <= 28


@pytest.mark.slow
def test_picard_sums_in_turn_and_by_doubling_agree():
    rng = np.random.default_rng(3)
    A = generators.Dense(rng.normal(size=(3, 3)))
    h = jnp.asarray(0.1)
    both = jax.jit(
        lambda v: (accumulate_sequentially(A.propagator(h, 2), v), accumulate_by_doubling(A, h, v))
    )
    for count in (2, 37):
        one, other = both(rng.normal(size=(count, 3)))
        np.testing.assert_allclose(np.asarray(other), np.asarray(one), rtol=1e-11, atol=1e-11)


def iterated(K):
    return dvax.Problem(
        A=generators.Dense(jnp.array([[-0.5, -3.0], [3.0, -0.5]])), P=PLAIN, K=K,
        f=lambda t, x, u, args: jnp.sin(t) - u, h=lambda t, x, u, args: 2 * x - u - 0.1 * u**3,
    )  # fmt: skip


@pytest.mark.thorough
def test_picard_solves_an_iterated_law_as_one_batch():
    problem = iterated(lambda t, args: dvax.sets.Ball(0.0, 0.7 * jnp.exp(-t)))
    x0 = jnp.array([2.0, 0.3])
    ours = dvax.solve(
        problem, x0, 0.0, 1.0, rtol=1e-5, atol=1e-5, method=dvax.Picard(nodes=32), dense=True,
        max_steps=4096,
    )  # fmt: skip
    theirs = dvax.solve(problem, x0, 0.0, 1.0, rtol=1e-8, method=dvax.ETD4RK(), ts=[0.37, 1.0])
    np.testing.assert_allclose(np.asarray(ours.xs[-1]), np.asarray(theirs.xs[-1]), atol=2e-5)
    x, u = ours.evaluate(0.37)
    np.testing.assert_allclose(np.asarray(x), np.asarray(theirs.xs[0]), atol=2e-5)
    np.testing.assert_allclose(np.asarray(u), np.asarray(theirs.us[0]), atol=5e-5)


@pytest.mark.slow
def test_picard_windows_end_at_jumps_of_data():
    table = signals.Table([0.0, 0.37, 1.0], [1.0, -3.0, 0.0], kind="constant")
    problem = dvax.Problem(
        A=generators.Zero(), P=PLAIN, K=dvax.sets.WholeSpace(), f=lambda t, x, u, args: table(t),
        h=lambda t, x, u, args: -u,
    )  # fmt: skip
    for how in (dict(dt=0.01), dict(rtol=1e-6)):
        sol = dvax.solve(problem, 0.0, 0.0, 1.0, method=dvax.Picard(nodes=8), **how)
        assert float(sol.xs[0]) == pytest.approx(0.37 - 3.0 * 0.63, abs=1e-12)
        assert int(sol.stats["rejected"]) == 0


@pytest.mark.slow
def test_picard_has_forward_derivatives_only():
    case = c1()

    def end(x0, ell):
        how = dict(rtol=1e-6, max_steps=2**15, method=dvax.Picard())
        return dvax.solve(case.problem, x0, 0.0, 2.0, args=(ell,), **how).xs[-1]

    given = jnp.asarray(-1.0), jnp.asarray(3.0)
    found = jax.jacfwd(lambda v: end(*v))(given)
    np.testing.assert_allclose([float(v) for v in found], c1_derivatives(), rtol=2e-3)
    with pytest.raises(dvax.DifferentiationError, match="Picard"):
        jax.grad(lambda v: end(*v))(given)


@pytest.mark.slow
def test_picard_window_without_convergence_is_shortened_or_fails():
    """Adaptive windows are shortened; a fixed one ends with picard_unconverged."""
    problem = dvax.Problem(
        A=generators.Zero(), P=PLAIN, K=dvax.sets.WholeSpace(),
        f=lambda t, x, u, args: -200.0 * u, h=lambda t, x, u, args: 2.0 * x - u,
    )  # fmt: skip
    run = lambda **how: dvax.solve(  # noqa: E731
        problem, 1.0, 0.0, 1.0, method=dvax.Picard(max_sweeps=12), throw=False, **how
    )
    assert run(dt=1 / 64).result == dvax.RESULTS.picard_unconverged
    adapted = run(rtol=1e-3)
    assert adapted.result == dvax.RESULTS.successful and int(adapted.stats["rejected"]) > 0
    assert float(adapted.xs[0]) == pytest.approx(0.0, abs=1e-5)
    assert run(rtol=1e-3, max_steps=64).result == dvax.RESULTS.max_steps


@pytest.mark.slow
def test_picard_batch_equals_its_lanes():
    case = c1()
    run = lambda ell: dvax.solve(  # noqa: E731
        case.problem, -1.0, 0.0, 2.0, args=(ell,), rtol=1e-4, method=dvax.Picard()
    ).xs[-1]
    ells = jnp.array([2.0, 3.0])
    together = jax.vmap(run)(ells)
    np.testing.assert_allclose(np.asarray(together), [float(run(ell)) for ell in ells], rtol=1e-12)


def test_picard_rejects_parameters_that_are_not_positive_integers():
    for bad in (dict(nodes=0), dict(max_sweeps=-1)):
        with pytest.raises(dvax.InputError, match="positive integer"):
            dvax.Picard(**bad)
