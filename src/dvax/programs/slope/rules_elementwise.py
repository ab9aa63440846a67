"""The rules of slope arithmetic for elementwise operations."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from ..interpreter import Rule, is_real, same_for
from ..smooth import SMOOTH_NAMES, Smooth, integer_power, positive_power, smooth
from .values import (
    Part,
    Slope,
    Values,
    added,
    hull,
    is_dependent,
    is_slope,
    lift,
    mapped,
    negative,
    product,
    scaled,
    together,
)

Ends = tuple[Values, Values]


def _lifted(eqn: Any, operands: list[Any]) -> list[Slope]:
    return [lift(value, eqn.outvars[0].aval.shape) for value in operands]


def _add(eqn: Any, operands: list[Any]) -> Slope:
    x, y = _lifted(eqn, operands)
    return Slope(x.low + y.low, x.high + y.high, added(x, y))


def _sub(eqn: Any, operands: list[Any]) -> Slope:
    x, y = _lifted(eqn, operands)
    is_same = x.source is not None and y.source is not None and x.source.key == y.source.key
    if is_same and bool(np.isfinite(x.low).all() and np.isfinite(x.high).all()):
        return Slope(np.zeros_like(x.low), np.zeros_like(x.low), {})
    return Slope(x.low - y.high, x.high - y.low, added(x, y, -1.0))


def _mul(eqn: Any, operands: list[Any]) -> Slope:
    return multiplied(*_lifted(eqn, operands))


def multiplied(x: Slope, y: Slope) -> Slope:
    """Return x y."""
    corners = [product(a, b) for a in (x.low, x.high) for b in (y.low, y.high)]
    low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
    by_x = mapped(x.parts, lambda part: scaled(part, y.low, y.high))
    by_y = mapped(y.parts, lambda part: scaled(part, x.low, x.high))
    return Slope(low, high, added(x._replace(parts=by_x), y._replace(parts=by_y)))


def _div(eqn: Any, operands: list[Any]) -> Slope | None:
    if not is_real(eqn.outvars[0].aval):
        return None  # integers are divided with a remainder
    x, y = _lifted(eqn, operands)
    inverse = _composed(integer_power(-1), y)
    return multiplied(x, inverse)._replace(undefined=bool(np.isnan(inverse.low).any()))


def _neg(eqn: Any, operands: list[Any]) -> Slope:
    return negative(operands[0])


def _largest(x: Slope, y: Slope) -> Slope:
    first, second = x.low >= y.high, y.low >= x.high
    parts = {}
    for k, (a, b) in together([x, y]).items():
        center, radius = (
            np.where(first, p, np.where(second, q, r))
            for p, q, r in zip(a[:2], b[:2], hull(a, b)[:2], strict=True)
        )
        parts[k] = Part(center, radius, a.full)
    return Slope(np.maximum(x.low, y.low), np.maximum(x.high, y.high), parts)


def _smallest(x: Slope, y: Slope) -> Slope:
    return negative(_largest(negative(x), negative(y)))


def _max(eqn: Any, operands: list[Any]) -> Slope:
    return _largest(*_lifted(eqn, operands))


def _min(eqn: Any, operands: list[Any]) -> Slope:
    return _smallest(*_lifted(eqn, operands))


def _clamp(eqn: Any, operands: list[Any]) -> Slope:
    low, x, high = _lifted(eqn, operands)
    return _smallest(_largest(x, low), high)


def _abs(eqn: Any, operands: list[Any]) -> Slope:
    (x,) = operands
    y = _largest(x, negative(x))
    return y._replace(low=np.maximum(y.low, 0.0))


def _composed(phi: Smooth, x: Slope) -> Slope:
    """Return φ(x) from the ranges of φ and φ′; the derivative is unbounded where φ is not defined."""
    assert phi.values is not None and phi.slopes is not None
    low, high = phi.values(x.low, x.high)
    down, up = phi.slopes(x.low, x.high)
    down = np.where(np.isnan(low) | np.isnan(high), np.nan, down)
    return Slope(low, high, mapped(x.parts, lambda part: scaled(part, down, up)))


def _smooth(eqn: Any, operands: list[Any]) -> Slope | None:
    phi = smooth(eqn)
    return None if phi is None or phi.values is None else _composed(phi, operands[0])


def _pow(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return vᵖ for a constant number p > 0 and v ≥ 0."""
    x, p = operands
    if is_slope(p) or not is_slope(x) or np.size(p) != 1 or not float(p) > 0:
        return None
    return _composed(positive_power(float(p)), x)


def _stairs(phi: Callable[[Values], Values]) -> Rule:
    """Return the rule of a step function φ, which is constant where its values at both ends agree."""

    def rule(eqn: Any, operands: list[Any]) -> Slope:
        (x,) = operands
        low, high = phi(x.low), phi(x.high)
        jump = np.where(low == high, 0.0, np.inf)
        return Slope(low, high, mapped(x.parts, lambda p: _jumping(p, jump)))

    return rule


def _jumping(part: Part, jump: Values) -> Part:
    """Return the derivative of a piecewise constant function: 0, or `jump` where it depends on v."""
    return Part(np.zeros_like(part.center), np.where(is_dependent(part), jump, 0.0), part.full)


