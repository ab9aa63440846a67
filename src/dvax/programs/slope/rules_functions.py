"""The rules of slope arithmetic for functions of JAX whose operations give loose bounds, or none.

Each is taken as a whole: `jnp.interp`, `jnp.logaddexp` (and softplus), `jnp.hypot`, `jnp.linalg.norm`,
`arctan2`, sorting, and linear maps such as the solution of a linear system with a constant matrix.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..._jax.jaxprs import bind
from ..interpreter import Rule, same_for
from .rules_structural import Ball, ball, times
from .values import Part, Slope, Values, added, between, columns, is_slope, lift, mapped, scaled

_MAX_TABLE = 10_000_000
"""Largest number of pairs of an entry and a knot."""

_MAX_COLUMNS = 1024
"""Most entries of the argument of a linear map."""


def _interp(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of linear interpolation in a table, which is constant outside of it."""
    x, knots, values = operands
    if is_slope(knots) or is_slope(values) or not is_slope(x):
        return None
    knots, values = np.asarray(knots, float), np.asarray(values, float)
    if knots.ndim != 1 or len(knots) < 2 or not (np.diff(knots) > 0).all():
        return None
    if x.low.size * len(knots) > _MAX_TABLE:
        return None
    low, high = x.low[..., None], x.high[..., None]
    ends = np.stack([np.interp(x.low, knots, values), np.interp(x.high, knots, values)], axis=-1)
    inside = (low <= knots) & (knots <= high)
    smallest = np.minimum(ends.min(axis=-1), np.where(inside, values, np.inf).min(axis=-1))
    largest = np.maximum(ends.max(axis=-1), np.where(inside, values, -np.inf).max(axis=-1))
    # The pieces, with the constant ones before the first knot and after the last.
    slopes = np.concatenate([[0.0], np.diff(values) / np.diff(knots), [0.0]])
    edges = np.concatenate([[-np.inf], knots, [np.inf]])
    met = (low <= edges[1:]) & (edges[:-1] <= high)
    down, up = (np.where(met, slopes, fill) for fill in (np.inf, -np.inf))
    down, up = down.min(axis=-1), up.max(axis=-1)
    return Slope(smallest, largest, mapped(x.parts, lambda part: scaled(part, down, up)))


def _logaddexp(eqn: Any, operands: list[Any]) -> Slope:
    """Return the slope of log(eᵃ + eᵇ), which grows with a by σ(a − b), and with b by σ(b − a)."""
    a, b = (lift(v, eqn.outvars[0].aval.shape) for v in operands)
    weight = lambda v: 1.0 / (1.0 + np.exp(-v))  # noqa: E731

    def grown(v: Slope, other: Slope) -> Slope:
        # The difference 1 − σ(a − b) would cancel.
        low, high = weight(v.low - other.high), weight(v.high - other.low)
        return v._replace(parts=mapped(v.parts, lambda part: scaled(part, low, high)))

    parts = added(grown(a, b), grown(b, a))
    return Slope(np.logaddexp(a.low, b.low), np.logaddexp(a.high, b.high), parts)


def _distance(x: Slope) -> tuple[Values, Values]:
    """Return the smallest and the largest |x|."""
    least = np.where((x.low <= 0) & (x.high >= 0), 0.0, np.minimum(np.abs(x.low), np.abs(x.high)))
    return least, np.maximum(np.abs(x.low), np.abs(x.high))


def _direction(x: Slope, least: Values, largest: Values) -> tuple[Values, Values]:
    """Return bounds on x/r for |x| ≤ r between `least` and `largest`."""
    ratios = [end / r for end in (x.low, x.high) for r in (least, largest)]
    ratios = [np.where(np.isnan(v), 0.0, np.clip(v, -1.0, 1.0)) for v in ratios]
    is_away = least > 0
    low, high = np.minimum.reduce(ratios), np.maximum.reduce(ratios)
    return np.where(is_away, low, -1.0), np.where(is_away, high, 1.0)


def _hypot(eqn: Any, operands: list[Any]) -> Slope:
    a, b = (lift(v, eqn.outvars[0].aval.shape) for v in operands)
    least, largest = (np.hypot(p, q) for p, q in zip(_distance(a), _distance(b), strict=True))

    def along(v: Slope) -> Slope:
        ends = _direction(v, least, largest)
        return v._replace(parts=mapped(v.parts, lambda part: scaled(part, *ends)))

    return Slope(least, largest, added(along(a), along(b)))


