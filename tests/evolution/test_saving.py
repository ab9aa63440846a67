"""Saved times, dense output, and states that are tuples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import c1, c1_solution, c2, c3
from tests.selection import mostly_thorough

import dvax
from dvax.evolution import RESULTS


@pytest.mark.slow
def test_dense_output_saved_times_and_the_exact_solution_agree():
    case = c3()
    ts = np.array([0.0, 0.013, 0.5, 1.7, 2.999, 3.0, 3.4, 4.0])
    # (Order 2: its steps do not follow roundings, which differ between the two programs.)
    common = dict(args=case.args, rtol=1e-5, atol=1e-5, method=dvax.ETD2RK())
    x0 = jnp.asarray(case.x0)
    saved = dvax.solve(case.problem, x0, 0.0, 4.0, ts=ts, **common)
    dense = dvax.solve(case.problem, x0, 0.0, 4.0, dense=True, max_steps=4096, **common)
    assert np.array_equal(np.asarray(saved.ts), ts)
    for k, t in enumerate(ts):
        x, u = dense.evaluate(t)
        np.testing.assert_allclose(np.asarray(x), np.asarray(saved.xs[k]), rtol=0, atol=1e-12)
        np.testing.assert_allclose(np.asarray(u), np.asarray(saved.us[k]), rtol=0, atol=1e-11)
        np.testing.assert_allclose(np.asarray(x), case.exact(t)[0], atol=1e-4)
    assert float(dense.ts[-1]) == 4.0 and np.array_equal(dense.xs[-1], saved.xs[-1])


@pytest.mark.slow
def test_dense_runs_have_room_for_the_steps_that_they_take():
    # More steps than there is room for at first, and a state whose 2²⁰ steps would fill the memory.
    case = c1()
    sol = dvax.solve(
        case.problem, -1.0, 0.0, 2.0, args=case.args, rtol=1e-8, method=dvax.ETD2RK(), dense=True
    )
    assert int(sol.stats["steps"]) > 4096
    for t in (0.0, 0.7, 1.999):
        np.testing.assert_allclose(float(sol.evaluate(t)[0]), c1_solution(t)[0], atol=1e-7)
    many = dvax.solve(
        case.problem, -jnp.ones(20_000), 0.0, 2.0, args=case.args, rtol=1e-3, dense=True
    )
    np.testing.assert_allclose(many.evaluate(1.0)[0], c1_solution(1.0)[0], atol=1e-2)


def test_ts_none_saves_the_end_only():
    sol = dvax.solve(c1().problem, -1.0, 0.0, 2.0, args=c1().args)
    assert np.asarray(sol.ts).tolist() == [2.0]
    assert sol.xs.shape == sol.us.shape == sol.ys.shape == (1,)


def test_ts_may_repeat_a_time_and_lie_between_fixed_steps():
    ts = [0.0, 0.15, 0.15, 0.3, 1.0]
    sol = dvax.solve(c1().problem, -1.0, 0.0, 1.0, args=c1().args, ts=ts, dt=0.01)
    assert np.array_equal(np.asarray(sol.ts), ts)
    assert float(sol.xs[1]) == float(sol.xs[2])
    exact = [float(c1().exact(t)[0]) for t in ts]
    np.testing.assert_allclose(np.asarray(sol.xs), exact, atol=1e-4)


ENDS = np.linspace(0.0, 2.0, 201)
"""Of the steps of a run with dt = 0.01."""
TIMES = {
    "every step": ENDS,
    "every seventh": ENDS[3::7],
    "between all of them": 0.5 * (ENDS[1:] + ENDS[:-1]),
    "some of each": np.sort(np.concatenate([ENDS[::3], ENDS[50:60], [0.005, 0.0051, 1.9999, 2.0]])),
    "rounded": np.nextafter(ENDS[1:-1], np.where(np.arange(199) % 2, 0.0, 3.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize("which", mostly_thorough(TIMES, ["some of each"]))
def test_saved_rows_agree_with_the_dense_output(which):
    """Of the same steps, whichever are saved: against the dense output, and in a batch, where the
    steps of each end elsewhere and one of the runs fails."""
    problem, args, ts = c1().problem, c1().args, TIMES[which]
    dense = dvax.solve(problem, -1.0, 0.0, 2.0, args, dt=0.01, dense=True)
    found = dvax.solve(problem, -1.0, 0.0, 2.0, args, dt=0.01, ts=ts)
    np.testing.assert_array_equal(found.ts, ts)
    some = np.arange(0, len(ts), max(1, len(ts) // 16))
    exact = [float(dense.evaluate(ts[k])[0]) for k in some]
    np.testing.assert_allclose(np.asarray(found.xs)[some], exact, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.xs, [c1().exact(t)[0] for t in ts], atol=1e-4)
    np.testing.assert_allclose(found.us, [c1().exact(t)[1] for t in ts], atol=1e-4)
    assert found.stats["steps"] == 200

    def run(x0, end):
        part = dvax.solve(
            problem, x0, 0.0, end, args, dt=end / 200, ts=0.5 * end * ts, max_steps=200, throw=False
        )
        return part.ts, part.xs, part.us, part.stats["steps"], part.result == RESULTS.successful

    x0s, ends = jnp.array([-1.0, jnp.nan, 0.7]), jnp.array([2.0, 1.0, 0.3])
    together = jax.jit(jax.vmap(run))(x0s, ends)
    for k in (0, 2):
        for a, b in zip(together, jax.jit(run)(x0s[k], ends[k]), strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-14, atol=1e-14)
    assert together[4].tolist() == [True, False, True]
    np.testing.assert_allclose(together[1][0], found.xs, rtol=0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("which", mostly_thorough(["every step", "some of each"], ["some of each"]))
def test_derivatives_of_saved_rows_agree_in_both_modes(which):
    weights = jnp.asarray(np.random.default_rng(0).normal(size=len(TIMES[which])))

    def total(x0, ell, adjoint):
        found = dvax.solve(
            c1().problem, x0, 0.0, 2.0, (ell,), dt=0.01, ts=TIMES[which], adjoint=adjoint
        )
        return jnp.vdot(weights, found.xs) + jnp.vdot(weights, found.us)

    back = jax.grad(total, argnums=(0, 1))(-1.0, 3.0, "reverse")
    along = jax.jacfwd(total, argnums=(0, 1))(-1.0, 3.0, "forward")
    np.testing.assert_allclose(back, along, rtol=1e-11)
    # An oracle that shares nothing: the closed form, by differences.
    exact = lambda x0, ell: sum(  # noqa: E731
        w * (x + u)
        for w, (x, u) in zip(weights, (c1_solution(t, x0, ell) for t in TIMES[which]), strict=True)
    )
    step = 1e-6
    by_hand = [
        (exact(-1.0 + step, 3.0) - exact(-1.0 - step, 3.0)) / (2 * step),
        (exact(-1.0, 3.0 + step) - exact(-1.0, 3.0 - step)) / (2 * step),
    ]
    np.testing.assert_allclose(back, by_hand, rtol=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("t", mostly_thorough([-0.1, 2.5], [2.5]))
def test_evaluate_outside_the_solved_interval_raises_an_error(t):
    sol = dvax.solve(
        c1().problem, -1.0, 0.0, 2.0, args=c1().args, dense=True, rtol=1e-3, max_steps=4096
    )
    with pytest.raises(dvax.InputError, match=r"\[0, 2\]"):
        sol.evaluate(t)


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvax.ETD4RK(), dvax.PiecewiseLinear()])
def test_evaluate_at_an_array_of_times_gives_a_row_for_each(method):
    case = c1()
    sol = dvax.solve(
        case.problem,
        jnp.asarray(case.x0),
        0.0,
        2.0,
        case.args,
        dense=True,
        method=method,
        rtol=1e-8,
    )
    times = np.linspace(0.0, 2.0, 6).reshape(2, 3)
    x, u = sol.evaluate(times)
    assert x.shape == (2, 3, *np.shape(case.x0)) and u.shape[:2] == (2, 3)
    for index in np.ndindex(2, 3):
        one, response = sol.evaluate(times[index])
        np.testing.assert_allclose(x[index], one, atol=1e-14)
        np.testing.assert_allclose(u[index], response, atol=1e-14)
    with pytest.raises(dvax.InputError, match=r"t = 2.5.*\[0, 2\]"):
        sol.evaluate([0.5, 2.5])


def test_evaluate_without_dense_names_the_option():
    sol = dvax.solve(c1().problem, -1.0, 0.0, 2.0, args=c1().args)
    with pytest.raises(dvax.InputError, match="dense=True"):
        sol.evaluate(1.0)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (dict(ts=[0.5, 0.2]), ["ts"]),
        (dict(ts=[0.0, 2.5]), ["ts"]),
        (dict(ts=[]), ["ts"]),
        (dict(dt=-0.1), ["dt"]),
        (dict(rtol=float("nan")), ["rtol"]),
        (dict(rtol=0.0, atol=0.0), ["rtol, atol"]),
        (dict(rtol=-1.0, dt0=0.0, horizon=-2.0), ["rtol", "dt0", "horizon"]),
    ],
)
def test_invalid_solve_options_are_all_reported_at_once(wrong, words):
    with pytest.raises(dvax.InputError) as caught:
        dvax.solve(c1().problem, -1.0, 0.0, 2.0, args=c1().args, **wrong)
    for word in words:
        assert f"dvax.solve({word})" in str(caught.value)


@pytest.mark.parametrize(("t0", "t1"), [(1.0, 0.0), (0.0, 0.0), (0.0, np.inf), (np.nan, 1.0)])
def test_time_span_must_be_increasing_and_finite(t0, t1):
    with pytest.raises(dvax.InputError, match="t0, t1"):
        dvax.solve(c1().problem, -1.0, t0, t1, args=c1().args)


def test_initial_state_with_a_nonfinite_entry_names_its_position():
    with pytest.raises(dvax.InputError, match=r"nan at index \(1,\)"):
        dvax.solve(c2().problem, jnp.array([0.0, np.nan]), 0.0, 1.0)


@pytest.mark.thorough
def test_tuple_state_equals_the_stacked_problem():
    # x = (a, b) with a a number and b a pair; u = (v, w) with v a pair and w a number.
    g, o, k, s = dvax.generators, dvax.operators, dvax.sets, dvax.spaces
    B = np.array([[-1.0, 2.0], [-2.0, -1.0]])
    A = np.zeros((3, 3))
    A[0, 0], A[1:, 1:] = -0.5, B
    F = np.array([[1.0, 0.3, 0.0], [0.0, -0.5, 1.0], [0.7, 0.0, -1.0]])
    H = np.array([[-1.0, 0.5, 0.0], [0.3, 0.0, 2.0], [0.0, -1.0, 0.4]])
    S = np.array([[0.2, 0.4, 0.0], [-0.4, 0.1, 0.3], [0.0, -0.3, 0.3]])
    P = np.diag([2.0, 2.0, 0.5])
    join = lambda z: jnp.concatenate([jnp.atleast_1d(p) for p in z])  # noqa: E731
    drive = lambda t: jnp.stack([jnp.sin(t), jnp.cos(2 * t), jnp.ones_like(t)])  # noqa: E731
    f = lambda t, x, u, args: drive(t) - jnp.asarray(F) @ u  # noqa: E731
    h = lambda t, x, u, args: 2 * drive(t) + jnp.asarray(H) @ x - jnp.asarray(S) @ u  # noqa: E731

    def split_f(t, x, u, args):
        out = f(t, join(x), join(u), args)
        return out[0], out[1:]

    def split_h(t, x, u, args):
        out = h(t, join(x), join(u), args)
        return out[:2], out[2]

    parts = dvax.Problem(
        A=g.Product(g.Scalar(-0.5), g.Dense(B)),
        P=o.Product(o.Scaling(2.0), o.Scaling(0.5)),
        K=k.Product(k.Box(0.0, np.array([1.0, 0.5])), k.Box(-0.2, 0.6)),
        f=split_f,
        h=split_h,
        state_space=s.Product(s.Euclidean(), s.Euclidean(2)),
        control_space=s.Product(s.Euclidean(2), s.Euclidean()),
    )
    stacked = dvax.Problem(
        A=g.Dense(A),
        P=o.Dense(P),
        K=k.Box(np.array([0.0, 0.0, -0.2]), np.array([1.0, 0.5, 0.6])),
        f=f,
        h=h,
    )
    x0, ts = np.array([0.3, -1.0, 0.8]), np.linspace(0, 2, 9)
    settings = dict(ts=ts, dt=0.02)
    a = dvax.solve(parts, (jnp.asarray(x0[0]), jnp.asarray(x0[1:])), 0.0, 2.0, **settings)
    b = dvax.solve(stacked, jnp.asarray(x0), 0.0, 2.0, **settings)
    stack = lambda z: np.concatenate([np.asarray(p).reshape(9, -1) for p in z], axis=1)  # noqa: E731
    np.testing.assert_allclose(stack(a.xs), np.asarray(b.xs), atol=1e-9)
    np.testing.assert_allclose(stack(a.us), np.asarray(b.us), atol=1e-9)
    # Every regime occurs, or the comparison would say little.
    assert a.us[0].shape == (9, 2) and a.us[1].shape == (9,)
    y = stack(a.ys)
    assert np.any(y[:, 0] == 1.0) and np.any(y[:, 2] == -0.2) | np.any(y[:, 2] == 0.6)


@pytest.mark.thorough
def test_to_xarray_contains_the_trajectory():
    pytest.importorskip("xarray", reason="the extra dvax[app] is not installed")
    sol = dvax.solve(c2().problem, jnp.asarray(c2().x0), 0.0, 1.0, ts=[0.0, 0.5, 1.0])
    data = sol.to_xarray()
    assert data["x"].dims == ("time", "x_dim0")
    np.testing.assert_array_equal(data["x"].values, np.asarray(sol.xs))
    np.testing.assert_array_equal(data["time"].values, [0.0, 0.5, 1.0])
