"""Sums of all entries, by parts.

Within one function XLA adds the entries of an array one after the other, each addition waiting for the
one before it. Here sixteen equal parts of the array are added, entry by entry, and again those of the
sum: what a processor adds four or eight at a time, with less rounding besides.
"""

from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp

_PARTS = 16

_BY = {
    "reduce_sum": jnp.add,
    "reduce_max": jnp.maximum,
    "reduce_min": jnp.minimum,
    "reduce_and": jnp.logical_and,
    "reduce_or": jnp.logical_or,
}


def is_sum(eqn: Any) -> bool:
    """Whether all entries of many become one."""
    if eqn.primitive.name not in _BY or eqn.outvars[0].aval.shape != ():
        return False
    aval = eqn.invars[0].aval
    boolean = aval.dtype == bool
    return aval.size > 2 * _PARTS and boolean == (eqn.primitive.name in ("reduce_and", "reduce_or"))


def by_parts(eqn: Any, v: jax.Array) -> jax.Array:
    """The sum (maximum, …) of all entries."""
    join = _BY[eqn.primitive.name]
    v = v.ravel()
    while v.size > 2 * _PARTS:
        own = v.size // _PARTS
        total = reduce(join, [v[k * own : (k + 1) * own] for k in range(_PARTS)])
        rest = v[_PARTS * own :]
        if rest.size:
            # Fewer than there are parts.
            m = min(rest.size, own)
            total = jnp.concatenate([join(total[:m], rest[:m]), total[m:]])
            total = jnp.concatenate([total, rest[m:]])
        v = total
    return eqn.primitive.bind(v, **eqn.params | {"axes": (0,)})
