"""The rules of slope arithmetic for operations that rearrange or add entries, and for products."""

import functools
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..._jax.jaxprs import bind
from ..interpreter import MAX_UNROLLED, Rule, same_for
from ..primitives import JOINING, REARRANGING, SUMMING
from .rules_elementwise import multiplied
from .values import (
    Part,
    Slope,
    Values,
    added,
    between,
    columns,
    is_slope,
    lift,
    mapped,
    negative,
    together,
)


def _rearranged(eqn: Any, operands: list[Any]) -> list[Slope] | None:
    """Return the slopes of an operation whose results consist of entries of its arguments."""
    count = 1 if eqn.primitive.name in INDEXED else len(operands)
    indices = operands[count:]
    if any(map(is_slope, indices)):
        return None
    atoms = zip(operands[:count], eqn.invars[:count], strict=True)
    x = [lift(v, tuple(atom.aval.shape)) for v, atom in atoms]
    sources = _evaluate_sources(eqn, indices) if indices else _sources(eqn)
    fill = eqn.params.get("fill_value")
    return [picked(x, source, math.nan if fill is None else fill) for source in sources]


INDEXED = frozenset({"gather", "dynamic_slice"})
"""The first argument is rearranged, and the others are indices."""


def positions(eqn: Any, operands: list[Any]) -> Values | None:
    """Return for each entry of the result its position in the first argument, or −1 if it is a fill
    value; None if that depends on the variables."""
    indices = operands[1:]
    if any(map(is_slope, indices)):
        return None
    return (_evaluate_sources(eqn, indices) if indices else _sources(eqn))[0]


def _evaluate_sources(eqn: Any, indices: list[Any]) -> list[Values]:
    """Return for each entry of the results its position in all arguments, joined as flat arrays, or −1
    if it is a fill value.

    The operation itself is evaluated on these positions. Integers are not rounded, whereas JAX rounds
    float64 to its default type.
    """
    shapes = [atom.aval.shape for atom in eqn.invars[: len(eqn.invars) - len(indices)]]
    starts = np.cumsum([0, *map(math.prod, shapes)])
    positions = [
        np.arange(start, end, dtype=np.int32).reshape(shape)
        for start, end, shape in zip(starts, starts[1:], shapes, strict=False)
    ]
    params = {"fill_value": -1} if "fill_value" in eqn.params else {}
    return list(map(np.asarray, bind(eqn, [*positions, *indices], **params)))


@functools.lru_cache(256)
def _sources(eqn: Any) -> list[Values]:
    """Return the sources of an operation without indices, which depend on shapes only."""
    return _evaluate_sources(eqn, [])


def picked(x: list[Slope], source: Values, fill: Any) -> Slope:
    """Return the entries of x at these positions."""

    def pick(leaves: list[Values], extra: int, fill: Any) -> Values:
        flat = [v.reshape(*v.shape[:extra], math.prod(v.shape[extra:])) for v in leaves]
        picked = np.concatenate(flat, axis=-1)[..., source]
        return np.where(source < 0, fill, picked) if (source < 0).any() else picked

    size = max([source.size, *(v.low.size for v in x)])
    in_order = len(x) == 1 and np.array_equal(source.ravel(), np.arange(x[0].low.size))
    parts = {}
    for k, own in together(x, full=len(x) > 1, size=size).items():
        if in_order and not own[0].full:
            center, radius = (v.reshape(source.shape) for v in own[0][:2])
        else:
            full = [columns(part, size) for part in own]
            center, radius = (pick([part[i] for part in full], 1, 0.0) for i in (0, 1))
        parts[k] = Part(center, radius, not in_order or own[0].full)
    low, high = pick([v.low for v in x], 0, fill), pick([v.high for v in x], 0, fill)
    return Slope(low, high, parts)


def _summed(eqn: Any, operands: list[Any]) -> Slope:
    """Return the slope of a sum over axes, or of the partial sums along one."""
    (x,), p = operands, eqn.params

    def total(v: Values, extra: int) -> Values:
        if eqn.primitive.name == "reduce_sum":
            return v.sum(axis=tuple(extra + axis for axis in p["axes"]))
        axis = extra + p["axis"]
        return np.flip(np.cumsum(np.flip(v, axis), axis), axis) if p["reverse"] else v.cumsum(axis)

    def derivative(part: Part) -> Part:
        full = columns(part, x.low.size)
        return Part(total(full.center, 1), total(full.radius, 1), True)

    return Slope(total(x.low, 0), total(x.high, 0), mapped(x.parts, derivative))


def _reduce_max(eqn: Any, operands: list[Any]) -> Slope:
    """Return the largest entry, whose derivative lies in the hull of those of all entries."""
    (x,) = operands
    axes = tuple(eqn.params["axes"])

    def largest(part: Part) -> Part:
        full = columns(part, x.low.size)
        behind = tuple(axis + 1 for axis in axes)
        low = (full.center - full.radius).min(axis=behind)
        return between(low, (full.center + full.radius).max(axis=behind), True)

    return Slope(x.low.max(axis=axes), x.high.max(axis=axes), mapped(x.parts, largest))


def _reduce_min(eqn: Any, operands: list[Any]) -> Slope:
    return negative(_reduce_max(eqn, [negative(operands[0])]))


