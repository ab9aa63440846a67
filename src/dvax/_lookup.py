"""The place of a time in a table: in few operations, because every table is looked up at many places
of a compiled program."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

_LARGEST_COUNT = 32
"""Number of comparisons that XLA adds in one pass on a CPU."""


def count_up_to(times: jax.Array, t: jax.Array) -> jax.Array:
    """Return the number of sorted times ≤ t (of any, if t is NaN).

    Up to 1024 times it counts in every √n-th time and then in the block found, which takes a few
    operations. An unrolled bisection takes hundreds, which were most of the compilation of a problem
    with tables; as a loop it is slower to run.
    """
    t = jnp.asarray(t)
    size = math.isqrt(max(times.shape[0] - 1, 0)) + 1
    if t.ndim or size > _LARGEST_COUNT:
        return jnp.searchsorted(times, t, side="right", method="scan")
    block = jnp.sum(times[::size] <= t, dtype=jnp.int32) - 1
    size = min(size, times.shape[0])
    start = lax.clamp(np.int32(0), block * size, np.int32(times.shape[0] - size))
    inside = lax.dynamic_slice_in_dim(times, start, size, allow_negative_indices=False)
    return start + jnp.sum(inside <= t, dtype=jnp.int32)
