"""Events in long steps: stiff semigroups, resets that follow each other closely, laws that saturate."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.evolution.test_second_calls import nothing_is
from tests.once import once

import dvax
from dvax import generators as G


@once
def clock() -> dvax.Problem:
    """x' = 1, with a law that does not act on it."""
    return dvax.Problem(
        A=G.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-9.0, 9.0),
        f=lambda t, x, u, args: 1.0 + 0.0 * u + 0.0 * x, h=lambda t, x, u, args: -u + 0.0 * x,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("omega", [1e3, 1e5, 1e7, 1e9])
def test_state_at_an_event_is_exact_however_fast_the_semigroup_turns(omega):
    """A step is as long as 10⁸ periods, and ends at the event."""
    problem = dvax.Problem(
        A=G.Product(G.Rotation(0.0, omega), G.Scalar(0.0)), P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-9.0, 9.0), control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, args: ((0 * x[0][0], 0 * x[0][1]), 1.0 + 0 * x[1] + 0 * u),
        h=lambda t, x, u, args: jnp.cos(t) - u,
    )  # fmt: skip
    x0 = (jnp.asarray(1.0), jnp.asarray(0.0)), jnp.asarray(0.0)
    constants = dvax.verify(problem, x0, 0.0, 2.0).constants
    level = np.sqrt(0.5)
    for method in (dvax.ETD2RK(), dvax.ETD4RK()):
        sol = dvax.solve(
            problem, x0, 0.0, 2.0, method=method, constants=constants,
            events=[dvax.Event(lambda t, x, u, args: x[1] - level, terminal=True)],
        )  # fmt: skip
        bound = dvax.bound_error(problem, sol, constants)
        t, (real, imaginary) = float(sol.ts[-1]), sol.xs[0]
        assert abs(t - level) <= 1e-12
        error = abs(complex(real[-1], imaginary[-1]) - np.exp(1j * omega * t))
        assert error <= bound.x[-1] <= 1e-7 * max(1.0, omega / 1e7)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [1e-1, 1e-3, 1e-6])
def test_resets_that_follow_each_other_happen_in_the_order_of_time(gap):
    """A machine runs for `gap` of 10⁴, in one step."""
    problem = dvax.Problem(
        A=G.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 9.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, args: jnp.stack([x[1] - 1e-4 * u, 0.0 * x[1]]),
        h=lambda t, x, u, args: x[0],
    )  # fmt: skip
    on, off = (
        dvax.Event(lambda t, x, u, args, at=at: t - at, name=name,
                   reset=lambda t, x, u, args, on=on: x.at[1].set(on))
        for name, at, on in (("on", 5000.0, 1.0), ("off", 5000.0 + gap, 0.0))
    )  # fmt: skip
    for events in ([on, off], [off, on]):
        sol = dvax.solve(problem, jnp.array([1.0, 0.0]), 0.0, 1e4, events=events)
        assert [sol.events.names[k] for k in sol.events.index] == ["on", "off"]
        np.testing.assert_allclose(sol.events.ts, [5000.0, 5000.0 + gap], rtol=1e-15)
        # x' = −10⁻⁴x, but for the gap.
        exact = np.exp(-0.5) * np.exp(-(0.5 - 1e-4 * gap))
        assert abs(float(sol.xs[-1, 0]) - exact - gap * np.exp(-0.5)) <= 1e-5 + 2e-4 * gap


@pytest.mark.slow
def test_event_that_a_reset_prevents_does_not_happen():
    problem = dvax.Problem(
        A=G.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-9.0, 9.0),
        f=lambda t, x, u, args: 1e-4 + 0.0 * u + 0.0 * x, h=lambda t, x, u, args: -u + 0.0 * x,
    )  # fmt: skip
    drain = dvax.Event(lambda t, x, u, args: x - 0.5, reset=lambda t, x, u, args: 0.0 * x)
    alarm = dvax.Event(lambda t, x, u, args: x - 0.5 - 1e-7, terminal=True)
    for events in ([drain, alarm], [alarm, drain]):
        sol = dvax.solve(problem, 0.0, 0.0, 9e3, events=events)
        assert len(sol.events.ts) == 1 and abs(float(sol.xs[-1]) - 0.4) <= 1e-9


