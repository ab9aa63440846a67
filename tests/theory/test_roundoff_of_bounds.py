"""Bounds hold where rounding decides: of times, of fast turns, and of data near the ends of a run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax


def scalar(f, rate=0.0, h=lambda t, x, u, args: 0.3 * x):
    return dvax.Problem(
        A=dvax.generators.Scalar(rate), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=f, h=h,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("t0", [0.0, 1e4, 1e6, 1.7e9])
@pytest.mark.parametrize("settings", [{}, {"dt": 5.0}], ids=["adaptive", "fixed"])
def test_rounded_times_are_in_the_bound(t0, settings):
    """The speed vanishes at the end, where alone it used to be measured."""
    span = 10.0
    system = scalar(lambda t, x, u, args: (t - (t0 + span)) / span + 0.0 * u)
    ts = t0 + np.array([0.5, 1.0]) * span
    constants = dvax.verify(system, 0.0, t0, t0 + span).constants
    sol = dvax.solve(
        system, 0.0, t0, t0 + span, ts=ts, method=dvax.ETD2RK(), constants=constants, **settings
    )
    s = np.asarray(sol.ts) - t0
    error = np.abs(np.asarray(sol.xs) - (s**2 / (2 * span) - s))
    bound, along = dvax.bound_error(system, sol, constants), dvax.bound_error(system, sol)
    assert bound.status == "proved" and float(bound.x[-1]) < 1e-12 + 1e-11 * abs(t0)
    assert (error <= np.asarray(bound.x)).all() and (error <= np.asarray(along.x)).all()
    # In Unix time the trajectory for a bound has steps that t hardly resolves.
    assert along.status == "proved" or (t0 > 1e9 and "may leave every tube" in along.why)


def turning(w, x0, jump=np.inf, rest=(0.0, 0.0)):
    """x' = Ax of a fast rotation, which a force holds at `rest` from the time `jump` on."""
    A = np.array([[0.0, w], [-w, 0.0]])
    force = jnp.asarray(-A @ np.asarray(rest))

    def f(t, x, u, args):
        return jnp.where(t < jump, 0.0, 1.0) * force + 0.0 * u

    problem = dvax.Problem(
        A=dvax.generators.Dense(A), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=f, h=lambda t, x, u, args: 0.0 * x,
    )  # fmt: skip
    return problem, jnp.asarray(x0)


@pytest.mark.slow
@pytest.mark.parametrize("w", [1e3, 1e5])
@pytest.mark.parametrize("settings", [{}, {"dt": 1.0}], ids=["adaptive", "fixed"])
def test_the_phase_of_a_rotation_that_stops_is_in_the_bound(w, settings):
    """Both ends of ‖Ax‖ are 0 at the saved time, and the phase of what stopped is rounded."""
    jump = 10.0 - 1.0 / w
    rest = np.array([np.cos(w * jump), -np.sin(w * jump)])
    problem, x0 = turning(w, [1.0, 0.0], jump, rest)
    constants = dvax.verify(problem, x0, 0.0, 10.0).constants
    sol = dvax.solve(
        problem, x0, 0.0, 10.0, ts=[10.0], method=dvax.ETD2RK(), constants=constants, **settings
    )
    error = np.linalg.norm(np.asarray(sol.xs[-1]) - rest)
    assert error <= float(dvax.bound_error(problem, sol, constants).x[-1]) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("w", [1.0, 1e5, 1e6])
def test_a_certified_tolerance_below_the_rounding_of_a_phase_is_refused(w):
    problem, x0 = turning(w, [1.0, 0.0])
    constants = dvax.verify(problem, x0, 0.0, 10.0).constants
    solve = lambda tol: dvax.solve(  # noqa: E731
        problem, x0, 0.0, 10.0, ts=[10.0], constants=constants, certified_tol=tol
    )
    exact = np.array([np.cos(10.0 * w), -np.sin(10.0 * w)])
    reached = solve(1e-6)
    assert np.linalg.norm(np.asarray(reached.xs[-1]) - exact) <= reached.stats["certified_bound"]
    if w > 1.0:
        with pytest.raises(dvax.InputError, match="roundoff of x"):
            solve(1e-11)


