"""Which entry of a value the k-th entry of a result is computed from.

A selection such as `jnp.where` chooses entry by entry. What its condition says about entry k holds for
entry k of what the branch is computed from entry by entry, and not for a sum over entries, or for
another entry. The *axes* of a value say where its entries are: for each of its axes of more than one
entry, the axis of the selection along which it lies. They are None if entry k of the result is computed
from other entries of the value too.
"""

import math
from typing import Any

import numpy as np

from .rules_elementwise import ELEMENTWISE
from .values import is_slope

Axes = tuple[int, ...] | None

_ENTRYWISE = frozenset({*ELEMENTWISE, "select_n", "copy", "copy_p", "stop_gradient"})


def own_axes(shape: tuple[int, ...]) -> Axes:
    """Return the axes of the result of a selection."""
    return tuple(axis for axis, size in enumerate(shape) if size != 1)


def operand_axes(eqn: Any, axes: Axes, operand: Any) -> Axes:
    """Return the axes of an argument of an operation, given those of its result."""
    shape, of_result = shape_of(operand), eqn.outvars[0].aval.shape
    if math.prod(shape) == 1:
        return ()
    name = eqn.primitive.name
    if axes is None or len(eqn.outvars) > 1:
        return None
    sizes, of_sizes = (tuple(size for size in s if size != 1) for s in (shape, of_result))
    if name in _ENTRYWISE and shape == of_result:
        return axes
    if name == "broadcast_in_dim":
        along = dict(zip(own_axes(of_result) or (), axes, strict=True))
        places = zip(shape, eqn.params["broadcast_dimensions"], strict=True)
        return tuple(along[axis] for size, axis in places if size != 1)
    if name in ("reshape", "squeeze", "expand_dims") and sizes == of_sizes:
        return axes
    return None


def shape_of(value: Any) -> tuple[int, ...]:
    return np.shape(value.low if is_slope(value) else value)
