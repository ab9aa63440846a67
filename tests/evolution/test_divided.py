"""Loops that call libraries: that they are divided into few functions, that nothing else changes, and
that no transform is made twice."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax._one_function import OUTLINES, in_one_function, marked
from dvax._one_function.kept import worth_keeping

pytestmark = pytest.mark.skipif(
    not OUTLINES,
    reason="on this JAX dvax leaves small programs to XLA",
)

N = 96
V = jnp.linspace(0.5, 1.5, N)


def transformed(v):
    return jnp.fft.irfft(jnp.fft.rfft(v) * 0.9, v.size)


def compiled(run, *args):
    return jax.jit(lambda *args: in_one_function(run, *args)).lower(*args).compile()


def bodies(program):
    """The parts of a program that call functions of ours and Fourier transforms: how often each."""
    found = []
    for part in program.as_text().split("\n\n"):
        calls = len(re.findall(r' call\(.*inlineable="false",xla_cpu_small_call', part))
        transforms = part.count(" fft(")
        if calls or transforms:
            found.append((calls, transforms))
    return found


def looped(body, turns=7):
    def run(v):
        turn = lambda c: (c[0] + 1, body(*c))  # noqa: E731
        return jax.lax.while_loop(lambda c: c[0] < turns, turn, (jnp.asarray(0), v))[1]

    return run


def real(k):
    return jnp.asarray(k, float)


def several(k, carry):
    """What a carry may hold: tables that are written, whole numbers, truth values, complex ones, what
    is never changed, and what is set to a constant."""
    v, table, count, odd, z, still, _ = carry
    w = transformed(v) + 0.01 * still * real(k)
    table = jax.lax.dynamic_update_index_in_dim(table, w[: table.shape[1]], k, 0)
    z = z * jax.lax.complex(jnp.cos(w[0]), jnp.sum(w))
    return jnp.where(odd, w, v + 1.0 / w), table, count + 1, ~odd, z, still, 3.0


def twice(k, v):
    """A loop within a loop, each with calls."""
    inner = looped(lambda j, w: transformed(w + 0.1 * real(j)) + jnp.sin(w[:1]), 3)
    return 0.5 * inner(v) + transformed(v) ** 2


def chosen(k, v):
    """A call in a branch."""
    return jax.lax.cond(v[0] > 1.0, transformed, lambda v: v + 0.3, v) * 0.9 + jnp.max(v) / 96.0


SPARSE = np.eye(9, k=1) + 3.0 * np.eye(9)
LONG = np.random.default_rng(0).normal(size=N)
CASES = {
    "arithmetic": lambda k, v: (
        jnp.where(v > 1.0, 0.5 * v, transformed(v) + jnp.cos(v)) / real(k + 1)
    ),
    "a long constant": lambda k, v: 0.5 * transformed(v * LONG) + np.sin(LONG),
    "sums": lambda k, v: transformed(v) / (jnp.max(jnp.abs(v)) + jnp.sum(v**2)) + jnp.min(v),
    "a loop within": twice,
    "a branch with a call": chosen,
    "a solve": lambda k, v: v - jnp.linalg.solve(SPARSE + jnp.diag(v[:9]), v[:9] + real(k))[0],
    "parts": lambda k, v: jnp.concatenate([transformed(v)[1:], v[:1]]) * jnp.flip(v),
    "pairs": lambda k, v: jnp.stack([transformed(v)[::2], v[1::2]], 1).reshape(N) - 0.2,
}


@pytest.mark.parametrize("name", CASES)
def test_a_divided_loop_has_the_same_values(name):
    run = looped(CASES[name])
    program = compiled(run, V)
    assert any(calls > 0 for calls, _ in bodies(program))
    np.testing.assert_allclose(program(V), jax.jit(run)(V), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("n", [N, 3000])
def test_a_carry_of_every_kind_is_handed_on(n):
    v, table = jnp.linspace(0.5, 1.5, n), jnp.zeros((7, 70))
    still = jnp.linspace(0.0, 1.0, n)

    def run(v, table, still):
        carry = v, table, jnp.asarray(0), jnp.asarray(True), jnp.asarray(1j), still, 0.0
        return looped(several)(carry)

    program = compiled(run, v, table, still)
    for found, plain in zip(program(v, table, still), jax.jit(run)(v, table, still), strict=True):
        assert found.dtype == plain.dtype
        np.testing.assert_allclose(found, plain, rtol=1e-12, atol=1e-12)


def test_a_table_is_written_where_it_is():
    # Within a function it would be copied, row by row all of it.
    def run(v, table):
        put = jax.lax.dynamic_update_index_in_dim

        def turn(k, carry):
            v, table = carry
            v = transformed(v) + 1.0
            return v, put(table, v, k, 0)

        return looped(turn, 60)((v, table))

    program = compiled(run, V, jnp.zeros((60, N)))
    body = next(part for part in program.as_text().split("\n\n") if " fft(" in part)
    handed = [line for line in body.splitlines() if "xla_cpu_small_call" in line]
    assert handed and not any(f"[60,{N}]" in line.split("metadata")[0] for line in handed)
    np.testing.assert_allclose(
        program(V, jnp.zeros((60, N)))[1], jax.jit(run)(V, jnp.zeros((60, N)))[1], rtol=1e-12
    )


@pytest.mark.parametrize(
    "by",
    [
        jax.vmap,
        lambda f: lambda v: jax.jvp(f, (v[0],), (v[1],))[1],
        lambda f: lambda v: jax.vmap(jax.jacfwd(f))(v[:, :8]),
    ],
    ids=["batch", "derivative", "derivatives of a batch"],
)
def test_batches_and_derivatives_are_those_of_the_loop(by):
    run, given = looped(CASES["sums"], 3), jnp.stack([V, 2.0 - V])
    divided = jax.jit(by(lambda v: in_one_function(run, v)))
    np.testing.assert_allclose(divided(given), jax.jit(by(run))(given), rtol=1e-12, atol=1e-12)


def test_each_of_a_batch_may_end_at_its_own_turn():
    def run(turns, v):
        turn = lambda c: (c[0] + 1, transformed(c[1]) + 1.0)  # noqa: E731
        return jax.lax.while_loop(lambda c: c[0] < turns, turn, (jnp.asarray(0), v))

    turns, given = jnp.array([1, 4, 0]), jnp.stack([V, 2.0 - V, V**2])
    divided = jax.jit(jax.vmap(lambda n, v: in_one_function(run, n, v)))
    count, v = divided(turns, given)
    np.testing.assert_array_equal(count, turns)
    np.testing.assert_allclose(v, jax.jit(jax.vmap(run))(turns, given)[1], rtol=1e-12)


SIZES = mostly_thorough([1, 33, 64, 97, 512, 1000, 4097, 8191], [33, 1000, 4097])


@pytest.mark.parametrize("n", SIZES)
def test_sums_by_parts_are_the_sums(n):
    v = jnp.asarray(np.random.default_rng(n).normal(size=n))
    over = {
        "sum": jnp.sum, "max": jnp.max, "min": jnp.min, "any": lambda v: jnp.any(v > 3.0),
        "all": lambda v: jnp.all(v < 3.0), "square": lambda v: jnp.sum((v**2).reshape(-1, 1)),
    }  # fmt: skip

    def run(v):
        return looped(
            lambda k, c: ([f(v + real(k)) for f in over.values()], c[1] + 0.0 * c[0][0]), 2
        )(([f(v) for f in over.values()], v))[0]

    for name, found, plain in zip(over, compiled(run, v)(v), jax.jit(run)(v), strict=True):
        np.testing.assert_allclose(found, plain, rtol=1e-12, atol=1e-11, err_msg=name)
    # What is not a number is not lost among the parts.
    assert np.isnan(compiled(run, v)(v.at[n // 2].set(jnp.nan))[1])


def test_what_is_long_and_used_often_is_kept():
    def run(v):
        w = v
        for _ in range(9):
            w = jnp.where(w > 1.0, 0.5 * w, w + 0.1)
        cheap = v + 1.0
        return w * 2.0, w * w, cheap * 2.0, cheap * cheap

    program = jax.make_jaxpr(run)(V).jaxpr
    stages = worth_keeping(program.eqns, set(program.outvars), 64)
    # The end of the chain, and it alone; of few entries, nothing.
    assert [len(stage) for stage in stages] == [1]
    made = next(eqn for eqn in program.eqns if stages[0][0] in eqn.outvars)
    assert made is [eqn for eqn in program.eqns if "where" in str(eqn)][-1]
    assert worth_keeping(program.eqns, set(program.outvars), N) == []


def heat(n, boundary="dirichlet"):
    s = (jnp.arange(float(n)) + 0.5) * (jnp.pi / n)
    load = jnp.sin(s)
    problem = dvax.Problem(
        A=dvax.generators.Elliptic(n, jnp.pi, boundary=boundary),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.4),
        f=lambda t, x, u, args: jnp.exp(-t) * load - 0.2 * x - u,
        h=lambda t, x, u, args: 1.0 - 1.5 * x - 0.5 * u,
    )  # fmt: skip
    return problem, load + 0.3 * jnp.cos(3.0 * s)


@pytest.mark.parametrize(
    ("method", "transforms"), [(dvax.ETD2RK(), 4), (dvax.ETD4RK(), 10)], ids=["ETD2RK", "ETD4RK"]
)
@pytest.mark.parametrize("boundary", mostly_thorough(["dirichlet", "periodic"], ["dirichlet"]))
def test_a_step_is_a_chain_of_few_functions(method, transforms, boundary):
    # As many transforms as a step has states and rates that it has not seen, and a function between
    # one and the next.
    problem, x0 = heat(512, boundary)

    def end(x0, rtol):
        return dvax.solve(problem, x0, 0.0, 1.0, rtol=rtol, method=method).xs[-1]

    found = max(bodies(jax.jit(end).lower(x0, 1e-4).compile()), key=lambda pair: pair[1])
    assert found[1] == transforms and found[0] <= transforms + 1


@pytest.mark.parametrize(
    "how",
    mostly_thorough(
        [
            dict(rtol=1e-5),
            dict(rtol=1e-5, method=dvax.ETD4RK()),
            dict(dt=0.02),
            dict(rtol=1e-5, ts=np.linspace(0.1, 1.0, 7)),
            dict(rtol=1e-4, dense=True),
            dict(rtol=1e-5, adjoint="forward"),
            dict(dt=0.02, method=dvax.ExpRosenbrock()),
            dict(dt=0.02, ts=np.linspace(0.1, 1.0, 7)),
        ],
        [dict(rtol=1e-5)],
    ),
    ids=str,
)
def test_a_field_is_solved_as_without(how, monkeypatch):
    # The same arithmetic up to rounding, which may move a step's end by a little.
    # With more entries ExpRosenbrock has matrices that are not small.
    problem, x0 = heat(80)

    def program():
        return jax.jit(lambda x0: dvax.solve(problem, x0, 0.0, 1.0, **how).xs).lower(x0).compile()

    divided = program()
    with monkeypatch.context() as without:
        without.setattr(marked, "_compiles", lambda: False)
        jax.clear_caches()
        plain = program()
    jax.clear_caches()
    assert any(calls for calls, _ in bodies(divided))
    assert not any(calls for calls, _ in bodies(plain))
    apart = np.max(np.abs(np.asarray(divided(x0)) - np.asarray(plain(x0))))
    assert apart <= (2 * how["rtol"] if "rtol" in how else 1e-13)
