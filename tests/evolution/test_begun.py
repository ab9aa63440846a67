"""Numbers that loops begin with and branches return: that they are handed over, and are the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Literal, jaxpr_as_fun

from dvax._one_function import OUTLINES, in_one_function
from dvax._one_function.begun import handed_over
from dvax._one_function.small import inner_programs

pytestmark = pytest.mark.skipif(
    not OUTLINES,
    reason="on this JAX dvax leaves small programs to XLA",
)

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
    assert sorted(map(float, numbers)) == [0.0, 0.1]
    for found, want in zip(
        jaxpr_as_fun(without)(*numbers, V), jaxpr_as_fun(program)(V), strict=True
    ):  # fmt: skip
        np.testing.assert_array_equal(found, want)


def test_a_short_number_too_small_for_the_way_stays_where_it_is():
    number = np.float32(1e-40)
    run = turned(number)
    assert [float(n) for n in handed_over(jax.make_jaxpr(run)(V))[1]] == [0.0]
    for leaf in jax.jit(lambda v: in_one_function(run, v))(V):
        assert np.asarray(leaf).tobytes() == number.tobytes()