PULSES = {
    "at the start": lambda t, t0, t1, width: t < t0 + width,
    "at the end": lambda t, t0, t1, width: t > t1 - width,
}


@pytest.mark.parametrize("where", PULSES)
@pytest.mark.parametrize("roundings", [6.0, 20.0, 100.0])
def test_a_pulse_some_roundings_long_is_in_no_proved_bound(where, roundings):
    t0, t1 = 1.7e9, 1.7e9 + 2.0
    width = roundings * np.finfo(float).eps * t1
    system = scalar(
        lambda t, x, u, args: jnp.where(PULSES[where](t, t0, t1, width), 1e3, 0.0) + 0 * u
    )
    constants = dvax.verify(system, 0.0, t0, t1).constants
    sol = dvax.solve(system, 0.0, t0, t1, constants=constants, method=dvax.ETD2RK(), dt=0.5)
    bound = dvax.bound_error(system, sol, constants)
    assert bound.status == "estimated" and "may jump at t = " in bound.why
    with pytest.raises(dvax.InputError, match="roundings of t from an end"):
        dvax.solve(system, 0.0, t0, t1, constants=constants, certified_tol=1.0)


@pytest.mark.parametrize("knots", [[0.0, 1.0, 2.0], [-1.0, 0.5, 3.0]])
def test_data_with_knots_at_the_ends_or_far_from_them_have_a_proved_bound(knots):
    table = dvax.signals.Table(knots, [0.0, 1.0, 0.5])
    system = scalar(lambda t, x, u, args: table(t) + u, rate=-1.0)
    constants = dvax.verify(system, 0.0, 0.0, 2.0).constants
    sol = dvax.solve(system, 0.0, 0.0, 2.0, constants=constants, method=dvax.ETD2RK())
    assert dvax.bound_error(system, sol, constants).status == "proved"


@pytest.mark.slow
def test_constants_of_another_problem_prove_nothing():
    tame = scalar(lambda t, x, u, args: 0.1 * u - x)
    steep = scalar(lambda t, x, u, args: 2.0 * jnp.sin(x) + 0.1 * u)
    constants = dvax.verify(tame, 0.01, 0.0, 3.0).constants
    sol = dvax.solve(steep, 0.01, 0.0, 3.0, method=dvax.ETD2RK())
    assert dvax.bound_error(steep, sol, constants).status != "proved"
    with pytest.raises(dvax.InputError, match="another problem"):
        dvax.solve(steep, 0.01, 0.0, 3.0, constants=constants, certified_tol=1e-3)
    # The same code again is the same problem, and so are the same arrays.
    again = scalar(tame.f, h=tame.h)
    sol = dvax.solve(again, 0.01, 0.0, 3.0, constants=constants, method=dvax.ETD2RK())
    assert dvax.bound_error(again, sol, constants).status == "proved"


def test_constants_of_a_matrix_hold_for_the_same_numbers_alone():
    def system(a):
        return dvax.Problem(
            A=dvax.generators.Dense(a * np.array([[-1.0, 1.0], [0.0, -2.0]])),
            P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
            f=lambda t, x, u, args: u, h=lambda t, x, u, args: -x,
        )  # fmt: skip

    one, x0 = system(1.0), jnp.ones(2)
    constants = dvax.verify(one, x0, 0.0, 1.0).constants
    for a, status in ((1.0, "proved"), (-1.0, "declared")):
        other = system(a)
        sol = dvax.solve(
            other, x0, 0.0, 1.0, method=dvax.ETD2RK(), constants=constants if a == 1.0 else None
        )
        assert dvax.bound_error(other, sol, constants).status == status


def test_constants_for_an_integer_hold_for_no_other_type():
    system = scalar(
        lambda t, x, u, n: jax.lax.div(n, type(n)(2) if isinstance(n, int) else 2.0) * x
    )
    constants = dvax.verify(system, 1.0, 0.0, 1.0, 3).constants
    domain = constants.domain
    assert domain.has_args(3, domain.reads) and not domain.has_args(3.0, domain.reads)