@once
def filling() -> dvax.Problem:
    """x' = a − x, and u = min(x, ½)."""
    return dvax.Problem(
        A=G.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, a: a + 0.0 * u, h=lambda t, x, u, a: x,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("method", [None, dvax.ETD4RK()], ids=["default", "ETD4RK"])
def test_time_at_which_the_law_saturates_has_its_derivative(method, terminal):
    """g = u − ½ is 0 behind it. a(1 − e^{−t}) = ½."""
    full = dvax.Event(lambda t, x, u, a: u - 0.5, direction=1, terminal=terminal)

    def time(a, adjoint="reverse"):
        return dvax.solve(
            filling(), 0.0, 0.0, 1.0, a, rtol=1e-10, atol=1e-11, method=method, events=[full],
            max_events=2, adjoint=adjoint,
        ).events.ts[0]  # fmt: skip

    for a in (1.5, 2.0, 3.7):
        assert abs(time(a) + np.log(1.0 - 0.5 / a)) <= 1e-9
        exact = -0.5 / (a * (a - 0.5))
        for derivative in (jax.grad(time)(a), jax.jacfwd(time)(a, "forward")):
            assert abs(derivative - exact) <= 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("gravity", [0.5, 2.0, 9.81])
def test_reset_to_rest_is_no_accumulation(gravity):
    """A body that falls is stopped at half of its height, and falls on."""
    problem = dvax.Problem(
        A=G.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-3.0, 3.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, args: jnp.stack([x[1] + 0.0 * u, -args]),
        h=lambda t, x, u, args: 0.5 * x[1],
    )  # fmt: skip
    stop = dvax.Event(
        lambda t, x, u, args: x[0] - 5.0, direction=-1, reset=lambda t, x, u, args: x.at[1].set(0.0)
    )
    half = np.sqrt(10.0 / gravity)
    sol = dvax.solve(problem, jnp.array([10.0, 0.0]), 0.0, 1.5 * half, gravity, events=[stop])
    np.testing.assert_allclose(sol.events.ts, [half], rtol=1e-9)
    np.testing.assert_allclose(sol.xs[-1], [3.75, -0.5 * gravity * half], rtol=1e-8)


@pytest.mark.slow
def test_events_at_the_last_time_happen():
    jump = dict(reset=lambda t, x, u, args: x + 10.0)
    for function in (lambda t, x, u, args: t - 1.0, lambda t, x, u, args: x - 1.0):
        for options, end in (({}, 1.0), (jump, 11.0), ({"terminal": True}, 1.0)):
            sol = dvax.solve(clock(), 0.0, 0.0, 1.0, events=[dvax.Event(function, **options)])
            assert sol.events.ts.tolist() == [1.0] and abs(float(sol.xs[-1]) - end) <= 1e-12


@pytest.mark.slow
def test_values_that_events_read_are_noticed_when_they_change():
    pump = types.SimpleNamespace(level=0.5, back=0.0)
    event = dvax.Event(
        lambda t, x, u, args: x - pump.level, reset=lambda t, x, u, args: 0.0 * x + pump.back
    )
    for pump.level, pump.back in ((0.5, -1.0), (0.8, -3.0)):
        sol = dvax.solve(clock(), 0.0, 0.0, 1.0, events=[event])
        np.testing.assert_allclose(sol.events.ts[0], pump.level, rtol=1e-12)
        np.testing.assert_allclose(sol.events.xs_after[0], pump.back)


@pytest.mark.slow
def test_events_that_are_written_again_compile_nothing():
    again = lambda: dvax.solve(  # noqa: E731
        clock(), 0.0, 0.0, 1.0, events=[dvax.Event(lambda t, x, u, args: x - 0.25)]
    )
    again()
    with nothing_is("compile", "trace"):
        assert len(again().events.ts) == 1


@pytest.mark.slow
def test_reset_may_return_whole_numbers_but_must_be_finite():
    at_half = lambda reset: dvax.solve(  # noqa: E731
        clock(), 0.0, 0.0, 1.0, events=[dvax.Event(lambda t, x, u, args: x - 0.5, reset=reset)]
    )
    assert abs(float(at_half(lambda t, x, u, args: jnp.array(-1)).xs[-1]) + 0.5) <= 1e-12
    with pytest.raises(dvax.SolveError, match="reset of an event"):
        at_half(lambda t, x, u, args: x * jnp.nan)
    with pytest.raises(dvax.InputError, match="None"):
        dvax.solve(clock(), 0.0, 0.0, 1.0, events=[dvax.Event(lambda t, x, u, args: None)])


@pytest.mark.parametrize("x0", [0.0, 1.0])
def test_reset_that_is_not_finite_is_named_at_the_start_as_well(x0):
    """x' = −1 reaches 0 at t = x0, where the reset is log(−1)."""
    falling = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 9.0),
        f=lambda t, x, u, args: -1.0 + 0.0 * x, h=lambda t, x, u, args: -x,
    )  # fmt: skip
    reset = dvax.Event(lambda t, x, u, args: x, reset=lambda t, x, u, args: jnp.log(x - 1.0))
    with pytest.raises(dvax.SolveError, match="reset of an event returned NaN") as failure:
        dvax.solve(falling, x0, 0.0, 2.0, events=[reset])
    assert failure.value.solution.result == dvax.RESULTS.event_nonfinite
    np.testing.assert_allclose(failure.value.solution.stats["t"], x0, atol=1e-9)
