"""The arguments of a compiled program as a flat list of numbers and one hashable static argument.

`jax.jit` finds the compiled program of a flat list in microseconds; for a problem with its functions it
would take longer than a short run. Modules are flattened once, since that takes microseconds too.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.tree_util as jtu

from .. import _tree
from .._once import once_per_object
from ..errors import input_error


class Signature(NamedTuple):
    """The static argument: the tree structures of the parts of the code and of the data, the static
    leaves, and the options."""

    code: tuple[Any, ...]
    data: Any
    static: tuple[Any, ...]
    options: Any

    def unflatten(self, numbers: list[Any]) -> tuple[list[Any], Any]:
        """Return the parts of the code, and the data, whose numbers these are."""
        leaves = [r[1] if n is None else n for n, r in zip(numbers, self.static, strict=True)]
        code, start = [], 0
        for tree in self.code:
            end = start + tree.num_leaves
            code.append(jtu.tree_unflatten(tree, leaves[start:end]))
            start = end
        return code, jtu.tree_unflatten(self.data, leaves[start:])


class Flat(NamedTuple):
    """A part of the code, flattened: its structure, its arrays with None for static leaves, the keys of
    the static leaves with None for arrays, whether no array is traced, and a `key` of all but the
    values of the arrays."""

    tree: Any
    numbers: list[Any]
    static: tuple[Any, ...]
    is_concrete: bool
    key: Any


def flatten(code: tuple[Any, ...], data: Any, options: Any) -> tuple[list[Any], Signature]:
    """Return the numbers in the parts of `code` and in `data`, with None for static leaves, and the
    signature.

    Python floats in the data are traced, so that a new tolerance does not recompile. In the code
    (settings of a solver) they are static, since they may decide a branch.
    """
    parts = [flat(part) for part in code]
    leaves, tree = jtu.tree_flatten(data)
    last = [_number(leaf) for leaf in leaves]
    keys = tuple(
        _exact_key(leaf) if number is None else None
        for leaf, number in zip(leaves, last, strict=True)
    )
    numbers = [*(n for part in parts for n in part.numbers), *last]
    static = (*(key for part in parts for key in part.static), *keys)
    return numbers, Signature(tuple(part.tree for part in parts), tree, static, options)


def _number(leaf: Any) -> Any:
    """Return a leaf of the data that is traced, else None; np.float64 as a float, whose type it has."""
    if isinstance(leaf, float):
        return float(leaf)
    return leaf if eqx.is_array(leaf) else None


def flat(part: Any) -> Flat:
    """Return a part of the code flattened.

    **Raises:** `dvax.InputError` if a static leaf is not hashable.
    """
    return _flat_module(part) if isinstance(part, eqx.Module) else _flat(part)


def _flat(part: Any) -> Flat:
    leaves, tree = jtu.tree_flatten(part)
    numbers = [leaf if eqx.is_array(leaf) else None for leaf in leaves]
    static = tuple(
        _exact_key(leaf) if number is None else None
        for leaf, number in zip(leaves, numbers, strict=True)
    )
    shapes = tuple(None if n is None else (n.shape, n.dtype) for n in numbers)
    return Flat(tree, numbers, static, _tree.is_concrete(numbers), (tree, static, shapes))


_flat_module = once_per_object(_flat)


def _exact_key(leaf: Any) -> tuple[Any, ...]:
    """Return a hashable key of a static leaf that distinguishes 1, True and 1.0, and 0.0 and −0.0."""
    try:
        hash(leaf)
    except TypeError as error:
        raise input_error(
            "dvax.solve(problem, args)",
            f"{type(leaf).__name__} {_tree.line(leaf)}",
            "values that are not arrays are static arguments, which must be hashable",
            "Register its class as a pytree (such as an equinox.Module), or make it hashable",
        ) from error
    return type(leaf), leaf, math.copysign(1.0, leaf) if isinstance(leaf, float) else None
