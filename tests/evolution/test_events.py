"""Events: recorded, terminal and with resets, against closed forms, with derivatives."""

from typing import Any

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from tests.closed_forms import C1_KINKS, c1
from tests.once import once
from tests.selection import mostly_thorough

import dvax
from dvax import _tree
from dvax.evolution.event_search import Walk, arrives, next_event

X, V = 0, 1


def component(k: int, level: float = 0.0, **options: Any) -> dvax.Event:
    return dvax.Event(lambda t, x, u, args: x[k] - level, **options)


# A rotation of angular velocity args, x = cos(args t + φ), with a law that does not act on it.


@once
def rotation() -> dvax.Problem:
    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, args: args * jnp.stack([x[V] + 0.0 * u, -x[X]]),
        h=lambda t, x, u, args: -u,
    )  # fmt: skip


ZERO = component(X)
METHODS = {
    "ETD2RK": dvax.ETD2RK(),
    "ETD4RK": dvax.ETD4RK(),
    "DormandPrince": dvax.DormandPrince(),
    "ExpRosenbrock": dvax.ExpRosenbrock(),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", mostly_thorough(METHODS, ["DormandPrince"]))
def test_event_times_and_states_of_an_oscillator_are_exact_to_the_tolerance(method):
    omega = 3.0
    exact = (np.arange(10) + 0.5) * np.pi / omega
    for rtol in (1e-3, 1e-5) if method == "ETD2RK" else (1e-3, 1e-6, 1e-9):
        sol = dvax.solve(
            rotation(), jnp.array([1.0, 0.0]), 0.0, 10.0, jnp.asarray(omega), rtol=rtol, atol=rtol,
            events=[ZERO], method=METHODS[method],
        )  # fmt: skip
        assert len(sol.events.ts) == len(exact)
        assert np.abs(sol.events.ts - exact).max() <= 5 * rtol
        assert np.abs(sol.events.xs[:, X]).max() <= 1e-12
        assert np.abs(sol.events.xs[:, V] + np.sin(omega * exact)).max() <= 5 * rtol
        assert not np.any(sol.events.index)


RISING = component(X, direction=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", mostly_thorough(["DormandPrince", "ExpRosenbrock"], ["ExpRosenbrock"])
)
@settings(deadline=None, max_examples=40)
@given(omega=st.floats(0.1, 40.0), phase=st.floats(-3.0, 3.0))
def test_no_event_of_an_oscillator_is_missed_at_any_frequency(method, omega, phase):
    # ExpRosenbrock solves this system exactly, with any number of periods in a step.
    x0 = jnp.array([np.cos(phase), -np.sin(phase)])
    events = [ZERO, RISING]
    sol = dvax.solve(
        rotation(), x0, 0.0, 10.0, jnp.asarray(omega), events=events, method=METHODS[method]
    )
    turns = (np.arange(-10, 400) + 0.5) * np.pi
    exact = (turns - phase) / omega
    near = np.min(np.abs(np.stack([exact, exact - 10.0])))  # at an end it is rounding that decides
    exact = exact[(exact > 0.0) & (exact < 10.0)]
    for index, times in ((0, exact), (1, exact[np.sin(omega * exact + phase) < 0])):
        found = np.asarray(sol.events.ts)[np.asarray(sol.events.index) == index]
        if near > 1e-4:
            assert len(found) == len(times)
            np.testing.assert_allclose(found, times, atol=1e-3 / omega)


# A ball of gravity args above a floor; the law passes gravity on: u = proj_[0, 9](args).


@once
def ball() -> dvax.Problem:
    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 9.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, args: jnp.stack([x[V], -u]),
        h=lambda t, x, u, args: args[0] + 0.0 * x[X],
    )  # fmt: skip


IMPACT = component(
    X, direction=-1, name="impact",
    reset=lambda t, x, u, args: jnp.stack([x[X], -args[1] * x[V]]),
)  # fmt: skip


