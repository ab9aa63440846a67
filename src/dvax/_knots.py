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


def near_ends(listed: list[Any], t0: float, t1: float, eps: float) -> list[float]:
    """Return the known knots inside (t0, t1) that are no rounded ends, and as close to one as if they
    were: steps do not end there, and a jump at such a time is missed."""
    known = [np.ravel(np.asarray(knots, float)) for knots in listed if _tree.is_concrete(knots)]
    knots = np.unique(np.concatenate([np.zeros(0), *known]))
    gaps = np.minimum(knots - t0, t1 - knots) / (eps * max(abs(t0), abs(t1), 1e-300))
    return knots[(gaps > KNOT_ULPS) & (gaps <= END_ULPS)].tolist()


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
