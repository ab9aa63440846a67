"""The shape of u where P and K fix it."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from . import _tree, operators, sets
from ._tree import Tree
from .errors import InputError
from .operators import AbstractOperator
from .sets import AbstractSet


def fixed_by(P: Any, K: Any, x: Tree) -> Tree | None:
    """Return a zero of the control space that P and K fix, or None where they leave it open.

    They leave it open where both accept elements of the shape of x, or every array in them is a single
    number, or several shapes fit. Callables (a set that moves) are not evaluated.
    """
    parts = [part for part in (P, K) if isinstance(part, AbstractOperator | AbstractSet)]
    if not any(map(np.ndim, _arrays(parts))) or _accept(parts, x):
        return None
    found = _fixed(parts, jnp.result_type(*jtu.tree_leaves(x)))
    return found if found is not None and _accept(parts, found) else None


def _arrays(parts: list[Any]) -> list[Any]:
    """The arrays in operators and sets, which may hold functions as well."""
    return [leaf for leaf in jtu.tree_leaves(parts) if hasattr(leaf, "shape")]


def _fixed(parts: list[Any], dtype: Any) -> Tree | None:
    products = [p for p in parts if isinstance(p, operators.Product | sets.Product)]
    if products:
        if len({len(p.parts) for p in products}) != 1:
            return None
        found = tuple(
            _fixed(list(each), dtype) for each in zip(*(p.parts for p in products), strict=True)
        )
        return None if any(part is None for part in found) else found
    shapes = {np.shape(leaf) for leaf in _arrays(parts)}
    tried = {cut for s in shapes for cut in (s, s[:1], s[-1:], s[1:])} - {()}
    fitting = [zero for s in sorted(tried) if _accept(parts, zero := jnp.zeros(s, dtype))]
    # A matrix can be applied to matrices as well, and is meant for vectors.
    fewest = [zero for zero in fitting if zero.ndim == min(each.ndim for each in fitting)]
    return fewest[0] if len(fewest) == 1 else None


def _accept(parts: list[Any], like: Tree) -> bool:
    """Whether each of these operators and sets is one of elements shaped as `like`."""
    for part in parts:
        try:
            if isinstance(part, AbstractSet):
                part.check(like)
            elif not _tree.same_shape(jax.eval_shape(part.apply, like), like):
                return False
        except (InputError, TypeError, ValueError, IndexError, AttributeError):
            return False  # an operator that cannot even be applied
    return True
