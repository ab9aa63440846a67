"""Right-hand sides whose rounding error is as large as the tolerance."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from tests.once import once
from tests.selection import mostly_thorough

import dvax
from dvax.evolution.results import RESULTS

LARGE = jnp.asarray(1e9)


@once
def problem():
    # Added to 10⁹ and taken away again, a rate keeps multiples of 1.2e-7. As an argument, since a
    # compiler cancels constants.
    return dvax.Problem(
        A=dvax.generators.Zero(),
        f=lambda t, x, u, large: (jnp.cos(5 * t) + u + large) - large,
        h=lambda t, x, u, large: jnp.sin(3 * t) * jnp.ones_like(x),
        K=dvax.sets.Box(0.0, 0.5),
        P=dvax.operators.Scaling(1.0),
    )


def run(atol, throw=False):
    return dvax.solve(
        problem(), jnp.zeros(1), 0.0, 3.0, LARGE, rtol=0.0, atol=atol, method=dvax.ETD4RK(),
        max_steps=200_000, throw=throw,
    )  # fmt: skip


def exact(t):
    kinks = np.array([1, 5, 6, 12, 13, 17]) * np.pi / 18
    share = scipy.integrate.quad(
        lambda t: min(max(np.sin(3 * t), 0.0), 0.5), 0.0, t, points=kinks, epsabs=1e-13
    )
    return np.sin(5 * t) / 5 + share[0]


@pytest.mark.slow
@pytest.mark.parametrize("atol", [1e-6, 2.5e-7, 2e-7])
def test_steps_are_not_reduced_for_errors_dominated_by_rounding(atol):
    found = run(atol)
    assert found.result == RESULTS.successful
    # The trajectory of a system disturbed by twice the tolerance; here the solution itself moves by
    # no more than the disturbance.
    assert abs(float(found.xs[-1, 0]) - exact(3.0)) <= 2 * atol
    # A defect of order 4 without rounding takes about 900 of them at the smallest tolerance.
    assert int(found.stats["steps"]) < 10_000


@pytest.mark.slow
def test_tolerance_below_rounding_fails_early_and_the_suggested_one_succeeds():
    # Roundoff is random, and so is the step at which the controller has seen enough of it.
    runs = [run(atol) for atol in np.linspace(1.9e-8, 2.1e-8, 15)]
    assert all(found.result == RESULTS.step_too_small for found in runs)
    assert np.median([int(found.stats["steps"]) for found in runs]) < 10_000
    with pytest.raises(dvax.SolveError, match="roundoff of terms that cancel") as told:
        run(2e-8, throw=True)
    # What is named as a fix helps.
    (named,) = [fix.value for fix in told.value.fixes if fix.option == "atol"]
    assert 2e-8 < float(named) < 1e-5
    assert run(float(named)).result == RESULTS.successful


@pytest.mark.slow
def test_trials_of_longer_steps_become_rare_without_success():
    # A forcing of one length throughout: every step is as long as the tolerance lets it be.
    turning = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        f=lambda t, x, u, args: jnp.stack([jnp.cos(3 * t), jnp.sin(3 * t)]) + 0.0 * u,
        h=lambda t, x, u, args: 0.0 * x - u,
        K=dvax.sets.Box(-9.0, 9.0),
        P=dvax.operators.Scaling(1.0),
    )
    stats = dvax.solve(
        turning, jnp.zeros(2), 0.0, 20.0, rtol=0.0, atol=1e-4, method=dvax.ETD2RK(),
        max_steps=50_000,
    ).stats  # fmt: skip
    # The k-th comes 128·2ᵏ steps after the one before it; a few more belong to the first steps.
    trials = np.log2(1 + int(stats["steps"]) / 128)
    assert int(stats["steps"]) > 10_000
    assert int(stats["rejected"]) <= trials + 4


def test_start_far_from_zero_costs_no_steps_with_steep_f():
    # Between neighbours of t at 4·10⁵ this drive moves by 10⁻⁷, more than the tolerance on f.
    steep = dvax.Problem(
        A=dvax.generators.Scalar(-90.0),
        f=lambda t, x, u, start: 2.0 * u,
        h=lambda t, x, u, start: 150.0 * jnp.sin(13.0 * (t - start)) - 500.0 * x,
        K=dvax.sets.Box(-0.5, 0.5),
        P=dvax.operators.Scaling(1.0),
    )
    runs = [
        dvax.solve(
            steep, jnp.zeros(1), t0, t0 + 0.125, t0, rtol=1e-6, atol=1e-9, method=dvax.ETD2RK()
        )
        for t0 in (0.0, -(2.0**19))
    ]
    near, far = (int(run.stats["steps"]) for run in runs)
    assert far <= 1.05 * near
    assert abs(float(runs[0].xs[-1, 0] - runs[1].xs[-1, 0])) <= 1e-9


FAR = dvax.Problem(
    A=dvax.generators.Scalar(-2.4), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-0.7, 0.4),
    f=lambda t, x, u, args: 0.5 * u,
    h=lambda t, x, u, args: args["q"] * jnp.sin(2.8 * (t - args["t0"])) - args["g"] * x - 3.0,
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("steep", [1e2, 1e3, 1e4])
@pytest.mark.parametrize("method", [dvax.ExpRosenbrock(), dvax.DormandPrince()])
def test_start_far_from_zero_with_rounding_of_ten_tolerances_succeeds(method, steep):
    """Rounding of t changes f by about `steep` ulp(t₀): up to some ten tolerances."""

    def end(t0, **options):
        args = {"q": jnp.asarray(steep), "g": jnp.asarray(10.0 * steep), "t0": jnp.asarray(t0)}
        ts = np.array([t0 + 0.5, t0 + 1.0])
        return dvax.solve(FAR, 0.0, t0, t0 + 1.0, args, ts, method=method, **options).xs

    truth = np.asarray(end(0.0, rtol=1e-9, atol=1e-12))
    for t0 in (2.0**13, -(2.0**17), 2.0**20):
        try:
            found = np.asarray(end(t0))
        except dvax.SolveError as error:
            # Beyond a thousand tolerances it may be refused, with what to do.
            assert steep * np.spacing(abs(t0)) > 1e-6 and "Count time from the start" in str(error)
            continue
        assert np.abs(found - truth).max() <= 10 * (1e-9 + 1e-6 * np.abs(truth).max()), t0


@pytest.mark.slow
@pytest.mark.parametrize("steep", mostly_thorough([1e3, 1e4, 1e5, 1e6], [1e5]))
def test_rounding_of_t_that_a_stiff_law_forgets_stops_no_run(steep):
    """Wherever a run ends: its last step, and with it all steps, are others."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        q, t0, span = steep * rng.uniform(0.3, 1.0), rng.uniform(1e4, 3e5), rng.uniform(0.5, 2.0)
        args = {"q": jnp.asarray(q), "g": jnp.asarray(30.0 * steep), "t0": jnp.asarray(t0)}
        ts = t0 + span * np.array([0.5, 1.0])
        method = dvax.ExpRosenbrock()
        found = dvax.solve(FAR, 1e-3, t0, ts[1], args, ts, method=method, throw=False)
        assert found.result == RESULTS.successful, (q, t0, span)
        local = {**args, "t0": jnp.asarray(0.0)}
        truth = dvax.solve(
            FAR, 1e-3, 0.0, ts[1] - t0, local, ts - t0, method=method, rtol=1e-8, atol=1e-11
        )
        error = np.abs(np.asarray(found.xs - truth.xs)).max()
        assert error <= 10 * (1e-9 + 1e-6 * np.abs(truth.xs).max()), (q, t0, span)


@once
def oscillator():
    return dvax.Problem(
        A=dvax.generators.Dense(jnp.array([[0.0, 1.0], [-1.0, 0.0]])),
        f=lambda t, x, u, args: 0.0 * x,
        h=lambda t, x, u, args: 0.0 * u,
        K=dvax.sets.Box(-1.0, 1.0),
        P=dvax.operators.Scaling(1.0),
    )


@pytest.mark.slow
@pytest.mark.parametrize("dt_max", [0.1, 0.13, 0.7])
def test_lengths_of_many_steps_add_up_to_the_time(dt_max):
    """Steps of one length share their φ-functions; rounded ends of steps at 0.1 would move the phase by
    2e-8 within this time."""
    t1 = 1e4
    x = dvax.solve(
        oscillator(), jnp.array([1.0, 0.0]), 0.0, t1, dt_max=dt_max, method=dvax.ETD2RK(),
        max_steps=200_000,
    ).xs[-1]  # fmt: skip
    assert np.linalg.norm(x - np.array([np.cos(t1), -np.sin(t1)])) < 1e-11
