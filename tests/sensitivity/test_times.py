"""Derivatives in times: the first, the last, the saved ones, and those of jumps."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.once import once
from tests.selection import mostly_thorough

import dvax

RATE, JUMP = 2.0, 3.0
"""x' = −2x + u, u = t before η and t + 3 from there on: u = h/2, on no bound."""
START, ETA, END, X0 = 0.1, 0.55, 1.4, 0.3
AT = np.array([0.3, ETA + 0.25, END])


def drive(eta):
    times = jnp.stack([jnp.zeros_like(eta), eta, jnp.full_like(eta, 9.0)])
    return dvax.signals.Table(times, jnp.array([0.0, JUMP, JUMP]), kind="constant")


@once
def problem():
    return dvax.Problem(
        A=dvax.generators.Scalar(-RATE), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-9.0, 9.0),
        f=lambda t, x, u, jump: u, h=lambda t, x, u, jump: 2.0 * (t + jump(t)) - u + 0.0 * x,
    )  # fmt: skip


def exact(t0, eta, t):
    """x(t) by variation of constants: s/2 − 1/4 + c/2 solves x' = −2x + s + c."""
    line = lambda s, c: (s + c) / RATE - 1 / RATE**2  # noqa: E731
    before = lambda s: line(s, 0.0) + jnp.exp(-RATE * (s - t0)) * (X0 - line(t0, 0.0))  # noqa: E731
    behind = line(t, JUMP) + jnp.exp(-RATE * (t - eta)) * (before(eta) - line(eta, JUMP))
    return jnp.where(t <= eta, before(t), behind)


def assert_close(found, want, tol):
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=tol, atol=tol)  # noqa: E731
    jax.tree_util.tree_map(close, found, want)


METHODS = {
    "ETD2RK, adaptive": (dvax.ETD2RK(), dict(rtol=1e-9, atol=1e-9), 1e-6),
    "ETD4RK, adaptive": (dvax.ETD4RK(), dict(rtol=1e-9, atol=1e-9), 1e-7),
    "DormandPrince, adaptive": (dvax.DormandPrince(), dict(rtol=1e-9, atol=1e-9), 1e-7),
    "ExpRosenbrock, adaptive": (dvax.ExpRosenbrock(), dict(rtol=1e-9, atol=1e-9), 1e-7),
    # ETA and END are multiples of the step, and one of the saved times is: all of them move.
    "ETD2RK, fixed": (dvax.ETD2RK(), dict(dt=1 / 320, max_steps=600), 2e-5),
    "ETD4RK, fixed": (dvax.ETD4RK(), dict(dt=1 / 320, max_steps=600), 1e-7),
    "ETD4RK, fixed and measured": (
        dvax.ETD4RK(), dict(dt=1 / 320, max_steps=600, measure=True), 1e-7,
    ),
    "Picard": (dvax.Picard(), dict(dt=1 / 320, max_steps=600), 2e-5),
    # Its steps cross kinks, where derivatives are as good as steps are short.
    "Implicit": (dvax.Implicit(), dict(rtol=1e-12, atol=1e-12), 2e-6),
}  # fmt: skip


OFTEN = ["ETD4RK, adaptive", "ETD2RK, fixed"]


@pytest.mark.thorough
@pytest.mark.parametrize("name", mostly_thorough(METHODS, ["ETD4RK, adaptive"]))
def test_derivatives_in_all_times_agree_with_the_closed_form(name):
    method, settings, tol = METHODS[name]

    def saved(t0, eta, t1, ts, adjoint):
        return dvax.solve(
            problem(),
            jnp.full(2, X0),
            t0,
            t1,
            drive(eta),
            ts,
            method=method,
            adjoint=adjoint,
            **settings,
        )

    def by(adjoint):
        def states(times):
            t0, eta, t1, ts = times
            found = saved(t0, eta, t1, ts, adjoint)
            # The last saved time is the end, whether that moves or not; u is a function of time alone.
            return jnp.concatenate([found.xs[:, 0], found.us[:2, 1]])

        return states

    given = tuple(map(jnp.asarray, (START, ETA, END))) + (jnp.asarray(AT),)

    def truth(times):
        t0, eta, _, ts = times
        shown = jax.vmap(lambda t: exact(t0, eta, t))(ts)
        return jnp.concatenate([shown, jnp.stack([ts[0], JUMP + ts[1]])])

    want = jax.jacfwd(truth)(given)
    forward = jax.jit(jax.jacfwd(by("forward")))(given)
    assert_close(forward, want, tol)
    if name != "Picard":
        backward = jax.jit(jax.jacrev(by("reverse")))(given)
        assert_close(backward, want, tol)


