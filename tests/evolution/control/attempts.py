"""Attempted steps for the tests of the step-size controller."""

import jax.numpy as jnp

from dvax.evolution.control.error_test import Attempt

NO, YES = jnp.asarray(False), jnp.asarray(True)


def attempt(error, size, horizon=1.0, smallest=1e-14):
    return Attempt(
        size=jnp.asarray(size), smallest=jnp.asarray(smallest),
        error=jnp.asarray(error), modulus=jnp.asarray(error),
        unit=jnp.asarray(1.0),
        integrated=jnp.asarray(error * size / horizon), roundoff=jnp.asarray(0.0),
        finite=YES, usable=YES,
    )  # fmt: skip
