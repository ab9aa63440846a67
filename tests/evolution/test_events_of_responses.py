"""Events whose functions read u, which has an error of its own, mostly of laws that are iterated: they
are found where u arrives at a bound and stays there, and their derivatives are those of the event."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax

RADIUS = 0.5
LIMIT = np.full(2, RADIUS)
SETS = {
    "ball": dvax.sets.Ball(np.zeros(2), RADIUS),
    "L1 ball": dvax.sets.L1Ball(np.zeros(2), RADIUS),
    "box": dvax.sets.Box(-LIMIT, LIMIT),
}
# How far u is from the bound that it reaches first: zero as long as it stays there.
GAPS = {
    "ball": lambda t, x, u, q: RADIUS**2 - jnp.sum(u * u),
    "L1 ball": lambda t, x, u, q: RADIUS - jnp.sum(jnp.abs(u)),
    "box": lambda t, x, u, q: RADIUS - u[0],
}


def crossing(t, x, u, q):
    return u[0] + 0.5 * u[1] + x[0] + 2.0 * jnp.sin(2.0 * t) - 0.4 - q


def problem(name, iterated=True):
    A = np.array([[-0.3, 1.0], [-1.5, -0.2]])
    M = np.array([[0.3, 0.2], [-0.1, 0.4]])

    def f(t, x, u, q):
        return jnp.stack([jnp.tanh(x[1]) * jnp.cos(3.0 * t), u[0] + q])

    def h(t, x, u, q):  # not affine in u, so that the law is iterated
        return 0.6 * x - (M @ jnp.tanh(u) if iterated else 0.0) + q * jnp.sin(3.0 * t)

    return dvax.Problem(
        A=dvax.generators.Dense(A), P=dvax.operators.Scaling(1.0), K=SETS[name], f=f, h=h
    )


def runs(name, event, adjoint="forward", iterated=True):
    """Return a function of q and the tolerance: the first event's time, and the state at the end."""
    of = problem(name, iterated)

    def found(q, rtol):
        sol = dvax.solve(
            of, jnp.array([0.2, 0.1]), 0.0, 1.5, q, rtol=rtol, atol=rtol / 100, adjoint=adjoint,
            events=[event], max_events=8, max_steps=2**10,
        )  # fmt: skip
        return sol.events.ts[0], sol.xs[-1]

    return found


def halved(t, x, u, q):
    return -0.5 * x


CASES = [
    *itertools.product(SETS, ("arrival", "crossing"), ("terminal", "reset"), (True,)),
    *itertools.product(SETS, ("arrival",), ("terminal", "reset"), (False,)),
]
OFTEN = {("ball", "arrival", "terminal", False), ("L1 ball", "arrival", "reset", True)}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind", "then", "iterated"), mostly_thorough(CASES, OFTEN))
def test_derivatives_of_events_of_responses_agree_with_differences(name, kind, then, iterated):
    function = GAPS[name] if kind == "arrival" else crossing
    event = dvax.Event(
        function,
        direction=-1 if kind == "arrival" else 0,
        reset=halved if then == "reset" else None,
        terminal=then == "terminal",
    )
    found = runs(name, event, iterated=iterated)
    run = jax.jit(found)
    derivative = jax.jit(lambda q, r: jax.jvp(lambda q: found(q, r), (q,), (1.0,)))
    compared, e = 0, 1e-5
    for q in np.linspace(0.5, 1.8, 9):
        sharp, before, after = (run(v, 1e-11) for v in (q, q - e, q + e))
        if not np.isfinite(sharp[0]):
            continue
        expected = [(b - a) / (2 * e) for a, b in zip(before, after, strict=True)]
        for rtol in (1e-6, 1e-9):
            (t, x), (dt, dx) = derivative(q, rtol)
            assert t == pytest.approx(float(sharp[0]), abs=20 * rtol)
            assert dt == pytest.approx(float(expected[0]), rel=50 * rtol, abs=3e-6)
            np.testing.assert_allclose(x, sharp[1], rtol=0, atol=50 * rtol)
            np.testing.assert_allclose(dx, expected[1], rtol=0, atol=50 * rtol + 1e-5)
            compared += 1
    assert compared >= 10


@pytest.mark.thorough
def test_both_modes_agree_at_an_event_of_an_iterated_response():
    event = dvax.Event(GAPS["ball"], direction=-1, reset=halved)
    forward = jax.jacfwd(lambda q: runs("ball", event)(q, 1e-9))(1.1)
    reverse = jax.jacrev(lambda q: runs("ball", event, "reverse")(q, 1e-9))(1.1)
    for a, b in zip(forward, reverse, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


@pytest.mark.slow
def test_a_response_that_stays_at_its_bound_after_a_reset_has_no_second_event():
    """u stays on the sphere while x jumps, and a function that is zero up to its error has no sign."""
    of = problem("L1 ball")
    event = dvax.Event(GAPS["L1 ball"], direction=-1, reset=halved)
    sol = dvax.solve(
        of, jnp.array([0.2, 0.1]), 0.0, 0.3, 1.0, rtol=1e-6, events=[event], max_events=8
    )
    times = np.asarray(sol.events.ts)[np.isfinite(sol.events.ts)]
    assert len(times) == 2 and np.diff(times)[0] > 0.05
    assert int(sol.stats["steps"]) < 100


@pytest.mark.slow
@pytest.mark.parametrize("entries", [2, 3, 40])
def test_a_response_that_turns_along_its_bound_arrives_there_once(entries):
    """u = proj(a(t) e(t)) with |e| = 1 and a growing: it reaches the sphere at a = ½, and goes around
    on it through all directions of a plane. Roundoff of g there is no event."""
    ball, space = dvax.sets.Ball(np.zeros(entries), RADIUS), dvax.spaces.Euclidean((entries,))

    def h(t, x, u, q):
        turned = jnp.zeros(entries).at[0].set(jnp.cos(q[1] * t + q[0]))
        return 2.0 * (0.2 + t) * turned.at[1].set(jnp.sin(q[1] * t + q[0])) - u

    of = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=ball, control_space=space,
        f=lambda t, x, u, q: u[0] + 0.0 * x, h=h,
    )  # fmt: skip
    event = dvax.Event(GAPS["ball"], direction=-1, reset=lambda t, x, u, q: x + 1.0)

    @jax.jit
    def times(q):
        return dvax.solve(of, 0.0, 0.0, 2.0, q, events=[event], max_events=8, throw=False).events.ts

    for phase in (0.0, 0.7, 1.6, 3.0):
        for speed in (1.0, 7.0):
            found = np.asarray(times(jnp.array([phase, speed])))
            assert np.isfinite(found).sum() == 1 and abs(found[0] - 0.3) <= 1e-9
