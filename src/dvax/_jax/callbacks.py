"""The callback with a result and an effect, which JAX keeps among its experiments."""

from jax.experimental import io_callback as io_callback
