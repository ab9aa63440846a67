"""Small programs are compiled as one function with equal results; programs that XLA cannot compile so
are left unchanged."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import c1, c2, c3
from tests.selection import mostly_thorough

import dvax
from dvax import _jax
from dvax._jax import outlined

pytestmark = pytest.mark.skipif(
    not (_jax.OUTLINES and jax.default_backend() == "cpu"),
    reason="on this JAX dvax leaves small programs to XLA, as on accelerators",
)

N = 5
V = jnp.linspace(0.5, 1.5, N)


def compiled(run, *args):
    return jax.jit(lambda *args: outlined(run, *args)).lower(*args).compile()


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
    "the same row for a batch": lambda k, v: jnp.sum(
        jax.vmap(lambda w: jax.lax.dynamic_update_index_in_dim(w, 1.0, k % N, 0))(
            0.1 * jnp.outer(v, v)
        ),
        axis=0,
    ),
    "much arithmetic": lambda k, v: v + jnp.outer(jnp.ones(1600), v)[k] / jnp.ones(8000)[k],
    "nothing of v": lambda k, v: jnp.ones(N) * 3.0,
}
LARGE = {
    "a library's product": lambda k, v: v + 0.0 * (jnp.ones((N, 9)) @ jnp.ones((9, 9)))[:, 0],
    "a transform": lambda k, v: jnp.fft.irfft(jnp.fft.rfft(v), N),
    "a solve": lambda k, v: jnp.linalg.solve(jnp.eye(N) + jnp.outer(v, v), v),
    "sorting": lambda k, v: jnp.sort(v) + 1.0,
    "a scatter": lambda k, v: v.at[jnp.array([0, 0, k % N])].add(1.0),
    "a row for each of a batch": lambda k, v: jnp.sum(
        jax.vmap(lambda w, k: jax.lax.dynamic_update_index_in_dim(w, 1.0, k, 0))(
            jnp.outer(v, v), jnp.arange(N) + k % 2
        ),
        axis=0,
    ),
    "a long array": lambda k, v: v + jnp.max(jnp.ones(20000) * v[0]),
    "many sums": lambda k, v: v + jnp.sum(jnp.outer(jnp.ones(1000), v), axis=0) / 1000.0,
    "a long sum": lambda k, v: v + jnp.sum(jnp.ones(4000) * v[0]) / 4000.0,
    "many values of a function": lambda k, v: v + jnp.max(jnp.sin(jnp.ones(2000) * v[0])),
    "a call back": lambda k, v: jax.pure_callback(np.sin, v, v),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_outlined_small_program_is_one_function_with_equal_values(name):
    run = looped(SMALL[name])
    program = compiled(run, V)
    assert is_one(program)
    np.testing.assert_allclose(program(V), jax.jit(run)(V), rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("name", LARGE)
def test_outlined_leaves_large_programs_and_library_calls_unchanged(name):
    run = looped(LARGE[name])
    program = compiled(run, V)
    assert not is_one(program)
    np.testing.assert_allclose(program(V), jax.jit(run)(V), rtol=1e-13)


def test_outlined_passes_arguments_of_every_type_unchanged():
    given = (
        jnp.array([1, -(2**53) - 1]), jnp.array(True), jnp.array(3, jnp.int32),
        jnp.array([1.5, jnp.nan, jnp.inf], jnp.float32), jnp.array([[1 + 2j, -3j]]), V,
        np.array(2.5), "not an array", None,
    )  # fmt: skip

    def run(*args):
        turns = looped(lambda k, v: v + 1.0)(args[5])
        return args[:5], turns, args[6:]

    whole = jax.jit(lambda *a: outlined(run, *a, "not an array", None)[:2])
    out, turns = whole(*given[:-2])
    for found, before in zip(out, given[:5], strict=True):
        assert found.dtype == before.dtype
        np.testing.assert_array_equal(found, before)
    assert outlined(run, *given)[2][1:] == ("not an array", None)
    np.testing.assert_array_equal(turns, V + 7.0)


def test_outlined_accepts_unused_arguments():
    # Whole numbers, since the compiler sees that 0·n is 0.
    def run(v, n, table):
        return looped(lambda k, v: 0.5 * v + (0 * n).astype(v.dtype) + 0 * table[0])(v)

    def whole(v, n, table):
        return outlined(run, v, n, large=(table,))

    args = V, jnp.asarray(3), jnp.zeros(5000, int).astype(float)
    program = jax.jit(lambda v, n, table: whole(v, n, 0.0 * table)).lower(*args).compile()
    assert is_one(program)
    np.testing.assert_allclose(program(*args), run(*args))


def test_outlined_accepts_computed_arguments_that_are_eliminated():
    def run(v, table):
        return looped(lambda k, v: 0.5 * v + jnp.where(table[k] == table[k], 0.0, 1.0))(v)

    whole = jax.jit(lambda v, t: outlined(run, v, large=(t + v[0],)))
    np.testing.assert_allclose(whole(V, jnp.zeros(5000)), 0.5**7 * V)
    # A linear system: what a step began with is of no use to the derivative of the step.
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.WholeSpace(),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: 0.5 * x - u,
    )  # fmt: skip
    end = lambda x: dvax.solve(problem, x, 0.0, 1.0, dt=0.01).xs[-1]  # noqa: E731
    assert float(jax.grad(end)(1.0)) == pytest.approx(np.exp(-0.75), rel=1e-4)


def test_outlined_passes_closed_over_values_as_arguments():
    @jax.jit
    def outer(v, scale, long):
        near = outlined(looped(lambda k, v: v * scale), v)
        return near, outlined(looped(lambda k, v: v * long[k]), v)

    near, far = outer(V, jnp.asarray(0.5), 0.5 * jnp.ones(5000))
    np.testing.assert_allclose(near, 0.5**7 * V)
    np.testing.assert_allclose(far, 0.5**7 * V)


def test_outlined_accepts_a_closed_over_random_key():
    key = jax.random.key(3)
    run = looped(lambda k, v: v * jax.random.uniform(jax.random.fold_in(key, k)))
    np.testing.assert_array_equal(outlined(run, V), jax.jit(run)(V))


def test_outlined_keeps_weak_types():
    def run(v, scale):
        return jax.lax.fori_loop(0, 7, lambda k, v: v * scale, v)

    whole = jax.jit(lambda v, scale: outlined(run, v, scale))
    found = whole(V.astype(jnp.float32), 0.5)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, 0.5**7 * V, rtol=1e-6)


def test_outlined_accepts_constant_arguments():
    run = looped(lambda k, v: 0.5 * v + 1.0)
    for n in (5, 999, 8000):
        v = np.random.default_rng(0).normal(size=n)
        np.testing.assert_allclose(jax.jit(lambda v=v: outlined(run, jnp.asarray(v)))(), run(v))


@pytest.mark.parametrize("n", mostly_thorough([9, 3000, 50_000], [9, 50_000]))
def test_outlined_accepts_long_constants_beside_computed_arguments(n):
    # The compiler ends the process over a long constant beside another argument.
    table = jnp.asarray(np.random.default_rng(0).normal(size=n))

    def first(v, t):
        def turn(k, carry):
            v, rows = carry
            return v * t[k], jax.lax.dynamic_update_index_in_dim(rows, v[0], k, 0)

        return jax.lax.fori_loop(0, 7, turn, (v, jnp.zeros(n)))

    def second(v, t, rows):
        return looped(lambda k, v: v + t[k] * rows[k])(v)

    def whole(v, t):
        rows = outlined(first, v, t)[1]
        return outlined(second, v, t, large=(rows,))

    exact = second(V, table, first(V, table)[1])
    for found in (
        jax.jit(lambda: whole(V, table))(),
        jax.jit(lambda v: whole(v, table))(V),
        jax.jit(whole)(V, table),
    ):
        np.testing.assert_allclose(found, exact)


@pytest.mark.slow
def test_outlined_batch_and_its_derivatives_equal_those_of_the_plain_program():
    run = looped(lambda k, v: jax.lax.dynamic_update_index_in_dim(jnp.sin(v), v[k % N], 1, 0))
    whole = lambda v: outlined(run, v)  # noqa: E731
    for lanes in (20, 700):
        many = jnp.stack([V * s for s in np.linspace(0.5, 2.0, lanes)])
        batch = jax.jit(jax.vmap(whole)).lower(many).compile()
        assert is_one(batch) == (lanes == 20)
        np.testing.assert_allclose(batch(many), jax.vmap(run)(many), rtol=1e-13)
    derivative = jax.jit(lambda v: jax.jvp(whole, (v,), (v,)))
    for found, exact in zip(derivative(V), jax.jvp(run, (V,), (V,)), strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-13)
    # The tangent program is plain: it can be transposed, and so can that of a map over rows.
    squares = lambda v: jax.lax.map(lambda s: s**2, v)  # noqa: E731
    back = jax.jit(jax.grad(lambda v: jnp.sum(outlined(squares, v))))
    np.testing.assert_allclose(back(V), 2.0 * V)


def test_outlined_jacfwd_equals_that_of_the_plain_program():
    # A product of a matrix and a vector becomes one of matrices, which a library does.
    M, v = jnp.asarray(np.random.default_rng(0).normal(size=(8, 8)) / 4), jnp.arange(8.0) / 8
    run = lambda v: looped(lambda k, v: jnp.tanh(M @ v))(v)  # noqa: E731
    whole = jax.jit(jax.jacfwd(lambda v: outlined(run, v)))
    np.testing.assert_allclose(whole(v), jax.jacfwd(run)(v), atol=1e-14)


def test_outlined_jvp_is_finite_with_undifferentiated_arguments():
    """The derivative of a constant argument, infinite here, is not computed."""
    run = lambda v, a: looped(lambda k, v: v * jnp.sqrt(a) + jnp.abs(v) ** a)(v)  # noqa: E731
    push = lambda v: jax.jvp(lambda v: outlined(run, v, jnp.zeros(())), (v,), (v,))  # noqa: E731
    assert np.isfinite(jax.jit(push)(V)[1]).all()


@pytest.mark.slow
@pytest.mark.parametrize("case", mostly_thorough([c1, c2, c3], [c1]))
def test_outlined_solve_of_a_small_system_is_one_function(case):
    # What makes a step of a small system cheap: should a new operation end it, this says so.
    problem, x0, t1, _, _, args = case()

    def end(x0, rtol):
        return dvax.solve(problem, x0, 0.0, t1, args, rtol=rtol).xs[-1]

    assert is_one(jax.jit(end).lower(jnp.asarray(x0), 1e-4).compile())
