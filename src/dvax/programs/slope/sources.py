"""How the values of slope arithmetic were computed, so that a part of a program can be evaluated again.

The value of one branch of a selection matters only where that branch is selected. So its program is
evaluated again with what is known there: the comparison is decided, and the compared value is on one
side of its limit. A function of one value is evaluated again on pieces of its interval (`chains`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.tree_util as jtu
import numpy as np

from .alignment import Axes, operand_axes
from .values import Slope, is_slope

MAX_ENTRIES_KEPT = 4096
"""Values with more entries keep no source, since a source keeps its arguments alive."""

_MAX_DEPTH = 200
"""Largest number of operations one after the other in a source."""

_MAX_EVALUATIONS = 2000
"""Largest number of operations that are evaluated again in one enclosure."""


class Source(NamedTuple):
    """The operation that computed a value.

    - `key`: equal for values of the same operation on the same arguments; inputs have one each;
    - `eqn`, `operands`, `output`: the operation, its arguments, and the number of the result. An input
      has no operation;
    - `depth`: the number of operations one after the other.
    """

    key: int
    eqn: Any
    operands: tuple[Any, ...]
    output: int
    depth: int


class Known(NamedTuple):
    """A value, or whether a relation (`relation_of`) holds, in the entries at these axes: (), if it has
    one entry."""

    value: Any
    axes: Axes


COMPARISONS = frozenset({"lt", "le", "gt", "ge"})


def relation_of(source: Source) -> tuple[Any, bool] | None:
    """Return the key of v < w, and whether a value is this or its opposite; None if it is neither."""
    name = "" if source.eqn is None else source.eqn.primitive.name
    if name not in COMPARISONS:
        return None
    v, w = map(_identity, source.operands)
    if v is None or w is None:
        return None
    return ("less", *((v, w) if name in ("lt", "ge") else (w, v))), name in ("lt", "gt")


def _identity(value: Any) -> Any:
    """Return what is equal for equal values; None if a value has no source."""
    if is_slope(value):
        return None if value.source is None else value.source.key
    array = np.asarray(value)
    is_same = array.size > 0 and bool(np.all(array == array.flat[0]))
    return ("number", float(array.flat[0])) if is_same else (array.shape, array.tobytes())


class Recorder:
    """Attaches sources to values, and evaluates values again.

    `operate` returns the results of an operation by its rule, `tightened` a value with the bounds that
    follow from its chain.
    """

    def __init__(
        self,
        operate: Callable[[Any, list[Any]], list[Any]],
        tightened: Callable[[Any], Any],
    ):
        self._operate = operate
        self.tightened = tightened
        self._keys: dict[Any, int] = {}
        self._kept: list[Any] = []
        self._left = _MAX_EVALUATIONS

    def input(self, value: Slope) -> Slope:
        """Return an input with a source of its own."""
        key = len(self._keys)
        self._keys[("input", key)] = key
        return value._replace(source=Source(key, None, (), 0, 0))

    def result(self, value: Any, eqn: Any, operands: list[Any], output: int) -> Any:
        """Return the result of an operation with its source."""
        if not is_slope(value) or np.size(value.low) > MAX_ENTRIES_KEPT:
            return value
        slopes = [v for v in operands if is_slope(v)]
        if any(v.source is None or v.source.depth >= _MAX_DEPTH for v in slopes):
            return value._replace(source=None)
        depth = 1 + max(v.source.depth for v in slopes)
        of = tuple(self._key(v) for v in operands)
        params = eqn.params.values()
        # The text of a program does not show its constants.
        programs = any(
            hasattr(p, "eqns") or hasattr(p, "jaxpr") for p in jtu.tree_leaves(list(params))
        )
        name = id(self._keep(eqn)) if programs else (eqn.primitive.name, str(eqn.params))
        key = self._keys.setdefault((name, of, output), len(self._keys))
        return value._replace(source=Source(key, eqn, tuple(operands), output, depth))

    def _key(self, value: Any) -> Any:
        if is_slope(value):
            return value.source.key
        array = np.asarray(value)
        if array.size > MAX_ENTRIES_KEPT:
            return id(self._keep(value))
        return (array.shape, array.dtype.str, array.tobytes())

    def _keep(self, value: Any) -> Any:
        """Return a value, which is kept so that no other one gets its id."""
        self._kept.append(value)
        return value

    def again(self, value: Any, known: "dict[Any, Known]", axes: Axes) -> Any:
        """Return a value of these axes with what is known in place of what was before.

        Returns the value as it was where too many operations were evaluated again.
        """
        memo: dict[Any, Any] = {}
        everywhere = any(fact.axes == () for fact in known.values())

        def visit(v: Any, axes: Axes) -> Any:
            if not is_slope(v) or v.source is None or (axes is None and not everywhere):
                return v
            source, shape = v.source, np.shape(v.low)
            key = source.key, axes
            if key in memo:
                return memo[key]
            memo[key] = v
            given, relation = known.get(source.key), relation_of(source)
            if given is not None and given.axes in ((), axes):
                memo[key] = given.value
            elif relation is not None and (fact := known.get(relation[0])) is not None:
                if fact.axes in ((), axes):
                    memo[key] = np.full(shape, fact.value == relation[1])
            if memo[key] is v and source.eqn is not None:
                operands = [
                    visit(one, operand_axes(source.eqn, axes, one)) for one in source.operands
                ]
                same = all(a is b for a, b in zip(operands, source.operands, strict=True))
                if not same and self._left > 0:
                    self._left -= 1
                    memo[key] = self._operate(source.eqn, operands)[source.output]
            return memo[key]

        return visit(value, axes)