def bounce(height, gravity, restitution, **options):
    x0, t1 = jnp.stack([height, 0.0 * height]), options.pop("t1", 2.6)
    return dvax.solve(
        ball(), x0, 0.0, t1, (gravity, restitution),
        **(dict(events=[IMPACT], method=dvax.DormandPrince(), max_events=16) | options),
    )  # fmt: skip


def bounced(height, gravity, restitution):
    """Return, in closed form, the times of the turning points and impacts up to 2.6, the heights of the
    turning points, the speeds of the impacts, and the states at 1.7 and at 2.6."""
    c = restitution
    fall = jnp.sqrt(2 * height / gravity)
    speed = gravity * fall
    times = [0 * fall, fall, fall * (1 + c), fall * (1 + 2 * c), fall * (1 + 2 * c + c**2)]
    times.append(fall * (1 + 2 * c + 2 * c**2))
    heights = [height, height * c**2, height * c**4]
    speeds = [-speed, -speed * c, -speed * c**2]

    def flight(start, v, t):
        return [v * (t - start) - 0.5 * gravity * (t - start) ** 2, v - gravity * (t - start)]

    saved = flight(times[1], speed * c, 1.7) + flight(times[5], speed * c**3, 2.6)
    return jnp.stack([*times, *heights, *speeds, *saved])


BALL = (jnp.asarray(1.0), jnp.asarray(2.0), jnp.asarray(0.5))


TOP = component(V, direction=-1, name="top")


def summary(adjoint):
    def of(*parameters):
        sol = bounce(*parameters, adjoint=adjoint, events=[IMPACT, TOP], ts=[1.7, 2.6])
        events = sol.events
        heights, speeds = events.xs[0:6:2, X], events.xs[1:6:2, V]
        return jnp.concatenate([events.ts[:6], heights, speeds, sol.xs.ravel()])

    return of


def test_bouncing_ball_has_the_events_of_the_closed_form():
    np.testing.assert_allclose(summary("reverse")(*BALL), bounced(*BALL), atol=1e-9)
    sol = bounce(*BALL)
    np.testing.assert_allclose(sol.events.xs_after[:, V], -0.5 * sol.events.xs[:, V], rtol=1e-12)
    assert sol.result == dvax.RESULTS.successful
    assert sol.events.of("impact").ts.shape == (3,)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("adjoint", "jacobian"),
    [
        pytest.param("reverse", jax.jacrev, marks=pytest.mark.thorough),
        ("forward", jax.jacfwd),
    ],
)
def test_bouncing_ball_has_the_derivatives_of_the_closed_form(adjoint, jacobian):
    found = jacobian(summary(adjoint), (0, 1, 2))(*BALL)
    for ours, exact in zip(found, jax.jacfwd(bounced, (0, 1, 2))(*BALL), strict=True):
        np.testing.assert_allclose(ours, exact, atol=1e-8)


@pytest.mark.thorough
def test_second_derivatives_of_event_times_and_of_states_behind_resets_are_exact():
    # At x = 0 the velocity turns around and shrinks: half a turn from one event to the next.
    back = component(X, direction=-1, reset=lambda t, x, u, args: jnp.stack([x[X], -0.8 * x[V]]))

    def run(omega):
        sol = dvax.solve(
            rotation(), jnp.array([1.0, 0.0]), 0.0, 4.0, omega, events=[back], max_events=8,
            method=dvax.DormandPrince(), adjoint="forward", rtol=1e-10, atol=1e-10,
        )  # fmt: skip
        return jnp.stack([sol.events.ts[1], sol.xs[-1, X]])

    def exact(omega):
        count = 4  # impacts up to t = 4 for ω = 3
        return jnp.stack([1.5 * jnp.pi / omega, 0.8**count * jnp.cos(4.0 * omega + count * jnp.pi)])

    omega = jnp.asarray(3.0)
    np.testing.assert_allclose(run(omega), exact(omega), atol=1e-8)
    second = lambda fn: jax.jacfwd(jax.jacfwd(fn))(omega)  # noqa: E731
    np.testing.assert_allclose(second(run), second(exact), rtol=1e-6)