def _norm(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of the 2-norm of all entries, or along the first or the last axis."""
    (x,), out = operands, eqn.outvars[0].aval
    shape = x.low.shape
    axes = {
        (): tuple(range(len(shape))), shape[:-1]: (len(shape) - 1,), shape[1:]: (0,),
    }.get(tuple(n for n in out.shape if out.ndim < len(shape)))  # fmt: skip
    if axes is None or out.ndim == len(shape) or len(set(shape)) < len(shape) > 1:
        # With keepdims, or with axes of the same length, the shapes do not tell the axis.
        return None
    size = lambda v: np.sqrt(np.sum(v**2, axis=axes))  # noqa: E731
    least, largest = map(size, _distance(x))
    behind = tuple(axis + 1 for axis in axes)
    ends = _direction(x, *(np.expand_dims(v, axes) for v in (least, largest)))

    def total(part: Part) -> Part:
        full = scaled(columns(part, x.low.size), *ends)
        return Part(full.center.sum(axis=behind), full.radius.sum(axis=behind), True)

    return Slope(least, largest, mapped(x.parts, total))


def _atan2(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of the angle of (x, y), away from its jump at x ≤ 0, y = 0."""
    y, x = (lift(v, eqn.outvars[0].aval.shape) for v in operands)
    is_regular = (x.low > 0) | (y.low > 0) | (y.high < 0)
    least, largest = (np.hypot(p, q) for p, q in zip(_distance(x), _distance(y), strict=True))

    def over(v: Slope) -> tuple[Values, Values]:
        """Return bounds on v/r²."""
        low, high = _direction(v, least, largest)
        return np.minimum(low / least, low / largest), np.maximum(high / least, high / largest)

    # ∂/∂y = x/r², ∂/∂x = −y/r².
    by_y, (down, up) = over(x), over(y)
    wild = lambda v: np.where(is_regular, v, np.nan)  # noqa: E731
    parts = added(
        y._replace(parts=mapped(y.parts, lambda part: scaled(part, *map(wild, by_y)))),
        x._replace(parts=mapped(x.parts, lambda part: scaled(part, wild(-up), wild(-down)))),
    )
    corners = [np.arctan2(a, b) for a in (y.low, y.high) for b in (x.low, x.high)]
    low = np.where(is_regular, np.minimum.reduce(corners), -np.pi)
    return Slope(low, np.where(is_regular, np.maximum.reduce(corners), np.pi), parts)


def _sorted(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of sorted entries: each is one of the entries along the axis."""
    if len(operands) != 1:
        return None
    (x,), axis = operands, eqn.params["dimension"]

    def any_of(part: Part) -> Part:
        full = columns(part, x.low.size)
        low = (full.center - full.radius).min(axis=axis + 1, keepdims=True)
        high = (full.center + full.radius).max(axis=axis + 1, keepdims=True)
        shape = full.center.shape
        return between(np.broadcast_to(low, shape), np.broadcast_to(high, shape), True)

    return Slope(np.sort(x.low, axis), np.sort(x.high, axis), mapped(x.parts, any_of))


def _linear(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of an operation that is linear in its last argument, the others constant."""
    *others, x = operands
    if any(map(is_slope, others)) or not is_slope(x) or x.low.size > _MAX_COLUMNS:
        return None
    shape, dtype = eqn.invars[-1].aval.shape, eqn.invars[-1].aval.dtype
    basis = jnp.eye(x.low.size, dtype=dtype).reshape(-1, *shape)
    if len(eqn.outvars) != 1:
        return None
    images = jax.vmap(lambda v: bind(eqn, [*others, v])[0])(basis)
    exact = np.asarray(images, float).reshape(x.low.size, -1)
    matrix = Ball(exact, np.zeros_like(exact))
    out = eqn.outvars[0].aval.shape
    flat = x._replace(low=x.low.reshape(-1), high=x.high.reshape(-1))
    value = times("n,nm->m", ball(flat), matrix)

    def image(part: Part) -> Part:
        full = columns(part, max(x.low.size, matrix.center.shape[1]))
        rows = Ball(*(v.reshape(len(v), -1) for v in (full.center, full.radius)))
        center, radius = times("zn,nm->zm", rows, matrix)
        return Part(center.reshape(len(center), *out), radius.reshape(len(radius), *out), True)

    low, high = value.center - value.radius, value.center + value.radius
    return Slope(low.reshape(out), high.reshape(out), mapped(x.parts, image))


FUNCTIONS: dict[str, Rule] = {
    "_interp": _interp,
    "logaddexp": _logaddexp,
    "hypot": _hypot,
    "norm": _norm,
    "atan2": _atan2,
    "sort": _sorted,
    **same_for({"custom_linear_solve", "triangular_solve"}, _linear),
}