ENDS = list(
    itertools.product(
        ["ETD4RK, adaptive", "ETD4RK, fixed", "DormandPrince, adaptive"], ["forward", "reverse"]
    )
)


@pytest.mark.parametrize(("name", "adjoint"), mostly_thorough(ENDS, {ENDS[0]}))
def test_derivative_of_the_last_state_in_all_times(name, adjoint):
    method, settings, tol = METHODS[name]

    def last(times):
        t0, eta, t1 = times
        return dvax.solve(
            problem(),
            jnp.full(2, X0),
            t0,
            t1,
            drive(eta),
            method=method,
            adjoint=adjoint,
            **settings,
        ).xs[-1, 0]

    given = tuple(map(jnp.asarray, (START, ETA, END)))
    derivative = jax.jacfwd if adjoint == "forward" else jax.jacrev
    found = jax.jit(derivative(last))(given)
    want = jax.jacfwd(lambda times: exact(*times))(given)
    np.testing.assert_allclose(found, want, rtol=tol, atol=tol)


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "adjoint"), mostly_thorough(ENDS[:4], {ENDS[1]}))
def test_derivative_of_dense_output_in_its_time_and_the_end(name, adjoint):
    method, settings, _ = METHODS[name]

    def between(times):
        t0, eta, t1, t = times
        found = dvax.solve(
            problem(), jnp.full(2, X0), t0, t1, drive(eta), method=method, adjoint=adjoint,
            dense=True, **(settings | {"max_steps": 600}),
        )  # fmt: skip
        # In the last step, and the end itself.
        return jnp.stack([found.evaluate(t)[0][0], found.evaluate(t1)[0][0]])

    given = tuple(map(jnp.asarray, (START, ETA, END, END - 1e-3)))
    derivative = jax.jacfwd if adjoint == "forward" else jax.jacrev
    found = jax.jit(derivative(between))(given)
    truth = lambda v: jnp.stack([exact(v[0], v[1], v[3]), exact(v[0], v[1], v[2])])  # noqa: E731
    # Within a step x_h is of the order of the stage polynomial.
    assert_close(found, jax.jacfwd(truth)(given), 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "adjoint"), mostly_thorough(ENDS[:4], {ENDS[0]}))
def test_derivative_of_a_state_saved_at_a_jump_uses_the_left_limit(name, adjoint):
    method, settings, tol = METHODS[name]

    def saved(times):
        t0, eta, t1 = times
        # The first, one that is there twice, the jump, and the end of data, where it jumps again.
        ts = jnp.stack([t0, 0.5 * (t0 + eta), 0.5 * (t0 + eta), eta, t1])
        jumps = jnp.stack([jnp.zeros_like(eta), eta, t1])
        data = dvax.signals.Table(jumps, jnp.array([0.0, JUMP, 7.0]), kind="constant")
        return dvax.solve(
            problem(), jnp.full(2, X0), t0, t1, data, ts, method=method, adjoint=adjoint, **settings
        ).xs[:, 0]

    def truth(times):
        t0, eta, t1 = times
        ts = jnp.stack([t0, 0.5 * (t0 + eta), 0.5 * (t0 + eta), eta, t1])
        return jax.vmap(lambda t: exact(t0, eta, t))(ts)

    given = tuple(map(jnp.asarray, (START, ETA, END)))
    derivative = jax.jacfwd if adjoint == "forward" else jax.jacrev
    assert_close(jax.jit(derivative(saved))(given), jax.jacfwd(truth)(given), tol)