@pytest.mark.thorough
def test_bouncing_ball_under_jit_and_vmap_agrees_with_single_solves():
    heights = jnp.array([1.0, 1.3, 1.6])
    batch = jax.jit(jax.vmap(lambda h: bounce(h, *BALL[1:]).events))(heights)
    for k, height in enumerate(heights):
        alone = bounce(height, *BALL[1:]).events
        count = len(alone.ts)
        np.testing.assert_allclose(batch.ts[k, :count], alone.ts, atol=1e-9)
        np.testing.assert_allclose(batch.xs_after[k, :count], alone.xs_after, atol=1e-9)
        assert np.all(np.isinf(batch.ts[k, count:])) and np.all(batch.index[k, count:] == -1)
        assert np.all(np.isnan(batch.xs[k, count:]))


@pytest.mark.thorough
def test_dense_output_of_a_bouncing_ball_is_that_of_each_flight():
    sol = bounce(*BALL, dense=True, max_steps=200, ts=[0.5, 1.5, 2.25])
    flight = lambda t: (t - 1.0) - (t - 1.0) ** 2  # noqa: E731
    assert sol.xs[1, X] == pytest.approx(flight(1.5), abs=1e-8)
    for t in (1.1, 1.5, 1.9):
        assert sol.evaluate(t)[0][X] == pytest.approx(flight(t), abs=1e-8)


@pytest.mark.thorough
@pytest.mark.parametrize("restitution", [0.5, 0.1, 1e-3])
def test_events_that_accumulate_end_the_run_with_a_message(restitution):
    given = *BALL[:2], jnp.asarray(restitution)
    with pytest.raises(dvax.SolveError, match="accumulate") as caught:
        bounce(*given, max_events=100, t1=4.0)
    solution = caught.value.solution
    assert solution.result == dvax.RESULTS.max_events
    assert solution.events.ts[-1] <= 3.0 + 1e-6  # the sum of all flights
    assert any(fix.option == "max_events" for fix in caught.value.fixes)


@pytest.mark.slow
@pytest.mark.parametrize("height", [0.3, 1.0, 1.7])
def test_a_ball_that_a_reset_brings_to_rest_falls_on(height):
    """The event has happened, whatever the sign of the roundoff of g behind it."""
    gravity = 2.0
    sol = bounce(height, gravity, jnp.asarray(0.0), max_events=100, t1=4.0)
    fall = np.sqrt(2 * height / gravity)
    np.testing.assert_allclose(sol.events.ts, [fall], rtol=1e-9)
    assert float(sol.xs[-1, X]) == pytest.approx(-0.5 * gravity * (4.0 - fall) ** 2, rel=1e-8)


@pytest.mark.thorough
def test_more_events_than_there_is_room_for_end_the_run():
    sol = bounce(*BALL, max_events=2, throw=False)
    assert sol.result == dvax.RESULTS.max_events and len(sol.events.ts) == 2


# A clock: x = t, so that events are those of functions of t.


@once
def clock() -> dvax.Problem:
    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 2.0),
        f=lambda t, x, u, args: 1.0 + 0.0 * x, h=lambda t, x, u, args: x,
    )  # fmt: skip


def tick(events, args=None, t1=10.0, **options):
    return dvax.solve(clock(), jnp.asarray(0.0), 0.0, t1, args, events=events, **options)


DIP = dvax.Event(lambda t, x, u, args: args[1] * ((x - args[0]) ** 2 - args[2]))


@pytest.mark.thorough
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("place", [0.9, 5.0, 9.3])
def test_two_zeros_in_one_step_are_two_events(sign, place):
    sol = tick([DIP], (place, sign, 1e-2))
    np.testing.assert_allclose(sol.events.ts, [place - 0.1, place + 0.1], atol=1e-9)
    assert sol.stats["steps"] < 15


