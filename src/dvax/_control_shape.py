"""The shape of u, as far as P and K determine it."""

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


def control_zero(P: Any, K: Any, x: Tree) -> Tree | None:
    """Return the zero of the control space that P and K determine, or None if they do not.

    They do not determine it if both accept elements of the shape of x, if all their arrays are single
    numbers, or if several shapes fit. Callables (such as a set that depends on time) are not evaluated.
    """
    parts = [part for part in (P, K) if isinstance(part, AbstractOperator | AbstractSet)]
    if not any(map(np.ndim, _arrays(parts))) or _accept(parts, x):
        return None
    zero = _unique_zero(parts, jnp.result_type(*jtu.tree_leaves(x)))
    return zero if zero is not None and _accept(parts, zero) else None


def _arrays(parts: list[Any]) -> list[Any]:
    """Return the arrays in operators and sets, which may contain functions as well."""
    return [leaf for leaf in jtu.tree_leaves(parts) if hasattr(leaf, "shape")]


def _unique_zero(parts: list[Any], dtype: Any) -> Tree | None:
    """Return the zero of the only shape of lowest rank that all parts accept, or None."""
    products = [p for p in parts if isinstance(p, operators.Product | sets.Product)]
    if products:
        if len({len(p.parts) for p in products}) != 1:
            return None
        zeros = tuple(
            _unique_zero(list(column), dtype)
            for column in zip(*(p.parts for p in products), strict=True)
        )
        return None if any(zero is None for zero in zeros) else zeros
    shapes = {np.shape(leaf) for leaf in _arrays(parts)}
    candidates = {shape for s in shapes for shape in (s, s[:1], s[-1:], s[1:])} - {()}
    accepted = [zero for s in sorted(candidates) if _accept(parts, zero := jnp.zeros(s, dtype))]
    # A matrix accepts matrices as well, but acts on vectors here.
    lowest = [zero for zero in accepted if zero.ndim == min(other.ndim for other in accepted)]
    return lowest[0] if len(lowest) == 1 else None


def _accept(parts: list[Any], like: Tree) -> bool:
    """Return whether all these operators and sets accept elements shaped like `like`."""
    for part in parts:
        try:
            if isinstance(part, AbstractSet):
                part.check(like)
            elif not _tree.same_shape(jax.eval_shape(part.apply, like), like):
                return False
        except (InputError, TypeError, ValueError, IndexError, AttributeError):
            return False  # the operator cannot be applied
    return True
