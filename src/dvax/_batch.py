"""What a batch of problems may share."""

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir


def any_lane(condition: jax.Array) -> jax.Array:
    """Whether the condition holds, and under `jax.vmap` whether it does for any problem of the batch.

    A branch of `lax.cond` on this is left out where no problem needs it. (On a condition of each
    problem's own, every branch would be computed for all.) What the branch returns must then be
    chosen problem by problem.
    """
    return _any_p.bind(condition)


def largest_of_lanes(count: jax.Array) -> jax.Array:
    """The integer, and under `jax.vmap` the largest one of the batch: a loop of so many turns is then
    one loop for all."""
    return _largest_p.bind(count)


def is_active(condition: jax.Array) -> jax.Array:
    """True, and under `jax.vmap` the condition: whether the turn of a loop that goes on while *any*
    problem of a batch needs it (`any_lane`) is one of this problem's own.

    A loop on a condition of each problem's own would, after every turn, choose between old and new for
    all that it carries. Here what is written row by row need not be chosen as a whole.
    """
    return _own_p.bind(condition)


def zeros_like_lanes(t: jax.Array) -> jax.Array:
    """Zeros, and under `jax.vmap` a batch of them where t is one: what has a batch of tangents is to be
    one itself."""
    return _zeros_p.bind(t)


def _shared(name: str, join) -> Primitive:
    primitive = Primitive(name)
    primitive.def_impl(lambda value: value)
    primitive.def_abstract_eval(lambda value: value)
    mlir.register_lowering(primitive, lambda ctx, value: [value])
    batching.primitive_batchers[primitive] = lambda given, axes: (
        primitive.bind(join(given[0], axis=axes[0])),
        None,
    )
    return primitive


_any_p = _shared("any_lane", jnp.any)
_largest_p = _shared("largest_of_lanes", jnp.max)


def _same_for_each(name: str, made, of_batch) -> Primitive:
    primitive = Primitive(name)
    primitive.def_impl(made)
    primitive.def_abstract_eval(lambda value: value)
    mlir.register_lowering(primitive, mlir.lower_fun(made, multiple_results=False))
    batching.primitive_batchers[primitive] = lambda given, axes: (of_batch(given[0]), axes[0])
    return primitive


_own_p = _same_for_each("is_active", jnp.ones_like, lambda value: value)
_zeros_p = _same_for_each("zeros_like_lanes", jnp.zeros_like, lambda value: _zeros_p.bind(value))