@pytest.mark.thorough
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("depth", "count"), [(0.0, 1), (1e-7, 1), (-1e-7, 1), (-1e-2, 0)])
def test_function_that_touches_zero_to_the_tolerance_is_one_event(sign, depth, count):
    sol = tick([DIP], (5.0, sign, depth))
    assert len(sol.events.ts) == count
    # The extremum of a function with the error ε is uncertain by √ε.
    np.testing.assert_allclose(sol.events.ts, [5.0] * count, atol=1e-3)


@pytest.mark.thorough
def test_time_of_a_function_that_touches_zero_has_no_derivative():
    first = lambda place: tick([DIP], (place, 1.0, 0.0)).events.ts[0]  # noqa: E731
    assert np.isnan(jax.grad(first)(5.0))


@pytest.mark.thorough
def test_function_that_is_zero_on_an_interval_is_one_event():
    held = dvax.Event(lambda t, x, u, args: jnp.maximum(x - 5, 0.0) - jnp.maximum(3 - x, 0.0))
    ever = dvax.Event(lambda t, x, u, args: 0.0 * x)
    ended = dvax.Event(held.function, terminal=True)
    sol = tick([held, ever])
    assert sol.events.index.tolist() == [1, 0]
    np.testing.assert_allclose(sol.events.ts, [0.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(tick([ended]).ts, [3.0], atol=1e-6)


@pytest.mark.thorough
def test_function_that_jumps_over_zero_is_an_event():
    jump = dvax.Event(lambda t, x, u, args: jnp.where(x < 4.0, -1.0, 2.0))
    np.testing.assert_allclose(tick([jump]).events.ts, [4.0], atol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(("direction", "count"), [(0, 1), (1, 1), (-1, 0)])
def test_event_at_the_start_happens_if_its_function_leaves_in_its_direction(direction, count):
    start = dvax.Event(lambda t, x, u, args: x, direction=direction)
    sol = tick([start])
    assert sol.events.ts.tolist() == [0.0] * count
    reset = dvax.Event(
        lambda t, x, u, args: x, direction=direction, reset=lambda t, x, u, args: x + 1
    )
    assert tick([reset]).xs[-1] == pytest.approx(10.0 + count, abs=1e-9)


@pytest.mark.thorough
def test_terminal_event_at_the_start_ends_the_run_there():
    sol = tick([dvax.Event(lambda t, x, u, args: x, terminal=True)])
    assert sol.ts.tolist() == [0.0] and sol.stats["steps"] == 0
    assert sol.result == dvax.RESULTS.terminal_event


@pytest.mark.thorough
def test_events_at_one_time_happen_in_their_order():
    # At x = 1, at the same time: x ↦ 2x and x ↦ x + 3.
    double = dvax.Event(
        lambda t, x, u, args: x - 1.0, direction=1, reset=lambda t, x, u, args: 2 * x
    )
    add = dvax.Event(lambda t, x, u, args: t - 1.0, reset=lambda t, x, u, args: x + 3.0)
    watch = dvax.Event(lambda t, x, u, args: 3.0 * (t - 1.0))
    for events, states in (
        ([double, add, watch], [(1.0, 2.0), (2.0, 5.0), (5.0, 5.0)]),
        ([watch, add, double], [(1.0, 1.0), (1.0, 4.0), (4.0, 8.0)]),
    ):
        sol = tick(events, t1=2.0)
        assert sol.events.index.tolist() == [0, 1, 2]
        np.testing.assert_allclose(sol.events.ts, [1.0] * 3, atol=1e-9)
        found = np.stack([sol.events.xs, sol.events.xs_after], axis=1)
        np.testing.assert_allclose(found, states, atol=1e-8)
        assert sol.xs[-1] == pytest.approx(states[-1][1] + 1.0, abs=1e-8)


AT_THREE = dvax.Event(lambda t, x, u, args: x - args, terminal=True)


@pytest.mark.thorough
def test_terminal_event_ends_the_run_at_its_time():
    sol = tick([AT_THREE], 3.0)
    assert sol.result == dvax.RESULTS.terminal_event
    np.testing.assert_allclose([sol.ts[-1], sol.xs[-1], sol.events.ts[0]], [3.0] * 3, atol=1e-9)
    saved = tick([AT_THREE], 3.0, ts=[1.0, 2.0, 4.0])
    np.testing.assert_allclose(saved.ts, [1.0, 2.0])
    traced = lambda level: tick([AT_THREE], level, ts=[1.0, 2.0, 4.0], max_events=4)  # noqa: E731
    ts, xs = jax.jit(lambda level: (traced(level).ts, traced(level).xs))(3.0)
    np.testing.assert_allclose(xs, [1.0, 2.0, np.nan], atol=1e-9)
    assert ts[2] == np.inf


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("adjoint", "derivative"), [("reverse", jax.grad), ("forward", jax.jacfwd)]
)
def test_end_of_a_run_at_a_terminal_event_has_the_derivative_of_its_time(adjoint, derivative):
    def end(speed, level):
        # x = 2 − e^{−speed t} reaches the level at t = −log(2 − level)/speed.
        problem = dvax.Problem(
            A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 9.0),
            f=lambda t, x, u, args: args * (2.0 - u), h=lambda t, x, u, args: x,
        )  # fmt: skip
        # The level is a closure variable, not an entry of args.
        event = dvax.Event(lambda t, x, u, args: u - level, terminal=True)
        sol = dvax.solve(
            problem, jnp.asarray(1.0), 0.0, 9.0, speed, events=[event], adjoint=adjoint, max_events=4,
            method=dvax.DormandPrince(), rtol=1e-8,
        )  # fmt: skip
        return sol.ts[-1] * sol.xs[-1] ** 2

    exact = lambda speed, level: -jnp.log(2 - level) / speed * level**2  # noqa: E731
    at = jnp.asarray(0.7), jnp.asarray(1.6)
    assert float(end(*at)) == pytest.approx(float(exact(*at)), rel=1e-6)
    np.testing.assert_allclose(
        derivative(end, (0, 1))(*at), jax.grad(exact, (0, 1))(*at), rtol=1e-6
    )


@pytest.mark.thorough
def test_reset_switches_a_parameter_that_is_a_component_of_the_state():
    # A thermostat: x' = q − x, with q = 0 from x = 3/2 on and q = 2 from x = 1/2 on.
    problem = dvax.Problem(
        A=dvax.generators.Product(dvax.generators.Scalar(-1.0), dvax.generators.Zero()),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, args: (x[1] + 0.0 * u, 0.0 * x[1]), h=lambda t, x, u, args: -u,
    )  # fmt: skip
    heat = dvax.Event(
        lambda t, x, u, args: x[0] - 0.5,
        direction=-1,
        reset=lambda t, x, u, args: (x[0], 0 * x[1] + 2),
    )
    rest = dvax.Event(
        lambda t, x, u, args: x[0] - 1.5, direction=1, reset=lambda t, x, u, args: (x[0], 0 * x[1])
    )
    for dtype, tol in ((jnp.float64, 1e-7), (jnp.float32, 1e-3)):
        x0 = jnp.asarray(0.0, dtype), jnp.asarray(2.0, dtype)
        sol = dvax.solve(problem, x0, 0.0, 5.0, rtol=0.1 * tol, events=[heat, rest])
        assert sol.events.index.tolist() == [1, 0, 1, 0]
        exact = np.log(4.0) + np.log(3.0) * np.arange(4)
        np.testing.assert_allclose(np.asarray(sol.events.ts, float), exact, atol=tol)


@pytest.mark.slow
def test_time_at_which_a_law_saturates_has_its_derivative_whatever_the_steps():
    """A heater with a PI law: the event is at a kink, and the step behind it may be of any length."""
    want = lambda x: 6.0 * (20.0 - x[0]) + x[1]  # noqa: E731
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 15.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, k: jnp.stack(
            [0.5 * (k * (2.0 - x[0]) + u), 1.5 * (20.0 - x[0]) + 2.0 * (u - want(x))]
        ),
        h=lambda t, x, u, k: want(x),
    )  # fmt: skip
    full = dvax.Event(lambda t, x, u, k: want(x) - 15.0, direction=1)

    def time(k, t1):
        x0 = jnp.array([18.0, 0.0])
        return dvax.solve(problem, x0, 0.0, t1, k, rtol=1e-7, events=[full]).events.ts[0]

    derivative = jax.jit(jax.grad(time))
    ends = np.append(np.linspace(2.0, 10.0, 81), 3.7)
    exact = float(time(1.0 + 1e-4, 2.0) - time(1.0 - 1e-4, 2.0)) / 2e-4
    np.testing.assert_allclose([float(derivative(1.0, t1)) for t1 in ends], exact, rtol=1e-5)


