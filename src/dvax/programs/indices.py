"""Constant indices outside of an array, which JAX replaces by the nearest entry without an error."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._jax.jaxprs import bind, source_lines
from .interpreter import Domain, Rule, interpret

_MAX_SIZE = 4096
"""Largest number of indices of one operation that are examined."""


class IndexOutside(NamedTuple):
    """An index, the number of entries of its axis, and (file, line) of the calls, innermost first."""

    index: int
    entries: int
    lines: list[tuple[str, int]]


class _Unknown(NamedTuple):
    """A value that depends on the inputs, or that is not computed here."""


def index_outside(program: Any) -> IndexOutside | None:
    """Return the first read at a constant index outside of its array in a program, or None.

    Bodies of loops and of conditionals are not examined, nor are modes such as "clip" and "fill",
    which allow such an index. A negative index is that after JAX has added the number of entries.
    """
    outside: list[IndexOutside] = []

    def unknown(eqn: Any, _: list[Any]) -> list[Any]:
        return [_Unknown()] * len(eqn.outvars)

    def evaluate(eqn: Any, operands: list[Any]) -> list[Any]:
        if eqn.effects or not all(map(_is_index, operands)) or not operands:
            return unknown(eqn, operands)
        # Only here: a function of JAX that is traced in this context has another program.
        with jax.ensure_compile_time_eval():
            return bind(eqn, operands)

    def apply(rule: Rule, eqn: Any, operands: list[Any]) -> list[Any]:
        for index, entries in rule(eqn, operands):
            if not 0 <= index < entries:
                outside.append(IndexOutside(index, entries, source_lines(eqn)))
        return unknown(eqn, operands)

    domain = Domain(RULES, lambda v: isinstance(v, _Unknown), unknown, apply, evaluate)
    interpret(program, [_Unknown()] * len(program.jaxpr.invars), domain)
    return outside[0] if outside else None


def _is_index(value: Any) -> bool:
    """Return whether a value is a concrete array of a few integers or Booleans."""
    dtype = jnp.result_type(value)  # that of a random key is neither
    is_whole = jnp.issubdtype(dtype, jnp.integer) or jnp.issubdtype(dtype, jnp.bool_)
    return is_whole and np.size(value) <= _MAX_SIZE and _tree.is_concrete(value)


def _slice(eqn: Any, operands: list[Any]) -> Iterator[tuple[int, int]]:
    shape = eqn.invars[0].aval.shape
    for start, size, entries in zip(operands[1:], eqn.params["slice_sizes"], shape, strict=True):
        if not isinstance(start, _Unknown) and _is_index(start):
            yield int(start), entries - size + 1


def _gather(eqn: Any, operands: list[Any]) -> Iterator[tuple[int, int]]:
    indices, shape = operands[1], eqn.invars[0].aval.shape
    checked = "PROMISE_IN_BOUNDS" in str(eqn.params["mode"])
    if (
        not checked
        or isinstance(indices, _Unknown)
        or not _is_index(indices)
        or not np.size(indices)
    ):
        return
    columns = np.asarray(indices).reshape(-1, np.shape(indices)[-1])
    for axis, column in zip(
        eqn.params["dimension_numbers"].start_index_map, columns.T, strict=True
    ):
        entries = shape[axis] - eqn.params["slice_sizes"][axis] + 1
        yield int(column.max()), entries
        yield int(column.min()), entries


RULES: dict[str, Rule] = {"dynamic_slice": _slice, "gather": _gather}
"""The pairs (index, number of entries of the axis) of an operation."""
