"""Changes between two samples of a step are not missed: dips of a bound, pulses, periods, jumps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax

METHODS = {
    "DormandPrince": dvax.DormandPrince(), "ETD4RK": dvax.ETD4RK(),
    "ExpRosenbrock": dvax.ExpRosenbrock(),
}  # fmt: skip
DIPS = {
    "vee": lambda t, a, np: np.abs(t - a),
    "waves": lambda t, a, np: np.abs(np.sin(12.0 * (t - a))) / 5.0,
    "bell": lambda t, a, np: 0.1 - 0.1 * np.exp(-(((t - a) / 0.01) ** 2)),
}
RTOL = 1e-6


def end_of(problem, t1, method):
    """Return x(t1) from 0 as a function of args, compiled once."""
    return jax.jit(
        lambda a: dvax.solve(
            problem, jnp.zeros(()), 0.0, t1, a, rtol=RTOL, atol=1e-9, method=method, throw=False
        ).xs[-1]
    )


ALL = [(dip, method) for dip in DIPS for method in METHODS]


@pytest.mark.thorough
@pytest.mark.parametrize(("dip", "method"), mostly_thorough(ALL, [("vee", "DormandPrince")]))
def test_dip_of_a_bound_within_a_step_is_resolved(dip, method):
    """x' = u − 0.1x, u = min(0.05, k(t)): by quadrature of e^{−0.1(2 − s)} min(0.05, k(s))."""
    k = DIPS[dip]
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0),
        K=lambda t, a: dvax.sets.Box(-1.0, k(t, a, jnp)),
        f=lambda t, x, u, a: u - 0.1 * x, h=lambda t, x, u, a: 0.05 + 0.0 * x,
    )  # fmt: skip
    run = end_of(problem, 2.0, METHODS[method])
    s = np.linspace(0.0, 2.0, 1_000_001)
    for a in np.random.default_rng(0).uniform(0.0, 2.0, 12):
        exact = np.trapezoid(np.exp(-0.1 * (2.0 - s)) * np.minimum(0.05, k(s, a, np)), s)
        assert abs(float(run(a)) - exact) <= 10 * (RTOL * abs(exact) + 1e-9) + 1e-10


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["where", "floor"])
@pytest.mark.parametrize("method", mostly_thorough(METHODS, ["DormandPrince"]))
def test_hidden_jump_does_not_end_a_run(kind, method):
    """x' = −x ± 1 with the sign changing at a; `floor` hides the time of the jump from the code."""
    before = {
        "where": lambda t, a: jnp.where(t < a, 1.0, -1.0),
        "floor": lambda t, a: 1.0 - 2.0 * jnp.clip(jnp.floor(t / a), 0.0, 1.0),
    }[kind]
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, a: before(t, a) + 0.0 * u, h=lambda t, x, u, a: -u,
    )  # fmt: skip
    run = end_of(problem, 3.0, METHODS[method])
    for a in np.random.default_rng(1).uniform(1.6, 3.0, 40):
        exact = -1.0 + (2.0 - np.exp(-a)) * np.exp(-(3.0 - a))
        assert abs(float(run(a)) - exact) <= 10 * RTOL