SECOND = list(
    itertools.product(["ETD4RK, adaptive", "ETD4RK, fixed"], ["forward", "reverse"], [False, True])
)


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "adjoint", "within"), SECOND)
def test_second_derivatives_in_all_times(name, adjoint, within):
    method, settings, _ = METHODS[name]
    weights = jnp.arange(1.0, 4.0) if within else jnp.ones(1)

    def square(times):
        t0, eta, t1, ts = times
        found = dvax.solve(
            problem(), jnp.full(2, X0), t0, t1, drive(eta), ts if within else None,
            method=method, adjoint=adjoint, **settings,
        )  # fmt: skip
        return jnp.sum(weights * found.xs[:, 0] ** 2)

    def truth(times):
        t0, eta, t1, ts = times
        x = jax.vmap(lambda t: exact(t0, eta, t))(ts if within else t1[None])
        return jnp.sum(weights * x**2)

    given = tuple(map(jnp.asarray, (START, ETA, END))) + (jnp.asarray(AT),)
    inner = jax.jacfwd if adjoint == "forward" else jax.jacrev
    found = jax.jit(jax.jacfwd(inner(square)))(given)
    assert_close(found, jax.jacfwd(jax.jacrev(truth))(given), 1e-6)


@pytest.mark.thorough
def test_second_derivatives_distinguish_equal_adaptive_steps():
    """Many steps are as long as the one before, and only the last one depends on the end."""
    rate = lambda t, x, pace: jnp.sin(pace * t) + 0.3 * jnp.sin(3 * x) * jnp.cos(pace * t)  # noqa: E731
    curved = dvax.Problem(
        A=dvax.generators.Scalar(-RATE), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-9.0, 9.0),
        f=lambda t, x, u, pace: u + rate(t, x, pace) - jnp.sin(pace * t),
        h=lambda t, x, u, pace: 2.0 * jnp.sin(pace * t) - u + 0.0 * x,
    )  # fmt: skip

    def square(given):
        t0, pace, t1 = given
        x = dvax.solve(curved, jnp.full(1, X0), t0, t1, pace, method=dvax.ETD4RK(), rtol=1e-6).xs
        return x[-1, 0] ** 2, x[-1, 0]

    def gradient(given):
        by, x = jax.jacrev(square, has_aux=True)(given)
        return by, jax.lax.stop_gradient(x)

    given = tuple(map(jnp.asarray, (START, 1.3, END)))
    found, x = jax.jit(jax.jacfwd(gradient, has_aux=True))(given)
    assert_close(found, tuple(zip(*found, strict=True)), 1e-5)
    # In the end itself, by x' and x''.
    whole = lambda t, x: -RATE * x + rate(t, x, 1.3)  # noqa: E731
    v, bent = jax.jvp(whole, (END, x), (1.0, whole(END, x)))
    assert_close(found[2][2], 2.0 * (v**2 + x * bent), 1e-5)