@pytest.mark.thorough
def test_event_of_a_saturated_response_is_the_change_of_regime():
    case = c1()
    reached = dvax.Event(lambda t, x, u, args: 0.5 - u, name="leaves its upper bound")
    lost = dvax.Event(lambda t, x, u, args: u, name="reaches 0")
    sol = dvax.solve(
        case.problem, jnp.asarray(case.x0), 0.0, case.t1, case.args, rtol=1e-9, atol=1e-9,
        method=dvax.DormandPrince(), events=[reached, lost], dense=True, max_steps=2000,
    )  # fmt: skip
    # u = ½ from the start: the function is zero there, and leaves zero at the kink without an event.
    assert sol.events.index.tolist() == [0, 1]
    assert sol.events.ts[0] == 0.0
    assert sol.events.ts[1] == pytest.approx(C1_KINKS[1], abs=1e-6)
    assert sol.events.ts[1] == pytest.approx(sol.regimes().times[2], abs=1e-4)


@pytest.mark.thorough
def test_events_that_are_only_recorded_change_neither_steps_nor_bounds():
    case = c1()
    options: dict[str, Any] = dict(
        args=case.args, ts=[0.5, 1.0, 2.0], constants=case.constants, rtol=1e-5, atol=1e-5
    )
    x0 = jnp.asarray(case.x0)
    plain = dvax.solve(case.problem, x0, 0.0, 2.0, **options)
    event = dvax.Event(lambda t, x, u, args: x - 0.25)
    watched = dvax.solve(case.problem, x0, 0.0, 2.0, **options, events=[event])
    assert len(watched.events.ts) == 1
    assert watched.stats["steps"] == plain.stats["steps"]
    assert watched.stats["rejected"] == plain.stats["rejected"]
    np.testing.assert_allclose(watched.xs, plain.xs, rtol=1e-13)
    bounds = [dvax.bound_error(case.problem, sol, case.constants) for sol in (plain, watched)]
    np.testing.assert_allclose(bounds[0].x, bounds[1].x, rtol=1e-9)
    assert bounds[0].status == bounds[1].status