@pytest.mark.thorough
@pytest.mark.parametrize("method", mostly_thorough(METHODS, ["DormandPrince"]))
@pytest.mark.parametrize("start", [0.0, pytest.param(-3e5, marks=pytest.mark.thorough)])
def test_hundreds_of_hidden_jumps_do_not_end_a_run_at_a_tight_tolerance(method, start):
    """x' = −x ± 1, the sign changing with `floor` every 1/151; x in closed form at the last change."""
    every = 1.0 / 151.0
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, a: 1.0 - 2.0 * jnp.mod(jnp.floor((t - start) / every), 2.0) + 0.0 * u,
        h=lambda t, x, u, a: -u,
    )  # fmt: skip
    # The errors of jumps add up: each is uncertain by the rounding of t.
    rtol = 1e-10 if start == 0.0 else 1e-6
    x = dvax.solve(
        problem, 0.0, start, start + 1.0, 0.0, rtol=rtol, atol=1e-3 * rtol, method=METHODS[method],
        max_steps=200_000,
    ).xs[-1]  # fmt: skip
    exact = 0.0
    for k in range(151):
        exact = (-1.0) ** k + (exact - (-1.0) ** k) * np.exp(-every)
    assert abs(float(x) - exact) <= 10 * rtol


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("span", "method"),
    mostly_thorough(
        [(t, m) for t in (97.0, 200.0, 500.0) for m in ("DormandPrince", "ETD4RK")],
        [(200.0, "DormandPrince")],
    ),
)
def test_periodic_data_over_whole_periods_are_not_taken_for_constant(span, method):
    """x' = −x + u, u = sin²(2πt) within a ball; the span is a whole number of periods."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Ball(0.0, 5.0),
        f=lambda t, x, u, a: u, h=lambda t, x, u, a: jnp.sin(2 * jnp.pi * t) ** 2 + 0.0 * x,
    )  # fmt: skip
    w = 4 * np.pi
    exact = 0.5 - 0.5 * (np.cos(w * span) + w * np.sin(w * span)) / (1 + w * w)
    sol = dvax.solve(problem, jnp.zeros(1), 0.0, span, rtol=RTOL, method=METHODS[method])
    assert abs(float(sol.xs[-1, 0]) - exact) <= 10 * RTOL


def test_dt_max_limits_adaptive_steps():
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, a: u, h=lambda t, x, u, a: -u,
    )  # fmt: skip
    free = dvax.solve(problem, 1.0, 0.0, 1.0)
    limited = dvax.solve(problem, 1.0, 0.0, 1.0, dt_max=0.01)
    assert int(free.stats["steps"]) < 50 and int(limited.stats["steps"]) >= 100
    with pytest.raises(dvax.InputError, match="dt_max"):
        dvax.solve(problem, 1.0, 0.0, 1.0, dt_max=-1.0)


@pytest.mark.slow
@pytest.mark.parametrize("method", mostly_thorough([None, dvax.ETD2RK()], [None]))
def test_single_precision_state_beside_a_moving_set_of_double_precision(method):
    # The center 0.0 of the ball is a double, and the guard bounds the changes of h and K together.
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Ball(0.0, 1.0 + 0.5 * jnp.sin(t)),
        f=lambda t, x, u, args: -x + u, h=lambda t, x, u, args: jnp.cos(t) + 0.0 * x,
    )  # fmt: skip

    def solve(dtype):
        options = dict(rtol=1e-4, atol=1e-6, method=method)
        return dvax.solve(problem, jnp.ones(2, dtype), 0.0, 2.0, **options).xs

    with jax.numpy_dtype_promotion("standard"):
        single, double = solve(jnp.float32), solve(jnp.float64)
    assert single.dtype == jnp.float32
    assert np.allclose(single, double, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvax.DormandPrince(), dvax.ETD4RK(), dvax.ExpRosenbrock()])
def test_a_set_that_was_made_in_single_precision_limits_a_run_in_double_precision(method):
    """1.0 is 1.0 in both: the type of the set has no effect. The two programs differ in rounding."""
    with jax.enable_x64(False):
        early = dvax.sets.Box(-1.0, 1.0)
    table = dvax.signals.Table(np.arange(5.0), np.array([1.0, 2.0, 0.0, 3.0, 1.0]))

    def end(K):
        problem = dvax.Problem(
            A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=K,
            control_space=dvax.spaces.Euclidean(()),
            f=lambda t, x, u, args: args(t) - u, h=lambda t, x, u, args: 3.0 * (args(t) - x),
        )  # fmt: skip
        sol = dvax.solve(problem, 0.0, 0.0, 4.0, table, method=method)
        return float(sol.xs[-1]), int(sol.stats["steps"])

    with jax.numpy_dtype_promotion("standard"):
        (x, steps), (expected, steps_expected) = end(early), end(dvax.sets.Box(-1.0, 1.0))
    assert steps == steps_expected
    assert abs(x - expected) <= 1e-14 * abs(expected)
