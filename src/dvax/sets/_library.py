"""Which sets a set consists of, and whether this library knows all of them."""

import jax.tree_util as jtu

from .abstract import AbstractSet


def sets_in(K: AbstractSet) -> list[AbstractSet]:
    """Return K and all sets that it is made of."""
    inner = jtu.tree_leaves(list(vars(K).values()), is_leaf=lambda v: isinstance(v, AbstractSet))
    return [K, *(s for v in inner if isinstance(v, AbstractSet) for s in sets_in(v))]


def is_of_library(K: AbstractSet) -> bool:
    """Return whether K is made of sets of this library, which consist of arrays alone: another set may
    hold a function that uses t."""
    return all(type(s).__module__.startswith("dvax.sets.") for s in sets_in(K))