@pytest.mark.thorough
def test_bound_of_a_run_that_an_event_ended_holds_at_its_time_and_resets_have_none():
    case = c1()
    x0 = jnp.asarray(case.x0)
    solve = lambda **options: dvax.solve(  # noqa: E731
        case.problem, x0, 0.0, 2.0, case.args, constants=case.constants, rtol=1e-4,
        events=[dvax.Event(lambda t, x, u, args: x - 0.25, **options)],
    )  # fmt: skip
    ended = solve(terminal=True)
    bound = dvax.bound_error(case.problem, ended, case.constants)
    error = abs(float(ended.xs[-1]) - float(case.exact(float(ended.ts[-1]))[0]))
    assert error <= bound.x[-1] <= 1e-2
    with pytest.raises(dvax.InputError, match="reset"):
        dvax.bound_error(case.problem, solve(reset=lambda t, x, u, args: x), case.constants)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dvax.Event(lambda t, x, u, args: x, direction=2), "direction"),
        (lambda: tick([ZERO], dt=0.1), "dt"),
        (lambda: tick([ZERO], method=dvax.Picard()), "method"),
        (lambda: tick([ZERO], max_events=0), "max_events"),
        (lambda: tick([dvax.Event(lambda t, x, u, args: x + jnp.zeros(2))]), "one number"),
        (lambda: tick([dvax.Event(lambda t, x: x)]), "function"),
        (lambda: tick([dvax.Event(lambda t, x, u, args: x > 0)]), "bool"),
        (lambda: tick([component(X, reset=lambda t, x, u, args: x)]), "function"),
        (
            lambda: tick([dvax.Event(lambda t, x, u, args: x, reset=lambda t, x, u, args: (x, x))]),
            "whole state",
        ),
    ],
)
def test_invalid_events_are_refused_with_their_names(make, message):
    with pytest.raises(dvax.InputError, match=message):
        make()