@pytest.mark.thorough
def test_second_derivatives_distinguish_fixed_steps_at_a_jump():
    def square(given):
        t0, eta, t1 = given
        return dvax.solve(
            problem(), jnp.full(1, X0), t0, t1, drive(eta), dt=1 / 40, max_steps=60
        ).xs[-1, 0] ** 2  # fmt: skip

    given = tuple(map(jnp.asarray, (START, ETA, END)))
    want = jax.jacfwd(jax.jacrev(lambda given: exact(*given) ** 2))(given)
    assert_close(jax.jit(jax.jacfwd(jax.jacrev(square)))(given), want, 1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("name", mostly_thorough(OFTEN, ["ETD2RK, fixed"]))
def test_linearize_returns_values_and_derivatives_in_times(name):
    # As least squares do: the values must be known before the tangents are.
    method, settings, tol = METHODS[name]

    def saved(eta, t1, ts):
        return dvax.solve(
            problem(), jnp.full(2, X0), START, t1, drive(eta), ts, method=method,
            adjoint="forward", **settings,
        ).xs[:, 0]  # fmt: skip

    given = jnp.asarray(ETA), jnp.asarray(END), jnp.asarray(AT)
    along = jnp.asarray(0.7), jnp.asarray(-0.4), jnp.array([0.3, 1.1, -0.4])
    # The last of the saved times is t1.
    value, push = jax.linearize(saved, *given)
    assert_close(
        (value, push(*along)),
        jax.jvp(lambda eta, t1, ts: exact(START, eta, ts), given, along),
        tol,
    )


def coupled():
    """Two states, a box that jumps with a signal of its own, and rates that are not linear in x."""
    return dvax.Problem(
        A=dvax.generators.Dense(jnp.array([[-1.0, 0.5], [-0.5, -2.0]])),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, a: dvax.sets.Box(-0.4 - 0.1 * a["s"](t), 0.5 + 0.0 * t),
        f=lambda t, x, u, a: jnp.stack(
            [a["p"] * jnp.sin(x[1]) + u[0] + a["s"](t), 0.3 * x[0] * x[1] - u[1] + a["q"](t)]
        ),
        h=lambda t, x, u, a: jnp.stack(
            [x[0] + jnp.sin(t) + a["s"](t), a["p"] * x[1] - 0.2]
        ) - 1.5 * u,
    )  # fmt: skip


COUPLED = list(
    itertools.product(
        ["ETD4RK, adaptive", "ETD4RK, fixed", "ExpRosenbrock, adaptive"], ["forward", "reverse"]
    )
)


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "adjoint"), COUPLED)
def test_derivatives_in_all_times_of_a_coupled_system(name, adjoint):
    method, settings, _ = METHODS[name]
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(7, 2)))

    def asked(v, method=method, adjoint=adjoint, settings=settings):
        t0, one, two, t1, p, x0 = v
        jumps = lambda t, values: dvax.signals.Table(  # noqa: E731
            jnp.stack([jnp.full_like(t, -1.0), t, jnp.full_like(t, 9.0)]),
            jnp.array(values),
            kind="constant",
        )
        data = {"s": jumps(one, [0.0, 1.0, 1.0]), "q": jumps(two, [1.0, -1.0, -1.0]), "p": p}
        ts = jnp.stack([t0, t0 + 0.2, t0 + 0.2, one, two, 0.5 * (two + t1), t1])
        found = dvax.solve(
            coupled(), jnp.stack([x0, 0.2 + 0.0 * x0]), t0, t1, data, ts,
            method=method, adjoint=adjoint, **settings,
        )  # fmt: skip
        # u jumps where the data do; it has a derivative elsewhere.
        between = jnp.array([1, 5, 6])
        return jnp.sum(weights * found.xs) + jnp.sum(weights[between] * found.us[between])

    given = jnp.array([0.1, 0.55, 0.8, 1.4, 0.7, 0.3])
    derivative = jax.jacfwd if adjoint == "forward" else jax.jacrev
    # An oracle without derivatives, whose steps are far finer.
    tight = dict(rtol=1e-12, atol=1e-12)
    value = jax.jit(lambda v: asked(v, dvax.ETD4RK(), "reverse", tight))
    e = 1e-4 * np.eye(6)
    apart = lambda k, d: float(value(given + d * e[k]) - value(given - d * e[k]))  # noqa: E731
    want = [(8 * apart(k, 1) - apart(k, 2)) / 12e-4 for k in range(6)]
    np.testing.assert_allclose(jax.jit(derivative(asked))(given), want, rtol=1e-6, atol=1e-6)


def test_derivative_without_times_does_not_differentiate_x_dot():
    # √x has no derivative at x(1) = 0, where no stage of ETD1 is.
    emptying = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-9.0, 9.0),
        f=lambda t, x, u, a: -a + 0.0 * u + (jnp.sqrt(x) - jnp.sqrt(x)),
        h=lambda t, x, u, a: 0.0 * x - u,
    )  # fmt: skip

    def last(x0, a):
        return dvax.solve(
            emptying, x0, 0.0, 1.0, a, jnp.array([0.5, 1.0]), dt=0.25, method=dvax.ETD1()
        ).xs[-1]

    assert tuple(map(float, jax.grad(last, (0, 1))(1.0, 1.0))) == (1.0, -1.0)
