"""What a batch of problems may share."""

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir


def any_of_batch(condition: jax.Array) -> jax.Array:
    """Whether the condition holds, and under `jax.vmap` whether it does for any problem of the batch.

    A branch of `lax.cond` on this is left out where no problem needs it. (On a condition of each
    problem's own, every branch would be computed for all.) What the branch returns must then be
    chosen problem by problem.
    """
    return _any_p.bind(condition)


_any_p = Primitive("any_of_batch")
_any_p.def_impl(lambda condition: condition)
_any_p.def_abstract_eval(lambda condition: condition)
mlir.register_lowering(_any_p, lambda ctx, condition: [condition])
batching.primitive_batchers[_any_p] = lambda given, axes: (
    _any_p.bind(jnp.any(given[0], axis=axes[0])),
    None,
)
