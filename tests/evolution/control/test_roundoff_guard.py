"""The roundoff guard distinguishes roundoff from the error of a method."""

import jax.numpy as jnp
import numpy as np
import pytest
from tests.evolution.control.attempts import NO, YES

from dvax.evolution.control.roundoff_guard import RoundoffGuard


def after_sizes(error_at, order, sizes):
    guard = RoundoffGuard.at_start(jnp.asarray(1.0))
    for k, h in enumerate(sizes):
        guard = guard.after(jnp.asarray(h), jnp.asarray(error_at(h)), YES, float(k), order)
    return guard


@pytest.mark.parametrize("order", [1, 2, 4])
def test_roundoff_guard_does_not_mistake_a_method_error_for_noise(order):
    guard = after_sizes(lambda h: 5.0 * h**order, order, 0.5 ** np.arange(6))
    assert float(guard.noise_floor) == 0.0


@pytest.mark.parametrize("order", [1, 2, 4])
def test_roundoff_guard_doubles_steps_if_the_error_does_not_decrease(order):
    rng = np.random.default_rng(order)
    guard = after_sizes(lambda h: rng.uniform(1.0, 2.0), order, 0.5 ** np.arange(6))
    assert float(guard.noise_floor) >= 1.0
    assert bool(guard.is_noise(jnp.asarray(1.0), order))
    assert float(guard.lengthen(jnp.asarray(0.01), 0.1, YES)) == pytest.approx(0.2)
    assert float(guard.lengthen(jnp.asarray(0.01), 0.1, NO)) == 0.01


@pytest.mark.parametrize("error", [0.05, 1e5])
def test_roundoff_guard_ignores_negligible_errors_and_errors_of_jumps(error):
    guard = after_sizes(lambda h: error, 2, 0.5 ** np.arange(6))
    assert float(guard.noise_floor) == 0.0


def test_roundoff_guard_tries_twice_the_step_size_at_growing_intervals():
    """The first trial comes after 128 steps, later ones at growing intervals."""
    guard = RoundoffGuard.at_start(jnp.asarray(1.0))
    trials = []
    for k in range(1, 600):
        in_a_row = float(k - (trials[-1] if trials else 0))
        now = guard.after(jnp.asarray(1.0), jnp.asarray(0.5), YES, in_a_row, 2)
        if float(now.noise_floor) > 0.0:
            trials.append(k)
            # The trial finds an error of the method.
            now = now.after(jnp.asarray(2.0), jnp.asarray(2.5), NO, 0.0, 2)
        guard = now
    assert trials[0] == 128 and trials[1] - trials[0] == 256
