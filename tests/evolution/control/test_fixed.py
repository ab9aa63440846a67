"""Fixed steps: as many as fit between two stops, whatever the stops round to."""

import jax.numpy as jnp
import numpy as np
import pytest

from dvax.evolution.control import step_count


@pytest.mark.parametrize(
    ("dtype", "farthest", "share"), [(float, 1e5, 1e-4), (np.float32, 1e3, 0.02)]
)
def test_intervals_of_whole_numbers_of_steps_have_that_many(dtype, farthest, share):
    rng = np.random.default_rng(0)
    for _ in range(60):
        dt, count = 10.0 ** rng.uniform(-3.0, 2.0), int(rng.integers(1, 200))
        start = rng.choice([-1.0, 1.0]) * dt * farthest ** rng.uniform(0.0, 1.0)
        stops = jnp.asarray(start + dt * count * np.arange(6), dtype)
        found = step_count(stops[:-1], stops[1:], jnp.asarray(dt, dtype))
        assert np.all(found == count)
        # Steps that are too long by more than rounding are one more.
        near = jnp.asarray(dt * count * np.arange(6), dtype)
        shorter = step_count(near[:-1], near[1:], jnp.asarray((1.0 - share) * dt, dtype))
        assert np.all(shorter > count)
