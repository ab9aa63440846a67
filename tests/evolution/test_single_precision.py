"""Runs in single precision, at the tolerances that it allows: what a plain call of JAX has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.once import once

import dvax


@pytest.fixture(autouse=True)
def as_users_have_it():
    """Numbers of both precisions are joined, as by default."""
    with jax.numpy_dtype_promotion("standard"):
        yield


def single(*values):
    return tuple(np.float32(v) for v in values)


@once
def damper():
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: 3.0 - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip


def exact_damper(t):
    """From −1, u = ½ as long as x ≤ 0, then u = ½ − x as long as x ≤ ½, then u = 0."""
    t1 = np.log(8.0 / 5.0) / 1.5  # x = 5/3 − 8/3 e^{−1.5t}
    if t <= t1:
        return 5.0 / 3.0 - 8.0 / 3.0 * np.exp(-1.5 * t)
    t2 = t1 + 2.0 * np.log(1.0 / (1.0 - 0.5 / 5.0))  # x = 5(1 − e^{−(t − t1)/2})
    if t <= t2:
        return 5.0 * (1.0 - np.exp(-0.5 * (t - t1)))
    return 2.0 + (0.5 - 2.0) * np.exp(-1.5 * (t - t2))


@pytest.mark.slow
@pytest.mark.parametrize("end", [0.7, 1.1, 1.7, 2.0, 2.3, 10.0])
def test_bound_along_a_trajectory_in_single_precision_for_any_last_time(end):
    sol = dvax.solve(damper(), np.float32(-1.0), 0.0, end, rtol=1e-4)
    assert sol.xs.dtype == jnp.float32
    bound = dvax.bound_error(damper(), sol)
    assert bound.status == "proved"
    error = abs(float(sol.xs[-1]) - exact_damper(float(sol.ts[-1])))
    assert error <= float(bound.x[-1]) <= 1e-3


@once
def pulsed():
    """x' = s(t) − x − u and u = clip(x, 0, ½), where s is 1 in the first part of each period."""
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, a: jnp.where(t % a < 0.45 * a, 1.0, 0.0) - u, h=lambda t, x, u, a: x,
    )  # fmt: skip


def exact_pulsed(x, period, end):
    """x stays in [0, ½], where x' = s − 2x."""
    t = 0.0
    while t < end:
        for length, s in ((0.45 * period, 1.0), (0.55 * period, 0.0)):
            length = min(length, end - t)
            x, t = 0.5 * s + (x - 0.5 * s) * np.exp(-2.0 * length), t + length
    return x


@pytest.mark.slow
def test_jumps_that_no_rule_announces_are_crossed_in_single_precision():
    rng = np.random.default_rng(0)
    for _ in range(12):
        period, end = single(rng.uniform(0.5, 3.0), rng.uniform(3.0, 12.0))
        sol = dvax.solve(pulsed(), np.float32(0.3), 0.0, float(end), period, rtol=1e-4, atol=1e-6)
        exact = exact_pulsed(0.3, float(period), float(end))
        assert abs(float(sol.xs[-1]) - exact) <= 5e-4


@once
def game():
    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Simplex(1.0),
        control_space=dvax.spaces.Euclidean((3,)),
        f=lambda t, x, u, a: -x + a["B"] @ u + a["c"] * jnp.sin(2.0 * t),
        h=lambda t, x, u, a: a["C"] @ x + a["D"] @ u + a["q"] * jnp.cos(a["w"] * t),
    )  # fmt: skip


def of_game(seed, dtype):
    rng = np.random.default_rng(seed)
    D = rng.normal(size=(3, 3))
    args = dict(
        B=rng.normal(size=(3, 3)), C=2.0 * rng.normal(size=(3, 3)), D=0.6 * D / np.linalg.norm(D, 2),
        q=rng.normal(size=3), c=rng.normal(size=3), w=rng.uniform(1.0, 4.0),
    )  # fmt: skip
    return {name: np.asarray(value, dtype) for name, value in args.items()}


@pytest.mark.slow
def test_kinks_of_a_coupled_law_are_passed_in_single_precision_in_as_many_steps():
    for seed in range(10):
        steps, ends = [], []
        for dtype in (np.float32, np.float64):
            x0, args = np.zeros(3, dtype), of_game(seed, dtype)
            sol = dvax.solve(game(), x0, 0.0, 6.0, args, rtol=5e-5, atol=1e-6)
            steps.append(int(sol.stats["steps"]))
            ends.append(np.asarray(sol.xs[-1], float))
        assert steps[0] <= 1.5 * steps[1] + 20
        assert np.abs(ends[0] - ends[1]).max() <= 2e-3


@once
def half_space():
    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0),
        K=lambda t, a: dvax.sets.HalfSpace(a["g"], a["b"]),
        control_space=dvax.spaces.Euclidean((3,)), f=lambda t, x, u, a: a["v"],
        h=lambda t, x, u, a: a["C"] @ x + a["D"] @ u,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_iterated_law_is_solved_where_its_operator_is_roundoff(dtype):
    """x is a hundred times the bound of K, and F(y) is the roundoff of its terms inside K."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        D = rng.normal(size=(3, 3))
        a = dict(C=rng.normal(size=(3, 3)), D=0.6 * D / np.linalg.norm(D, 2), g=rng.normal(size=3),
                 v=rng.normal(size=3), b=0.5)  # fmt: skip
        a = {name: np.asarray(value, dtype) for name, value in a.items()}
        x0 = np.asarray(100.0 * rng.normal(size=3), dtype)
        rtol = 1e-4 if dtype is np.float32 else 1e-12
        sol = dvax.solve(half_space(), x0, 0.0, 4.0, a, rtol=rtol, atol=1e-2 * rtol)
        eps = float(np.finfo(dtype).eps)
        x = x0 + 4.0 * a["v"]
        np.testing.assert_allclose(sol.xs[-1], x, rtol=20.0 * eps, atol=4000.0 * eps)
        # With P = 1 the response is projected onto the half-space, in the metric of I − D.
        inverse = np.linalg.inv(np.eye(3) - a["D"].astype(float))
        free = inverse @ (a["C"].astype(float) @ np.asarray(sol.xs[-1], float))
        g = a["g"].astype(float)
        u = free - max(g @ free - 0.5, 0.0) / (g @ inverse @ g) * (inverse @ g)
        assert np.abs(np.asarray(sol.us[-1]) - u).max() <= 100.0 * rtol * (1.0 + np.abs(free).max())