@pytest.mark.thorough
def test_event_function_that_is_not_a_number_ends_the_run():
    with pytest.raises(dvax.SolveError) as caught:
        tick([dvax.Event(lambda t, x, u, args: jnp.sqrt(1.0 - x))])
    assert caught.value.solution.result == dvax.RESULTS.event_nonfinite


@once
def stuck() -> dvax.Problem:
    """A motor that friction, smooth in a layer of width args, brings to rest."""
    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, args: jnp.stack([x[V], -0.9 * x[X] - 20.0 * u]),
        h=lambda t, x, u, args: x[V] / args,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("method", [dvax.ExpRosenbrock(), dvax.ETD4RK()], ids=["rosenbrock", "etd"])
def test_function_that_decays_to_its_rounding_errors_has_few_events(method):
    """It is zero up to rounding, in places with thousands of changes of sign in a step."""
    for layer in (1.0, 0.02):
        for tol in (1e-5, 1e-7, 1e-9):
            problem, x0 = stuck(), jnp.array([0.4, 0.0])
            options = dict(rtol=tol, atol=1e-2 * tol, method=method)
            sol = dvax.solve(problem, x0, 0.0, 80.0, layer, events=[component(V)], **options)
            plain = dvax.solve(problem, x0, 0.0, 80.0, layer, **options)
            # It starts at rest, and creeps to zero without a reversal.
            assert len(sol.events.ts) <= 3
            assert int(sol.stats["steps"]) == int(plain.stats["steps"])


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 1e-12, 1e9])
@pytest.mark.parametrize("decay", [0.3, 1.5])
def test_every_zero_of_a_damped_oscillation_above_its_rounding_is_found(scale, decay):
    """In any unit of the event function: x = e^{−dt} cos t, whose zeros are those of cos t. The method
    is exact for it."""
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, args: jnp.stack([-args * x[0] - x[1] + 0.0 * u, x[0] - args * x[1]]),
        h=lambda t, x, u, args: -u,
    )  # fmt: skip
    event = dvax.Event(lambda t, x, u, args: scale * x[0])
    sol = dvax.solve(problem, jnp.array([1.0, 0.0]), 0.0, 40.0, decay, rtol=1e-8, events=[event])
    exact = (np.arange(13) + 0.5) * np.pi
    found, count = np.asarray(sol.events.ts), int(np.sum(exact < 27.0 / decay))
    assert count <= len(found) <= 13
    assert np.abs(found[:count] - exact[:count]).max() <= 1e-6


# x‴ = a from rest: x′ is zero at the start with zero slope. The time of that zero has no derivative.


