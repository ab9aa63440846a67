"""The arguments of a compiled program as a flat list of numbers and one hashable static argument.

`jax.jit` finds the compiled program of a flat list in microseconds; for a problem with its functions it
would take longer than a short run.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.tree_util as jtu

from .. import _tree
from ..errors import InputError, InputProblem


class Signature(NamedTuple):
    """The static argument: the tree structures of code and data, the static leaves, and the options."""

    code: Any
    data: Any
    static: tuple[Any, ...]
    options: Any

    def unflatten(self, numbers: list[Any]) -> tuple[Any, Any]:
        """Return the code and the data whose numbers these are."""
        leaves = [r[1] if n is None else n for n, r in zip(numbers, self.static, strict=True)]
        split = self.code.num_leaves
        code = jtu.tree_unflatten(self.code, leaves[:split])
        return code, jtu.tree_unflatten(self.data, leaves[split:])


def flatten(code: Any, data: Any, options: Any) -> tuple[list[Any], Signature]:
    """Return the numbers in `code` and `data`, with None for static leaves, and the signature.

    Python floats in the data are traced, so that a new tolerance does not recompile. In the code
    (settings of a solver) they are static, since they may decide a branch.
    """
    code, code_tree = jtu.tree_flatten(code)
    data, data_tree = jtu.tree_flatten(data)
    numbers = [leaf if eqx.is_array(leaf) else None for leaf in code]
    numbers += [leaf if isinstance(leaf, float) or eqx.is_array(leaf) else None for leaf in data]
    static = tuple(
        _exact_key(leaf) if number is None else None
        for leaf, number in zip(code + data, numbers, strict=True)
    )
    return numbers, Signature(code_tree, data_tree, static, options)


def _exact_key(leaf: Any) -> tuple[Any, ...]:
    """Return a hashable key of a static leaf that distinguishes 1, True and 1.0, and 0.0 and −0.0."""
    try:
        hash(leaf)
    except TypeError as error:
        raise InputError(
            InputProblem(
                "dvax.solve(problem, args)",
                f"{type(leaf).__name__} {_tree.line(leaf)}",
                "values that are not arrays are static arguments, which must be hashable",
                "Register its class as a pytree (such as an equinox.Module), or make it hashable",
            )
        ) from error
    return type(leaf), leaf, math.copysign(1.0, leaf) if isinstance(leaf, float) else None
