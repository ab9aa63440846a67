"""The rules of slope arithmetic for entries that are written, or added, into an array."""

import math
from typing import Any

import jax
import numpy as np

from ..._jax.jaxprs import bind
from ..interpreter import Rule, same_for
from .rules_elementwise import multiplied
from .rules_structural import picked
from .values import Part, Slope, Values, is_slope, lift, together


def _updated(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of an array with a block in the place of some entries."""
    array, block, *indices = operands
    if any(map(is_slope, indices)):
        return None
    shapes = [tuple(atom.aval.shape) for atom in eqn.invars[:2]]
    sizes = list(map(math.prod, shapes))
    own = np.arange(sizes[0], dtype=np.int32).reshape(shapes[0])
    new = np.arange(sizes[0], sum(sizes), dtype=np.int32).reshape(shapes[1])
    source = np.asarray(bind(eqn, [own, new, *indices])[0])
    return picked([lift(v, shape) for v, shape in zip((array, block), shapes)], source, 0.0)


def _written(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of an array with other values at constant places, each of which is written
    once."""
    return _placed(eqn, operands, operands[0])


def _multiplied(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of an array that is multiplied at constant places, at each of them once."""
    shape = tuple(eqn.invars[0].aval.shape)
    factor = _placed(eqn, operands, np.ones(shape))
    return None if factor is None else multiplied(lift(operands[0], shape), factor)


def _placed(eqn: Any, operands: list[Any], array: Any) -> Slope | None:
    """Return an array with the new values of a scatter in the place of its own."""
    _, indices, new = operands
    target = None if is_slope(indices) else _targets(eqn, indices)
    if target is None or (target < 0).any() or len(np.unique(target)) < target.size:
        return None
    shapes = [tuple(eqn.invars[k].aval.shape) for k in (0, 2)]
    count = math.prod(shapes[0])
    source = np.arange(count)
    source[target.ravel()] = count + np.arange(target.size)
    x = [lift(v, shape) for v, shape in zip((array, new), shapes)]
    return picked(x, source.reshape(shapes[0]), 0.0)


def _added(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of an array to which values are added at constant places."""
    indices = operands[1]
    target = None if is_slope(indices) else _targets(eqn, indices)
    if target is None:
        return None
    x, terms = (lift(operands[k], tuple(eqn.invars[k].aval.shape)) for k in (0, 2))
    inside = target >= 0
    places: Any = (..., target[inside])

    def total(v: Values, w: Values, extra: int) -> Values:
        rows = np.array(v, float).reshape(*v.shape[:extra], -1)
        flat = np.reshape(w, (*w.shape[:extra], *target.shape))
        np.add.at(rows, places, flat[..., inside])
        return rows.reshape(v.shape)

    parts = {
        k: Part(total(a.center, b.center, 1), total(a.radius, b.radius, 1), True)
        for k, (a, b) in together([x, terms], full=True).items()
    }
    return Slope(total(x.low, terms.low, 0), total(x.high, terms.high, 0), parts)


def _targets(eqn: Any, indices: Any) -> Values | None:
    """Return for each new value the position in the flat array at which it is added, −1 if it is
    dropped; None where the type of the array cannot count its entries.

    The addition is linear in the new values. Its transpose picks the entries of an array of numbers.
    """
    array, new = (eqn.invars[k].aval for k in (0, 2))
    zeros = np.zeros(array.shape, array.dtype)
    if zeros.size + 1 >= 2.0 ** (jax.numpy.finfo(array.dtype).nmant + 1):
        return None
    params = dict(
        dimension_numbers=eqn.params["dimension_numbers"],
        indices_are_sorted=eqn.params["indices_are_sorted"],
        unique_indices=eqn.params["unique_indices"], mode=eqn.params["mode"],
    )  # fmt: skip

    def add(values: Any) -> Any:
        return jax.lax.scatter_add(zeros, indices, values, **params)

    numbers = np.arange(1, zeros.size + 1).astype(array.dtype).reshape(array.shape)
    _, pull = jax.vjp(add, np.zeros(new.shape, array.dtype))
    return np.asarray(pull(numbers)[0]).astype(np.int64) - 1


SCATTER: dict[str, Rule] = {
    "dynamic_update_slice": _updated,
    "scatter": _written,
    **same_for({"scatter-add", "scatter_add"}, _added),
    **same_for({"scatter-mul", "scatter_mul"}, _multiplied),
}
