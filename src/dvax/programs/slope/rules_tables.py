"""The rules of slope arithmetic for `dvax.signals.Table`, as one operation.

The operations of a lookup have no bounds one by one, because the index in the table depends on t. The
whole lookup has: over an interval of t its range follows from the values at the ends and at the knots
between.
"""

from typing import Any

import numpy as np

from ..interpreter import Rule
from .values import Slope, Values, is_slope, lift, mapped, scaled


def _linear(eqn: Any, operands: list[Any]) -> Slope | None:
    span = _span(eqn, operands)
    if span is None:
        return None
    times, values, t, pieces = span
    first, last = pieces
    slopes = (values[1:] - values[:-1]) / _widths(times, values)
    ends = [_at(times, values, float(end)) for end in (t.low, t.high)]
    values_in_span = np.stack([*ends, *values[first + 1 : last + 1]])
    return _slope(eqn, t, values_in_span, slopes[first : last + 1])


def _constant(eqn: Any, operands: list[Any]) -> Slope | None:
    span = _span(eqn, operands)
    if span is None:
        return None
    times, values, t, (first, last) = span
    last = last + 1 if float(t.high) >= times[-1] else last
    values_in_span = values[first : last + 1]
    jumps = np.where(values_in_span.min(axis=0) == values_in_span.max(axis=0), 0.0, np.inf)
    return _slope(eqn, t, values_in_span, np.stack([-jumps, jumps]))


def _cubic(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of a cubic table, from the convex hull of Bernstein coefficients of the pieces
    and of their derivatives."""
    if is_slope(operands[2]):
        return None
    span = _span(eqn, [operands[0], operands[1], operands[3]])
    if span is None:
        return None
    times, values, t, (first, last) = span
    slopes = np.asarray(operands[2], float)
    width = _widths(times, values)[first : last + 1]
    v0, v1 = values[first : last + 1], values[first + 1 : last + 2]
    d0, d1 = slopes[first : last + 1], slopes[first + 1 : last + 2]
    b1, b2 = v0 + width * d0 / 3, v1 - width * d1 / 3
    middle = 3 * (b2 - b1) / width
    return _slope(eqn, t, np.concatenate([v0, b1, b2, v1]), np.concatenate([d0, middle, d1]))


def _span(eqn: Any, operands: list[Any]) -> tuple[Values, Values, Slope, tuple[int, int]] | None:
    """Return times, values, t, and the first and last piece that may contain t, or None if t may lie
    outside the table."""
    times, values, t = operands
    if is_slope(times) or is_slope(values) or not is_slope(t) or t.low.shape != ():
        return None
    times, values = np.asarray(times, float), np.asarray(values, float)
    if not (times[0] <= t.low and t.high <= times[-1]):
        return None
    last = len(times) - 2
    first = min(int(np.searchsorted(times, float(t.low), side="right")) - 1, last)
    return (
        times,
        values,
        t,
        (first, min(int(np.searchsorted(times, float(t.high), "right")) - 1, last)),
    )


def _slope(eqn: Any, t: Slope, values_in_span: Values, slopes: Values) -> Slope:
    low, high = values_in_span.min(axis=0), values_in_span.max(axis=0)
    lifted = lift(t, eqn.outvars[0].aval.shape)
    down, up = slopes.min(axis=0), slopes.max(axis=0)
    return Slope(low, high, mapped(lifted.parts, lambda part: scaled(part, down, up)))


def _at(times: Values, values: Values, t: float) -> Values:
    i = min(int(np.searchsorted(times, t, side="right")) - 1, len(times) - 2)
    share = (t - times[i]) / (times[i + 1] - times[i])
    return values[i] + share * (values[i + 1] - values[i])


def _widths(times: Values, values: Values) -> Values:
    return np.diff(times).reshape(-1, *(1,) * (values.ndim - 1))


TABLES: dict[str, Rule] = {
    "dvax_constant_table": _constant,
    "dvax_linear_table": _linear,
    "dvax_cubic_table": _cubic,
}
