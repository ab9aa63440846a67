"""How XLA is asked for one function."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jax.interpreters import mlir

_ATTRIBUTES = {"inlineable": "false", "xla_cpu_small_call": "true"}


def as_one(call: Callable[..., Any], *args: Any) -> Any:
    """call(*args), compiled as one function.

    The compiler stops at an argument that turns out to be of no use, or at a long one that turns out to
    be constant.
    """
    marked: Any = set_xla_metadata(jax.jit(call)(*args), **_ATTRIBUTES)
    return marked


def is_of_one_device(context: Any) -> bool:
    """Whether a program that is lowered in this context is that of one device, or of each alone."""
    if isinstance(context, mlir.ShardingContext):
        return context.num_devices == 1
    return context.manual_axes == frozenset(context.mesh.axis_names)


def available() -> bool:
    return jax.default_backend() == "cpu" and _compiles()


@functools.cache
def _compiles() -> bool:
    """Whether this XLA compiles a loop with a branch and a product so."""

    def turn(k: Any, v: jax.Array) -> jax.Array:
        v = jax.lax.cond(v[0] > 1.0, lambda: 0.5 * v, lambda: jnp.flip(v) + v[k])
        return jnp.outer(v, v) @ v / jnp.sum(jnp.exp(v))

    def probe(v: jax.Array) -> Any:
        return as_one(lambda v: jax.lax.fori_loop(0, 3, turn, v), v)

    with jax.ensure_compile_time_eval():
        try:
            jax.jit(probe)(jnp.ones(4)).block_until_ready()
        except jax.errors.JaxRuntimeError:
            return False
    return True
