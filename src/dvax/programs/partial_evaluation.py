"""Partial evaluation: the part of a function of t that does not depend on t is computed once.

Operations on constants alone are computed where the function is evaluated partially; those that depend
on t are kept as a list, and run at each call. A call of a function, a loop or a condition is one
operation: some functions have rules or derivatives of their own.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu

from .._jax.jaxprs import CALLS, bind
from .._tree import Tree
from .interpreter import Domain, interpret


class _Later(NamedTuple):
    """The number of a value that depends on t."""

    number: int


class _Known(NamedTuple):
    """The number of an array that does not."""

    number: int


class _Program:
    """The operations that depend on t, with their operands, and the operands that are the results."""

    def __init__(self, operations: list[tuple[Any, list[Any]]], results: list[Any], tree: Any):
        self.operations, self.results, self.tree = operations, results, tree


class PartialEvaluation(eqx.Module):
    """fn(t), whose operations on constants have been computed.

    ```python
    >>> import jax.numpy as jnp
    >>> from dvax.programs.partial_evaluation import PartialEvaluation
    >>> fn = PartialEvaluation.of(lambda t: t * jnp.sum(jnp.arange(4.0)), 0.0)
    >>> [float(fn(2.0)), len(fn.known)]
    [12.0, 1]

    ```
    """

    known: list[jax.Array]
    program: _Program = eqx.field(static=True)

    @staticmethod
    def of(fn: Callable[[Any], Tree], t: Any) -> "PartialEvaluation":
        """Evaluate fn partially, for arguments of the type of t; fn returns a pytree of arrays."""
        traced, shape = jax.make_jaxpr(fn, return_shape=True)(t)
        operations: list[tuple[Any, list[Any]]] = []
        known: list[jax.Array] = []
        numbers: dict[int, _Known] = {}
        count = 1

        def operand(value: Any) -> Any:
            if not isinstance(value, jax.Array):
                return value  # a literal, or a `_Later`
            if id(value) not in numbers:
                numbers[id(value)] = _Known(len(known))
                known.append(value)
            return numbers[id(value)]

        def keep(eqn: Any, operands: list[Any]) -> list[Any]:
            nonlocal count
            operations.append((eqn, list(map(operand, operands))))
            results = [_Later(count + k) for k in range(len(eqn.outvars))]
            count += len(results)
            return results

        domain = Domain(
            rules=dict.fromkeys(CALLS, keep),
            is_abstract=lambda value: isinstance(value, _Later),
            unknown=keep,
        )
        results = list(map(operand, interpret(traced, [_Later(0)], domain)))
        return PartialEvaluation(known, _Program(operations, results, jtu.tree_structure(shape)))

    def __call__(self, t: Any) -> Tree:
        later = [t]

        def value(operand: Any) -> Any:
            if isinstance(operand, _Later):
                return later[operand.number]
            return self.known[operand.number] if isinstance(operand, _Known) else operand

        for eqn, operands in self.program.operations:
            later += bind(eqn, list(map(value, operands)))
        return self.program.tree.unflatten(map(value, self.program.results))