@once
def from_rest() -> dvax.Problem:
    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, args: jnp.stack([x[1], x[2], args + 0.0 * u]),
        h=lambda t, x, u, args: -x[0],
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["reverse", "forward"])
def test_a_time_without_a_derivative_leaves_those_of_other_results(adjoint):
    rest, passed = component(1, name="rest"), component(0, 1 / 6, name="passed")
    jacobian = jax.jacrev if adjoint == "reverse" else jax.jacfwd

    def results(a):
        sol = dvax.solve(
            from_rest(), jnp.zeros(3), 0.0, 2.0, a, events=[rest, passed], adjoint=adjoint
        )
        return sol.events.ts[0], sol.events.ts[1], sol.events.xs[1, 2], sol.xs[-1, 0]

    first, second, speed, last = jacobian(results)(1.0)
    assert np.isnan(first)
    # t = a^{−1/3}, x″ = at there, and x(2) = 8a/6.
    np.testing.assert_allclose([second, speed, last], [-1 / 3, 2 / 3, 4 / 3], rtol=1e-6)


# The search by itself: polynomials with given roots in a step of length 1.


@jax.jit
def count_zeros(roots):
    def values(theta):
        return jnp.prod(theta - roots)[None]

    def at(theta):
        return jax.jvp(values, (theta,), (jnp.ones_like(theta),))

    directions, touch, shortest = jnp.zeros(1, int), jnp.full(1, 1e-13), jnp.asarray(1e-9)
    noise = jnp.zeros(1)

    def one(carry):
        walk, count = carry
        walk = next_event(walk, at, directions, touch, noise, shortest)
        count = count + walk.found.astype(int)
        return _tree.where(walk.found, walk.onward(shortest), walk), count

    zero = jnp.asarray(0.0)
    # As in a run, which begins with a short step.
    start = Walk.at(zero, *at(zero), jnp.asarray(1e-3), shortest), jnp.asarray(0)
    return jax.lax.while_loop(lambda carry: ~carry[0].ended, one, start)[1]


@settings(deadline=None, max_examples=200)
@given(
    roots=st.lists(st.integers(1, 99), min_size=5, max_size=5, unique=True),
    inside=st.integers(0, 5),
)
def test_search_finds_every_root_of_a_polynomial(roots, inside):
    shifted = [r / 100 + (0.0 if k < inside else 1.5) for k, r in enumerate(roots)]
    assert count_zeros(jnp.array(shifted)) == inside


def test_zero_is_reached_once_and_not_left():
    v, w = jnp.array([1.0, 0.0, -1.0, -1.0]), jnp.array([0.0, 1.0, 1.0, -2.0])
    assert arrives(v, w, jnp.zeros(4, int)).tolist() == [True, False, True, False]
    assert arrives(v, w, jnp.full(4, 1)).tolist() == [False, False, True, False]


@pytest.mark.slow
def test_rows_at_a_reset_have_the_state_before_it_and_the_end_of_a_run_the_one_behind():
    clock = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 5.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, args: jnp.stack([u, 0.0 * u]), h=lambda t, x, u, args: 1.0 + 0.0 * x[0],
    )  # fmt: skip

    def rows(at, ts, terminal=False):
        event = component(0, at, terminal=terminal, reset=lambda t, x, u, args: x.at[1].add(9.0))
        sol = dvax.solve(clock, jnp.array([0.0, 1.0]), 0.0, 1.0, None, ts, events=[event])
        return np.round(np.asarray(sol.xs), 12).tolist()

    assert rows(0.5, [0.25, 0.5, 1.0]) == [[0.25, 1.0], [0.5, 1.0], [1.0, 10.0]]
    assert rows(1.0, [0.5, 1.0]) == [[0.5, 1.0], [1.0, 10.0]]
    assert rows(1.0, None) == [[1.0, 10.0]] and rows(0.5, None, True) == [[0.5, 10.0]]
    assert rows(0.0, [0.0, 1.0]) == [[0.0, 10.0], [1.0, 10.0]]
