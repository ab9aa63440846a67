"""Merging of the knots of signals and of code into the knots of a run."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from . import _tree

KNOT_ULPS, END_ULPS = 4, 128
"""Knots closer than this (in units of the roundoff of t) to each other, or to the ends of a run, are
merged: different records round the same time differently."""


def merge(listed: list[Any], t0: Any, t1: Any) -> Any:
    """Return the sorted times in (t0, t1) of several vectors of times.

    With traced times the number of knots is fixed: times outside, and duplicates, are replaced by t1,
    where a step ends anyway.
    """
    concrete = [np.asarray(knots, float) for knots in listed if _tree.is_concrete(knots)]
    concrete = np.sort(np.concatenate([np.zeros(0), *concrete]))
    concrete = concrete[np.isfinite(concrete)]
    concrete = concrete[_is_distinct(concrete)]
    if _tree.is_concrete(listed, t0, t1):
        return concrete[_is_inside(concrete, t0, t1)]
    # XLA takes minutes to compile a sort of many constants, so they are rotated instead: times before
    # t0 become t1 and move to the end.
    inside = _is_inside(concrete, t0, t1)
    first = jnp.argmax(inside) if len(concrete) else 0
    merged = jnp.roll(jnp.where(inside, concrete, t1), -first)
    traced = [jnp.ravel(knots) for knots in listed if not _tree.is_concrete(knots)]
    if not traced:
        return merged
    traced = jnp.concatenate(traced)
    traced = jnp.where(_is_inside(traced, t0, t1), traced, t1)
    merged = jnp.sort(jnp.concatenate([merged, traced]))
    return jnp.sort(jnp.where(_is_distinct(merged), merged, t1))


def near_end(listed: list[Any], t0: Any, t1: Any) -> Any:
    """Return the first knot inside (t0, t1) that is no rounded end, and as close to one as if it were;
    infinity without one. Steps do not end there, and a jump at such a time is missed."""
    knots = jnp.concatenate(
        [jnp.zeros(0, t0.dtype), *(jnp.ravel(v).astype(t0.dtype) for v in listed)]
    )
    ulp = jnp.finfo(t0.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    gaps = jnp.minimum(knots - t0, t1 - knots)
    is_near = (gaps > KNOT_ULPS * ulp) & (gaps <= END_ULPS * ulp)
    return jnp.min(jnp.where(is_near, knots, jnp.inf), initial=jnp.inf)


def _is_distinct(knots: Any) -> Any:
    """Return which sorted times differ from the previous one by more than roundoff."""
    lib = np if _tree.is_concrete(knots) else jnp
    gap = lib.diff(knots, prepend=knots[:1] - 1.0)
    return gap > KNOT_ULPS * jnp.finfo(knots.dtype).eps * lib.abs(knots)


def _is_inside(knots: Any, t0: Any, t1: Any) -> Any:
    """Return which times are strictly between t0 and t1, up to roundoff."""
    lib = np if _tree.is_concrete(knots, t0, t1) else jnp
    margin = END_ULPS * jnp.finfo(knots.dtype).eps * lib.maximum(lib.abs(t0), lib.abs(t1))
    return (knots > t0 + margin) & (knots < t1 - margin)
