"""Small loops as one function of the processor: where they are, that nothing else changes, and that
what the compiler cannot do is never asked of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import c1, c2, c3

import dvax
from dvax import _one_function as one

N = 5
V = jnp.linspace(0.5, 1.5, N)


def compiled(run, *args):
    return jax.jit(lambda *args: one.in_one_function(run, *args)).lower(*args).compile()


def is_one(program):
    # XLA asks for the same of tiny loops, without the first of the two.
    return 'inlineable="false",xla_cpu_small_call="true"' in program.as_text()


def looped(body):
    return lambda v: jax.lax.fori_loop(0, 7, lambda k, v: body(k, v), v)


SMALL = {
    "arithmetic": lambda k, v: jnp.exp(-v) + jnp.where(v > 1.0, v**2, jnp.sin(v)) / (1.0 + v),
    "a branch": lambda k, v: jax.lax.cond(v[0] > 0.7, lambda: 0.5 * v, lambda: v + 1.0),
    "a loop": lambda k, v: jax.lax.while_loop(lambda v: jnp.sum(v) > 2.0, lambda v: 0.7 * v, v),
    "a product": lambda k, v: 0.1 * (jnp.outer(v, v) @ v) + jnp.flip(v),
    "a matrix product": lambda k, v: jnp.sum(0.1 * (jnp.outer(v, v) @ jnp.outer(v, v)), axis=0),
    "places": lambda k, v: jax.lax.dynamic_update_index_in_dim(v, v[k % N] + 1.0, N - 1, 0),
    "sorting by hand": lambda k, v: v[jnp.argmin(v)] + v / jnp.max(jnp.abs(v)),
    "nothing of v": lambda k, v: jnp.ones(N) * 3.0,
}
LARGE = {
    "a library's product": lambda k, v: v + 0.0 * (jnp.ones((N, 9)) @ jnp.ones((9, 9)))[:, 0],
    "a transform": lambda k, v: jnp.fft.irfft(jnp.fft.rfft(v), N),
    "a solve": lambda k, v: jnp.linalg.solve(jnp.eye(N) + jnp.outer(v, v), v),
    "sorting": lambda k, v: jnp.sort(v) + 1.0,
    "a scatter": lambda k, v: v.at[jnp.array([0, 0, k % N])].add(1.0),
    "a long array": lambda k, v: v + jnp.sum(jnp.ones(4000) * v[0]) / 4000.0,
    "a call back": lambda k, v: jax.pure_callback(np.sin, v, v),
}


@pytest.mark.parametrize("name", SMALL)
def test_what_is_small_is_one_function_with_the_same_values(name):
    run = looped(SMALL[name])
    program = compiled(run, V)
    assert is_one(program)
    np.testing.assert_allclose(program(V), jax.jit(run)(V), rtol=1e-13)


@pytest.mark.parametrize("name", LARGE)
def test_what_a_library_does_is_left_alone(name):
    run = looped(LARGE[name])
    program = compiled(run, V)
    assert not is_one(program)
    np.testing.assert_allclose(program(V), jax.jit(run)(V), rtol=1e-13)


def test_arguments_of_every_kind_arrive_as_they_left():
    given = (
        jnp.array([1, -(2**53) - 1]), jnp.array(True), jnp.array(3, jnp.int32),
        jnp.array([1.5, jnp.nan, jnp.inf], jnp.float32), jnp.array([[1 + 2j, -3j]]), V,
        np.array(2.5), "not an array", None,
    )  # fmt: skip

    def run(*args):
        turns = looped(lambda k, v: v + 1.0)(args[5])
        return args[:5], turns, args[6:]

    whole = jax.jit(lambda *a: one.in_one_function(run, *a, "not an array", None)[:2])
    out, turns = whole(*given[:-2])
    for found, before in zip(out, given[:5], strict=True):
        assert found.dtype == before.dtype
        np.testing.assert_array_equal(found, before)
    assert one.in_one_function(run, *given)[2][1:] == ("not an array", None)
    np.testing.assert_array_equal(turns, V + 7.0)


@pytest.mark.parametrize("unused", [0, 1, 2])
def test_arguments_that_turn_out_to_be_of_no_use_do_no_harm(unused):
    def run(*args):
        v, scale, index = (0.0 * a if k == unused else a for k, a in enumerate(args))
        return looped(lambda k, v: v * scale + jnp.where(index > 0, 0.0, 1.0))(v)

    args = V, jnp.asarray(0.5), jnp.asarray(1.0)
    np.testing.assert_allclose(compiled(run, *args)(*args), run(*args))


def test_constants_may_be_arguments_and_everything_may_be_constant():
    run = looped(lambda k, v: 0.5 * v + 1.0)
    for n in (5, 999):
        v = np.linspace(0.0, 1.0, n)
        np.testing.assert_allclose(
            jax.jit(lambda v=v: one.in_one_function(run, jnp.asarray(v)))(), run(v)
        )


def test_a_batch_and_a_derivative_are_compiled_as_any_program():
    run = looped(lambda k, v: jax.lax.dynamic_update_index_in_dim(jnp.sin(v), v[k % N], 1, 0))
    whole = lambda v: one.in_one_function(run, v)  # noqa: E731
    many = jnp.stack([V * s for s in np.linspace(0.5, 2.0, 700)])
    batch = jax.jit(jax.vmap(whole)).lower(many).compile()
    assert not is_one(batch)
    np.testing.assert_allclose(batch(many), jax.vmap(run)(many), rtol=1e-13)
    primal, tangent = jax.jit(lambda v: jax.jvp(whole, (v,), (v,)))(V)
    exact = jax.jvp(run, (V,), (V,))
    np.testing.assert_allclose(primal, exact[0], rtol=1e-13)
    np.testing.assert_allclose(tangent, exact[1], rtol=1e-13)


@pytest.mark.parametrize("case", [c1, c2, c3], ids=["C1", "C2", "C3"])
def test_small_systems_are_solved_in_one_function(case):
    # What makes a step of a small system cheap: should a new operation end it, this says so.
    problem, x0, t1, _, _, args = case()

    def end(x0, rtol):
        return dvax.solve(problem, x0, 0.0, t1, args, rtol=rtol).xs[-1]

    assert is_one(jax.jit(end).lower(jnp.asarray(x0), 1e-4).compile())


def test_where_the_compiler_cannot_do_it_nothing_is_asked(monkeypatch):
    monkeypatch.setattr(one, "_compiles", lambda: False)
    assert not is_one(compiled(looped(SMALL["arithmetic"]), V))