def _reduce_prod(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of the product of entries along axes."""
    (x,), axes = operands, tuple(eqn.params["axes"])
    rows = np.moveaxis(_positions(x), axes, range(len(axes)))
    partial = _partial_products(x, rows.reshape(-1, *eqn.outvars[0].aval.shape))
    return None if partial is None else partial[-1]


def _cumprod(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of the partial products along an axis."""
    (x,), axis = operands, eqn.params["axis"]
    rows = np.moveaxis(_positions(x), axis, 0)
    partial = _partial_products(x, rows[::-1] if eqn.params["reverse"] else rows)
    if partial is None:
        return None
    joined = np.arange(x.low.size).reshape(rows.shape)
    joined = joined[::-1] if eqn.params["reverse"] else joined
    return picked(partial, np.moveaxis(joined, 0, axis), 0.0)


def _positions(x: Slope) -> Values:
    return np.arange(x.low.size).reshape(x.low.shape)


def _partial_products(x: Slope, rows: Values) -> list[Slope] | None:
    """Return the products of the entries at the first positions, at the first two, and so on."""
    if not 0 < len(rows) <= MAX_UNROLLED:
        return None
    entries = [picked([x], row, 0.0) for row in rows]
    return list(itertools.accumulate(entries, multiplied))


def _einsum(eqn: Any, extra: tuple[int, int]) -> str:
    """Return the einsum formula of a dot_general with `extra` axes in front of each side."""
    (of_left, of_right), (batch_left, batch_right) = eqn.params["dimension_numbers"]
    names = iter("abcdefghijklmnopqrstuvw")
    left = [next(names) for _ in eqn.invars[0].aval.shape]
    right = [next(names) for _ in eqn.invars[1].aval.shape]
    for i, j in [*zip(of_left, of_right), *zip(batch_left, batch_right)]:
        right[j] = left[i]
    batch = [left[i] for i in batch_left]
    free_left = [c for i, c in enumerate(left) if i not in (*of_left, *batch_left)]
    free_right = [c for j, c in enumerate(right) if j not in (*of_right, *batch_right)]
    out = [*batch, *free_left, *free_right]
    front = "z" * (extra[0] + extra[1])
    sides = "z" * extra[0] + "".join(left), "z" * extra[1] + "".join(right)
    return f"{sides[0]},{sides[1]}->{front}{''.join(out)}"


class Ball(NamedTuple):
    """An interval array as center and radius."""

    center: Values
    radius: Values


def ball(x: Slope) -> Ball:
    return Ball(*between(np.asarray(x.low, float), np.asarray(x.high, float), True)[:2])


def times(spec: str, x: Any, y: Any) -> Ball:
    """Return the product of two interval arrays."""

    def dot(a: Values, b: Values) -> Values:
        return np.einsum(spec, a, b, optimize=True)

    def bound(a: Values, b: Values) -> Values:
        infinite = dot(np.isinf(a) * 1.0, (b > 0) * 1.0) + dot((a > 0) * 1.0, np.isinf(b) * 1.0)
        finite = dot(np.where(np.isinf(a), 0.0, a), np.where(np.isinf(b), 0.0, b))
        return np.where(infinite > 0, np.inf, finite)

    radius = bound(np.abs(x.center), y.radius) + bound(x.radius, np.abs(y.center) + y.radius)
    return Ball(dot(x.center, y.center), radius)


def _dot_general(eqn: Any, operands: list[Any]) -> Slope:
    left, right = (lift(v, tuple(atom.aval.shape)) for v, atom in zip(operands, eqn.invars))
    x, y = ball(left), ball(right)
    value = times(_einsum(eqn, (0, 0)), x, y)
    low, high = value.center - value.radius, value.center + value.radius
    if operands[0] is operands[1] and value.center.ndim == 0:
        # A sum of squares; its range is that of the squares where all entries meet themselves.
        (of_left, of_right), _ = eqn.params["dimension_numbers"]
        if tuple(of_left) == tuple(of_right):
            ends = np.square(left.low), np.square(left.high)
            has_zero = (left.low <= 0) & (left.high >= 0)
            low = np.sum(np.where(has_zero, 0.0, np.minimum(*ends)))
            high = np.sum(np.maximum(*ends))
    out = eqn.outvars[0].aval.size

    def by(side: Slope, spec: str, times: Callable[[str, Part], Ball]) -> Slope:
        """Return the derivatives of the product through one side."""
        full = lambda part: columns(part, max(side.low.size, out))  # noqa: E731
        parts = mapped(side.parts, lambda part: Part(*times(spec, full(part)), True))
        return Slope(value.center, value.center, parts)

    by_left = by(left, _einsum(eqn, (1, 0)), lambda spec, part: times(spec, part, y))
    by_right = by(right, _einsum(eqn, (0, 1)), lambda spec, part: times(spec, x, part))
    parts = added(by_left, by_right)
    return Slope(low, high, parts)


STRUCTURAL: dict[str, Rule] = {
    **same_for(REARRANGING | JOINING | INDEXED, _rearranged),
    **same_for(SUMMING, _summed),
    "reduce_max": _reduce_max,
    "reduce_min": _reduce_min,
    "reduce_prod": _reduce_prod,
    "cumprod": _cumprod,
    "dot_general": _dot_general,
}
