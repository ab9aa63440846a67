"""Which of the times that data announce or code shows are knots of a run."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from . import _tree

KNOT_ULPS, END_ULPS = 4, 128
"""Knots nearer than this to each other, or to the ends of a run, in roundings of t, are one: records
round the same moment differently."""


def between(listed: list[Any], t0: Any, t1: Any) -> Any:
    """The times in (t0, t1), sorted, of vectors of them. Where something is traced none can be dropped:
    the others become t1, where a step ends anyway."""
    known = [np.asarray(knots, float) for knots in listed if _tree.is_concrete(knots)]
    known = np.sort(np.concatenate([np.zeros(0), *known]))
    known = known[np.isfinite(known)]
    known = known[_apart(known)]
    if _tree.is_concrete(listed, t0, t1):
        return known[_is_inside(known, t0, t1)]
    # The compiler takes minutes to sort many constants: those inside come first, in their order.
    inside = _is_inside(known, t0, t1)
    first = jnp.argmax(inside) if len(known) else 0
    every = jnp.roll(jnp.where(inside, known, t1), -first)
    computed = [jnp.ravel(knots) for knots in listed if not _tree.is_concrete(knots)]
    if not computed:
        return every
    computed = jnp.concatenate(computed)
    computed = jnp.where(_is_inside(computed, t0, t1), computed, t1)
    every = jnp.sort(jnp.concatenate([every, computed]))
    return jnp.sort(jnp.where(_apart(every), every, t1))


def _apart(knots: Any) -> Any:
    """Which sorted times rounding can tell from the one before."""
    lib = np if _tree.is_concrete(knots) else jnp
    gap = lib.diff(knots, prepend=knots[:1] - 1.0)
    return gap > KNOT_ULPS * jnp.finfo(knots.dtype).eps * lib.abs(knots)


def _is_inside(knots: Any, t0: Any, t1: Any) -> Any:
    """Which times are between t0 and t1, and not these."""
    lib = np if _tree.is_concrete(knots, t0, t1) else jnp
    margin = END_ULPS * jnp.finfo(knots.dtype).eps * lib.maximum(lib.abs(t0), lib.abs(t1))
    return (knots > t0 + margin) & (knots < t1 - margin)