def _remainder(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of x − c trunc(x/c) for constant c: that of x where the quotient is constant."""
    x, c = _lifted(eqn, operands)
    if c.parts or not np.array_equal(c.low, c.high) or not is_real(eqn.outvars[0].aval):
        return None
    length = np.abs(c.low)
    if not (length > 0).all():
        return None
    low, high = np.fmod(x.low, length), np.fmod(x.high, length)
    # The remainder is exact, so that the quotients are integers up to a rounding.
    first, last = np.round((x.low - low) / length), np.round((x.high - high) / length)
    is_one = (first == last) & np.isfinite(first)
    jump = np.where(is_one, 0.0, np.inf)

    def derivative(part: Part) -> Part:
        center = np.where(is_one, part.center, 0.0)
        return Part(center, part.radius + _jumping(part, jump).radius, part.full)

    return Slope(
        np.where(is_one, low, np.where(x.low < 0, -length, 0.0)),
        np.where(is_one, high, np.where(x.high > 0, length, 0.0)),
        mapped(x.parts, derivative),
    )


def _round(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return x rounded; ties go to even, or away from zero."""
    to_even = eqn.params["rounding_method"] == lax.RoundingMethod.TO_NEAREST_EVEN
    away = lambda v: np.sign(v) * np.floor(np.abs(v) + 0.5)  # noqa: E731
    return _stairs(np.round if to_even else away)(eqn, operands)


def _decided(low: Values, high: Values, *operands: Slope) -> Slope:
    """Return Boolean values. Their parts are no derivatives, but marks: 1 where there is a
    dependence."""
    marks = {}
    for k, parts in together(list(operands)).items():
        mark = sum(is_dependent(part) * 1.0 for part in parts)
        marks[k] = Part(mark, np.zeros_like(mark), parts[0].full)
    return Slope(low, high, marks)


def _compare(decide: Callable[[Slope, Slope], Ends]) -> Rule:
    def rule(eqn: Any, operands: list[Any]) -> Slope:
        x, y = _lifted(eqn, operands)
        return _decided(*decide(x, y), x, y)

    return rule


def _equal(eqn: Any, operands: list[Any]) -> Slope:
    x, y = _lifted(eqn, operands)
    surely = (x.low == x.high) & (y.low == y.high) & (x.low == y.low)
    if eqn.invars[0] is eqn.invars[1]:
        # Code compares a value with itself to detect NaN.
        surely = np.ones(x.low.shape, bool)
    return _decided(surely, surely | (x.low <= y.high) & (y.low <= x.high), x, y)


def _opposite(x: Slope) -> Slope:
    return Slope(~x.high, ~x.low, x.parts)


def _logic(fn: Callable[..., Values]) -> Rule:
    """Return the rule of a logical function that increases with each of its arguments."""

    def rule(eqn: Any, operands: list[Any]) -> Slope | None:
        x = _lifted(eqn, operands)
        if not all(v.low.dtype == bool for v in x):
            return None
        return _decided(fn(*(v.low for v in x)), fn(*(v.high for v in x)), *x)

    return rule


def _not(eqn: Any, operands: list[Any]) -> Slope | None:
    return _opposite(operands[0]) if operands[0].low.dtype == bool else None


def _is_finite(eqn: Any, operands: list[Any]) -> Slope:
    (x,) = operands
    bounded = np.isfinite(x.low) & np.isfinite(x.high)
    return _decided(bounded, np.ones_like(bounded), x)


def _convert(eqn: Any, operands: list[Any]) -> Slope | None:
    (x,) = operands
    before, after = eqn.invars[0].aval, eqn.outvars[0].aval
    if before.dtype == bool and after.dtype == bool:
        return x
    if before.dtype == bool and np.issubdtype(after.dtype, np.integer):
        jump = np.where(x.low == x.high, 0.0, np.inf)
        low, high = (end.astype(after.dtype) for end in (x.low, x.high))
        return Slope(low, high, mapped(x.parts, lambda p: _jumping(p, jump)))
    if not is_real(after):
        return None
    if is_real(before):
        return x if jnp.finfo(after.dtype).eps <= jnp.finfo(before.dtype).eps else None
    return _stairs(lambda v: np.asarray(v, float))(eqn, operands)


ELEMENTWISE: dict[str, Rule] = {
    **same_for(SMOOTH_NAMES, _smooth),
    **same_for({"add", "add_any"}, _add),
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": _neg,
    "max": _max,
    "min": _min,
    "clamp": _clamp,
    "abs": _abs,
    "pow": _pow,
    "sign": _stairs(np.sign),
    "floor": _stairs(np.floor),
    "ceil": _stairs(np.ceil),
    "round": _round,
    "rem": _remainder,
    "eq": _equal,
    "ne": lambda eqn, operands: _opposite(_equal(eqn, operands)),
    "lt": _compare(lambda x, y: (x.high < y.low, x.low < y.high)),
    "le": _compare(lambda x, y: (x.high <= y.low, x.low <= y.high)),
    "gt": _compare(lambda x, y: (x.low > y.high, x.high > y.low)),
    "ge": _compare(lambda x, y: (x.low >= y.high, x.high >= y.low)),
    "and": _logic(np.logical_and),
    "or": _logic(np.logical_or),
    "not": _not,
    "is_finite": _is_finite,
    "convert_element_type": _convert,
}
