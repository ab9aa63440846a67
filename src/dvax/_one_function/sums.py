"""Sums of all entries, by parts.

Within one function XLA adds the entries of an array one after the other, each addition waiting for the
one before it. Here sixteen equal parts of the array are added, entry by entry, and again those of the
sum: what a processor adds four or eight at a time, with less rounding besides.

The few entries of a small array are added as they stand: what XLA adds them by is a function, with
memory for each argument and the result that is taken and returned at every call (`begun`).
"""

import itertools
import math
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
    return _can_join(eqn) and eqn.outvars[0].aval.shape == () and _count(eqn) > 2 * _PARTS


def is_short(eqn: Any) -> bool:
    """Whether a few entries become one, or each row of few."""
    return _can_join(eqn) and 1 < _count(eqn) <= _FEW


def _can_join(eqn: Any) -> bool:
    boolean = eqn.primitive.name in ("reduce_and", "reduce_or")
    return eqn.primitive.name in _BY and boolean == (eqn.invars[0].aval.dtype == bool)


def _count(eqn: Any) -> int:
    return math.prod(eqn.invars[0].aval.shape[axis] for axis in eqn.params["axes"])


def one_by_one(eqn: Any, v: jax.Array) -> jax.Array:
    """The sum (maximum, …) of few, or of each row of few."""
    places = itertools.product(
        *(range(n) if k in eqn.params["axes"] else [slice(None)] for k, n in enumerate(v.shape))
    )
    return reduce(_BY[eqn.primitive.name], [v[place] for place in places])


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
