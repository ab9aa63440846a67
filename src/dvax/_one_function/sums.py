"""Sums of all entries, by parts.

Within one function XLA adds the entries of an array one after the other, each addition waiting for the
one before it. Here sixteen equal parts of the array are added, entry by entry, and again those of the
sum: what a processor adds four or eight at a time, with less rounding besides.

The few entries of a small array are added as they stand: what XLA adds them by is a function, with
memory for each argument and the result that is taken and returned at every call (`begun`).
"""

from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp

_PARTS = 16
_FEW = 4

_BY = {
    "reduce_sum": jnp.add,
    "reduce_max": jnp.maximum,
    "reduce_min": jnp.minimum,
    "reduce_and": jnp.logical_and,
    "reduce_or": jnp.logical_or,
}


def is_sum(eqn: Any) -> bool:
    """Whether all entries of many become one."""
    return _is_of_all(eqn) and eqn.invars[0].aval.size > 2 * _PARTS


def is_short(eqn: Any) -> bool:
    """Whether all entries of a few become one."""
    return _is_of_all(eqn) and 1 < eqn.invars[0].aval.size <= _FEW


def _is_of_all(eqn: Any) -> bool:
    if eqn.primitive.name not in _BY or eqn.outvars[0].aval.shape != ():
        return False
    boolean = eqn.invars[0].aval.dtype == bool
    return boolean == (eqn.primitive.name in ("reduce_and", "reduce_or"))


def one_by_one(eqn: Any, v: jax.Array) -> jax.Array:
    """The sum (maximum, …) of few."""
    return reduce(_BY[eqn.primitive.name], list(v.ravel()))


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
