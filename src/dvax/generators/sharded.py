"""Generators for states that are sharded over several devices."""

import jax
from jax.sharding import NamedSharding

from .. import _tree
from .._tree import Tree
from .abstract import AbstractGenerator
from .elliptic import Elliptic
from .product import Product


def place(A: AbstractGenerator, x: Tree) -> AbstractGenerator:
    """Return A for states that are sharded as x is: A itself unless a transform depends on it."""
    if isinstance(A, Product) and isinstance(x, tuple) and len(x) == len(A.parts):
        parts = tuple(map(place, A.parts, x))
        same = all(a is b for a, b in zip(A.parts, parts, strict=True))
        return A if same else Product(*parts)
    if not isinstance(A, Elliptic) or not isinstance(x, jax.Array) or not _tree.is_concrete(x):
        return A
    sharding = x.sharding
    if not isinstance(sharding, NamedSharding) or len(sharding.device_set) == 1:
        return A
    return A.sharded(sharding) if x.shape == A.transform.shape else A
