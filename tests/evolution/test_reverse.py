"""Reverse mode against forward mode, which shares no code with it, for every kind of run."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import c1, c1_derivatives
from tests.selection import mostly_thorough

import dvax
from dvax import generators
from dvax.evolution import checkpoints
from dvax.evolution.checkpoints import Checkpoints, checkpoint_count

A = np.array([[-0.5, -3.0], [3.0, -0.5]])
X0 = jnp.array([2.0, 0.3])
TS = np.array([0.0, 0.11, 0.11, 0.4, 1.0, 1.3])
"""The start, one step twice, a multiple of 0.1, and the end."""


def system(cubic):
    """A system whose generator, set and field all depend on args; with a cubic term the law has no
    closed form, and the generator is a matrix."""
    return dvax.Problem(
        A=lambda args: generators.Dense(args["A"]) if cubic else generators.Diagonal(args["A"][0]),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Ball(0.0, args["r"] * jnp.exp(-t)),
        f=lambda t, x, u, args: jnp.sin(t) * args["w"] - u,
        h=lambda t, x, u, args: 2 * x - u - (cubic * u**3 if cubic else 0.0),
    )


ARGS = {"A": jnp.asarray(A), "r": jnp.array(0.7), "w": jnp.array([0.3, -0.2])}
KINDS = {
    "fixed": dict(dt=0.1),
    "measured": dict(dt=0.1, measure=True),
    "adaptive": dict(rtol=1e-3, atol=1e-3, max_steps=256),
}


def asked(sol):
    weights = jnp.arange(1.0, 1.0 + sol.xs.size).reshape(sol.xs.shape)
    return jnp.sum(weights * sol.xs) + jnp.sum(sol.us[1:] ** 2)


def forward(loss, given):
    flat, back = jax.flatten_util.ravel_pytree(given)
    return jax.jacfwd(lambda v: loss(back(v)))(flat)


CASES = list(itertools.product(KINDS, (4096, 4), (0.0, 0.1)))
OFTEN = [("fixed", 4, 0.0)]


@pytest.mark.parametrize(("kind", "places", "cubic"), mostly_thorough(CASES, OFTEN))
def test_reverse_mode_is_the_transpose_of_forward_mode(kind, places, cubic, monkeypatch):
    monkeypatch.setattr(checkpoints, "_MAX_COUNT", places)
    problem = system(cubic)

    def loss(given, adjoint):
        x0, args = given
        sol = dvax.solve(problem, x0, 0.0, 1.3, args, ts=TS, adjoint=adjoint, **KINDS[kind])
        return asked(sol)

    given = X0, ARGS
    found, _ = jax.flatten_util.ravel_pytree(jax.grad(loss)(given, "reverse"))
    exact = forward(lambda g: loss(g, "forward"), given)
    # A law that is iterated is solved to its tolerance only.
    close = 1e-7 if cubic else 1e-11
    np.testing.assert_allclose(np.asarray(found), np.asarray(exact), rtol=close, atol=close)


def test_checkpoints_return_the_stored_states():
    kept = Checkpoints(jnp.zeros(()), 8)
    put = jax.jit(lambda kept, i: kept.put(i, 1.0 * i))
    for n in range(100):
        kept = put(kept, n)
        stride = 2 ** int(kept.j)
        assert stride <= max(1, 2 * (n + 1) // 8)
        for i in (0, n // 2, n):
            index, x = kept.before(jnp.asarray(i))
            assert int(index) == i - i % stride == int(x)


@pytest.mark.slow
@pytest.mark.parametrize(("places", "steps", "most"), [
    (8, 1, 0), (8, 8, 0), (8, 9, 1), (8, 64, 3), (2, 30, 16), (1, 12, 6), (32, 100, 1),
    pytest.param(32, 10_000, 5, marks=pytest.mark.thorough),
])  # fmt: skip
def test_checkpoints_return_every_state_in_reverse_order(places, steps, most):
    """Steps are additions of 1, so that a state is its own number."""
    state = lambda i: i.astype(float)  # noqa: E731
    top = jax.jit(lambda stack: (stack.step, stack.x))
    ahead_of = jax.jit(lambda stack, i: stack.next(i))
    push = jax.jit(lambda stack, ahead: stack.push(ahead, state(ahead)))
    kept = Checkpoints(jnp.zeros(()), places)
    kept = jax.lax.fori_loop(0, steps, lambda i, k: k.put(i, state(i)), kept)
    stack, again = kept.stack(jnp.asarray(steps)), 0
    for i in reversed(range(steps)):
        while int(stack.step) < i:
            ahead = ahead_of(stack, jnp.asarray(i))
            again += int(ahead) - int(stack.step)
            assert int(stack.step) < int(ahead) <= i and int(stack.height) <= places
            stack = push(stack, ahead)
        number, x = top(stack)
        assert int(number) == i == float(x)
        stack = stack.pop()
    assert int(stack.height) == 0
    assert again <= most * steps, again / steps


@pytest.mark.parametrize("size", [1, 100_000, 10_000_000, 1_000_000_000])
def test_checkpoints_use_at_most_the_memory_limit(size):
    x0 = jax.ShapeDtypeStruct((size,), np.dtype(float))
    count = checkpoint_count(x0, 2**20)
    assert count * 8 * size <= max(2**30, 16 * 8 * size)
    assert count >= 16


@pytest.mark.thorough
def test_reverse_derivatives_in_the_end_time_and_a_knot():
    case = c1()

    def end(t1):
        return dvax.solve(
            case.problem, -1.0, 0.0, t1, args=case.args, rtol=1e-7, max_steps=2**14
        ).xs[-1]

    x = float(end(2.0))
    assert float(jax.grad(end)(2.0)) == pytest.approx(3.0 - 1.5 * x, abs=1e-6)  # u = 0 there

    # x' = −x + [t > τ], so dx(2)/dτ = −e^{−(2 − τ)}.
    def switched(tau):
        step = dvax.signals.Table(
            jnp.stack([0.0 * tau, tau, 0.0 * tau + 3.0]), [0.0, 1.0, 1.0], kind="constant"
        )
        problem = dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
            f=lambda t, x, u, args: args(t) + 0.0 * u, h=lambda t, x, u, args: 0.0 * x,
        )  # fmt: skip
        return dvax.solve(problem, 0.0, 0.0, 2.0, args=step, rtol=1e-6, max_steps=2**14).xs[-1]

    assert float(jax.grad(switched)(0.7)) == pytest.approx(-np.exp(-1.3), abs=1e-5)


@pytest.mark.thorough
def test_reverse_derivatives_of_the_dense_output():
    case = c1()

    def dense(x0):
        sol = dvax.solve(
            case.problem, x0, 0.0, 2.0, args=case.args, rtol=1e-6, dense=True, max_steps=2**14
        )
        return sol.evaluate(0.1)[0]

    assert float(jax.grad(dense)(-1.0)) == pytest.approx(np.exp(-0.15), abs=1e-6)


@pytest.mark.slow
def test_reverse_second_derivatives_and_batches_of_derivatives():
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 5.0),
        f=lambda t, x, u, args: -args * x**2 - u, h=lambda t, x, u, args: x - u,
    )  # fmt: skip

    def end(x0, b):
        return dvax.solve(problem, x0, 0.0, 1.0, args=b, dt=1 / 64).xs[-1]

    # u = x/2: x' = −3x/2 − bx², a Bernoulli equation.
    def exact(x0, b):
        e = jnp.exp(-1.5)
        return x0 * e / (1 + b * x0 * (1 - e) / 1.5)

    x0s = jnp.array([0.5, 1.0, 2.0])
    firsts = jax.vmap(jax.grad(end), in_axes=(0, None))(x0s, 0.4)
    np.testing.assert_allclose(firsts, jax.vmap(jax.grad(exact), (0, None))(x0s, 0.4), rtol=1e-3)
    second = jax.jvp(jax.grad(end), (1.0, 0.4), (1.0, 0.0))[1]
    assert float(second) == pytest.approx(float(jax.hessian(exact)(1.0, 0.4)), rel=2e-3)


@pytest.mark.slow
def test_reverse_derivative_in_a_closed_over_parameter():
    case = c1()

    def end(ell):
        problem = dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
            f=lambda t, x, u, args: ell - 0.5 * x - u, h=case.problem.h,
        )  # fmt: skip
        return dvax.solve(problem, -1.0, 0.0, 2.0, args=case.args, rtol=1e-7, max_steps=2**14).xs[
            -1
        ]

    assert float(jax.grad(end)(3.0)) == pytest.approx(c1_derivatives()[1], abs=1e-6)


@pytest.mark.slow
def test_failed_run_under_jit_returns_nan():
    case = c1()
    run = lambda x0: dvax.solve(case.problem, x0, 0.0, 2.0, case.args, max_steps=8).xs  # noqa: E731
    assert np.isnan(jax.jit(run)(-1.0)).all()
