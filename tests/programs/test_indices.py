"""Constant indices outside of an array are found, and those inside or on purpose are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dvax.programs.indices import index_outside

OUTSIDE = {
    "number": (lambda x: x[4], 4),
    "from the end": (lambda x: x[-5], -1),
    "array": (lambda x: x[jnp.array([0, 9, 1])], 9),
    "array of NumPy": (lambda x: x[np.array([-6, 1])], -2),
    "in an inner program": (lambda x: jax.jit(lambda v: v[5])(x), 5),
    "of a matrix": (lambda x: x.reshape(2, 2)[1, 2], 2),
}
INSIDE = {
    "last": lambda x: x[3] + x[-4],
    "slice": lambda x: x[2:9],
    "array": lambda x: x[jnp.array([0, 3])],
    "clipped": lambda x: x.at[9].get(mode="clip"),
    "filled": lambda x: jnp.take(x, jnp.array([0, 9])),
    "of the state": lambda x: x[jnp.argmax(x)],
    "interpolation": lambda x: jnp.interp(x, jnp.arange(3.0), jnp.arange(3.0)),
    "no entries": lambda x: x[jnp.zeros(0, int)],
    "dropped": lambda x: x.at[jnp.array([0, 4])].add(1.0),
    "roll": lambda x: jnp.roll(x, 2),
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_index_outside_of_an_array_is_found(name):
    fn, index = OUTSIDE[name]
    wrong = index_outside(jax.make_jaxpr(fn)(jnp.zeros(4)))
    assert wrong is not None and wrong.index == index
    assert any("test_indices" in file for file, _ in wrong.lines)


@pytest.mark.parametrize("name", INSIDE)
def test_index_inside_of_an_array_or_with_a_mode_is_accepted(name):
    assert index_outside(jax.make_jaxpr(INSIDE[name])(jnp.zeros(4))) is None


def test_index_that_is_traced_is_not_examined():
    def examined(k):
        assert index_outside(jax.make_jaxpr(lambda x: x[k])(jnp.zeros(4))) is None
        return k

    assert jax.jit(examined)(9) == 9
