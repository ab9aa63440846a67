"""Failed runs: cause, time and place are reported, and earlier results are kept."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.once import once
from tests.selection import mostly_thorough

import dvax
from dvax.evolution import RESULTS

BREAKS = 0.7


@once
def system(broken):
    """x' = −x − u of three entries, u = proj_{[0,1]}(x); from t = 0.7 on one of f, h, K is broken."""

    def bad(t, name):
        return jnp.where((t >= BREAKS) & (broken == name), jnp.nan, 0.0)

    hit = jnp.array([0.0, 1.0, 0.0])
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(0.0, 1.0 + jnp.where(bad(t, "K") != 0, jnp.nan, 0.0)),
        f=lambda t, x, u, args: jnp.where((hit > 0) & jnp.isnan(bad(t, "f")), jnp.nan, -u),
        h=lambda t, x, u, args: jnp.where((hit > 0) & jnp.isnan(bad(t, "h")), jnp.nan, x),
    )


@pytest.mark.parametrize(
    ("name", "dt"),
    mostly_thorough(itertools.product("fhK", (None, 0.02)), [("f", 0.02)]),
)
def test_nan_ends_the_run_and_the_error_names_function_time_and_component(name, dt):
    x0, ts = jnp.array([0.5, 2.0, -1.0]), np.linspace(0, 2, 20)  # none of them 0.7 itself
    with pytest.raises(dvax.SolveError) as caught:
        dvax.solve(system(name), x0, 0.0, 2.0, ts=ts, dt=dt, rtol=1e-5)
    message, sol = str(caught.value), caught.value.solution
    assert f"{name} is nan" in message or (name == "K" and "K is" in message)
    assert f"t = {BREAKS}" in message
    if name != "K":
        assert "component (1,)" in message
    # Within one step of the break, and what was saved before it is the solution.
    reached = float(sol.stats["t"])
    assert BREAKS - 0.03 <= reached <= BREAKS + 0.03
    assert np.all(np.isfinite(np.asarray(sol.xs))) and len(sol.ts) == 7
    # −2x while 0 ≤ x ≤ 1, −x below 0; above 1 it is −x − 1.
    np.testing.assert_allclose(np.asarray(sol.xs[:, 0]), 0.5 * np.exp(-2 * sol.ts), atol=1e-3)
    np.testing.assert_allclose(np.asarray(sol.xs[:, 2]), -np.exp(-sol.ts), atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("dt", mostly_thorough([0.02, 0.1], [0.1]))
def test_saved_states_before_a_failure_are_kept(dt):
    ts = np.linspace(0.0, 2.0, 21)
    sol = dvax.solve(system("f"), jnp.array([0.5, 0.8, 0.9]), 0.0, 2.0, ts=ts, dt=dt, throw=False)
    assert sol.result == RESULTS.nonfinite
    np.testing.assert_array_equal(sol.ts, ts[:8])
    np.testing.assert_allclose(sol.xs[:, 2], 0.9 * np.exp(-2 * ts[:8]), atol=1e-2)


@pytest.mark.slow
def test_throw_false_returns_the_failure_as_result():
    sol = dvax.solve(system("f"), jnp.zeros(3), 0.0, 2.0, rtol=1e-3, throw=False)
    assert sol.result == RESULTS.nonfinite
    with pytest.raises(dvax.SolveError, match="NaN"):
        sol.raise_if_failed()


def test_max_steps_failure_has_a_partial_result():
    with pytest.raises(dvax.SolveError, match="max_steps") as caught:
        dvax.solve(system("none"), jnp.ones(3), 0.0, 50.0, ts=[0.0, 1e-6, 50.0], max_steps=16)
    assert 0 < len(caught.value.solution.ts) < 3


@pytest.mark.slow
@pytest.mark.parametrize("gain", mostly_thorough([3.0, 1.0], [3.0]))
def test_law_without_a_solution_fails(gain):
    # F(y) = (1 − gain) y + …: not strongly pseudomonotone, so the closed form proj(−c/a) means
    # nothing.
    for set_ in (dvax.sets.Box(0.0, 0.5), dvax.sets.Ball(0.0, 0.5)):
        problem = dvax.Problem(
            A=dvax.generators.Scalar(-1.0),
            P=dvax.operators.Scaling(1.0),
            K=set_,
            f=lambda t, x, u, args: -u,
            h=lambda t, x, u, args: 1.0 - 2.0 * x + gain * u,
        )
        with pytest.raises(dvax.DvaxError):
            dvax.solve(problem, jnp.zeros(2), 0.0, 1.0)


@pytest.mark.slow
def test_moving_set_that_becomes_empty_ends_the_run():
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(0.0, 0.5 - t),
        f=lambda t, x, u, args: -u,
        h=lambda t, x, u, args: 1.0 - u,
    )
    with pytest.raises(dvax.DvaxError, match=r"empty|K is") as caught:
        dvax.solve(problem, 0.1, 0.0, 1.0, ts=[0.0, 0.25, 1.0])
    solution = getattr(caught.value, "solution", None)
    assert solution is not None and len(solution.ts) == 2


def refused_when_traced(method):
    """The calls that take each invalid traced number."""
    run = lambda t1=1.0, **options: dvax.solve(  # noqa: E731
        system(""), jnp.array([0.5, 2.0, -1.0]), 0.0, t1, method=method, **options
    )
    cases = {
        "t1 before t0": (lambda v: run(v), -1.0),
        "t1 at t0": (lambda v: run(v), 0.0),
        "rtol": (lambda v: run(rtol=v), -1e-3),
        "atol": (lambda v: run(atol=v), -1e-3),
        "both tolerances": (lambda v: run(rtol=v, atol=v), 0.0),
        "ts": (lambda v: run(ts=jnp.stack([v, 0.5 - v])), -0.1),
    }
    if not isinstance(method, dvax.Implicit):
        cases |= {
            "dt": (lambda v: run(dt=v, max_steps=100), -0.1),
            "ts of a run that is not forward": (lambda v: run(v, ts=jnp.stack([0.5 * v, v])), -1.0),
        }
    return cases


TRACED = [
    (name, method)
    for method in ("ETD2RK", "DormandPrince", "ExpRosenbrock", "Picard", "Implicit")
    for name in refused_when_traced(getattr(dvax, method)())
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method"), mostly_thorough(TRACED, [("t1 before t0", "ETD2RK"), ("dt", "ETD2RK")])
)
def test_traced_invalid_numbers_return_nan_and_invalid_number(name, method):
    """Invalid traced arguments give times ∞, states NaN and RESULTS.invalid_number."""
    call, value = refused_when_traced(getattr(dvax, method)())[name]

    def found(v):
        sol = call(v)
        return sol.ts, sol.xs, sol.us, sol.result

    ts, xs, us, result = jax.jit(found)(value)
    assert result == RESULTS.invalid_number
    assert np.all(np.isinf(ts)) and np.all(np.isnan(xs)) and np.all(np.isnan(us))
