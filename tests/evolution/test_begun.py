"""Numbers that loops begin with and branches return: that they are handed over, and are the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Literal

from dvax._one_function import in_one_function
from dvax._one_function.begun import handed_over
from dvax._one_function.small import inner_programs

V = jnp.linspace(0.5, 1.5, 3)
NUMBERS = [0.0, -0.0, 1e-310, 0.1, -np.inf, np.nan, 3, -7, 2**40, True, False, 1.0 - 2.0j]


def turned(number):
    """A loop that begins with it, with a loop and a branch within that know it too."""

    def branch(k, z):
        return jax.lax.cond(k > 1, lambda: number, lambda: z)

    def run(v):
        start = jnp.asarray(0), jnp.asarray(number), jnp.asarray(number), jnp.asarray(number)

        def turn(c):
            k, z, last, found = c
            inner = jax.lax.while_loop(
                lambda c: c[0] < k, lambda c: (c[0] + 1, c[2], z), (jnp.asarray(0), found, last)
            )
            return k + 1, jnp.where(v[0] > k, z, inner[1]), branch(k, found), inner[2]

        return jax.lax.while_loop(lambda c: c[0] < 4, turn, start)[1:]

    return run


def of_loops(program):
    """What the loops of a program begin with, and its branches return."""
    for eqn in program.jaxpr.eqns:
        inner = inner_programs(eqn.params)
        if eqn.primitive.name == "while":
            yield from eqn.invars[eqn.params["cond_nconsts"] + eqn.params["body_nconsts"] :]
        if eqn.primitive.name == "cond":
            yield from (atom for branch in inner for atom in branch.jaxpr.outvars)
        for one in inner:
            yield from of_loops(one)


@pytest.mark.parametrize("number", NUMBERS, ids=str)
def test_a_number_arrives_bit_by_bit(number):
    run = turned(number)
    found = jax.jit(lambda v: in_one_function(run, v))(V)
    for leaf in found:
        want = np.asarray(jnp.asarray(number))
        assert leaf.dtype == want.dtype and np.asarray(leaf).tobytes() == want.tobytes()


@pytest.mark.parametrize("dtype", ["float32", "float16", "int8", "uint8", "int32", "uint64"])
def test_a_number_keeps_its_type(dtype):
    run = turned(np.asarray(200.0).astype(dtype))
    found = jax.jit(lambda v: in_one_function(run, v))(V)
    assert [(leaf.dtype, float(leaf)) for leaf in found] == 3 * [
        (dtype, float(np.asarray(200.0).astype(dtype)))
    ]


def test_none_is_left():
    program = jax.make_jaxpr(turned(0.1))(V)
    without, numbers = handed_over(program)
    assert any(isinstance(atom, Literal) for atom in of_loops(program))
    assert not any(isinstance(atom, Literal) for atom in of_loops(without))
    # The counts begin with 0.
    assert sorted(numbers) == [0.0, 0.1]
    for found, want in zip(
        jax.core.eval_jaxpr(without.jaxpr, without.consts, V, numbers),
        jax.core.eval_jaxpr(program.jaxpr, program.consts, V), strict=True,
    ):  # fmt: skip
        np.testing.assert_array_equal(found, want)


@pytest.mark.parametrize("within", [lambda f: f, jax.checkpoint], ids=["plain", "checkpoint"])
@pytest.mark.parametrize("axes", [(0,), (1,), (2,), (0, 2), (0, 1, 2)], ids=str)
def test_rows_of_few_are_added_entry_by_entry(axes, within):
    v = jnp.asarray(np.random.default_rng(5).normal(size=(2, 3, 2)))
    over = [jnp.sum, jnp.max, jnp.min]

    def run(v):
        add = within(lambda c: c + sum(f(v * jnp.cos(c), axes, keepdims=True) for f in over))
        turn = lambda k, c: add(c)  # noqa: E731
        return jax.lax.fori_loop(0, jnp.where(v[0, 0, 0] > 9.0, 4, 3), turn, v)

    program = jax.jit(lambda v: in_one_function(run, v)).lower(v).compile()
    assert (" reduce(" in program.as_text()) == (np.prod([v.shape[a] for a in axes]) > 4)
    np.testing.assert_allclose(program(v), jax.jit(run)(v), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_few_are_added_one_by_one(count):
    v = jnp.asarray(np.random.default_rng(count).normal(size=count))
    over = [jnp.sum, jnp.max, jnp.min, lambda v: jnp.any(v > 0.3), lambda v: jnp.all(v > -0.3)]

    def run(v):
        turn = lambda k, c: [f(v * jnp.cos(c[0] + c[1])) for f in over]  # noqa: E731
        return jax.lax.fori_loop(0, jnp.where(v[0] > 9.0, 4, 3), turn, [f(v) for f in over])

    program = jax.jit(lambda v: in_one_function(run, v)).lower(v).compile()
    assert (" reduce(" in program.as_text()) == (count > 4)
    for found, want in zip(program(v), run(v), strict=True):
        np.testing.assert_allclose(found, want, rtol=1e-13, atol=1e-14)
    gone = program(v.at[0].set(jnp.nan))
    assert all(map(np.isnan, gone[:3]))
