"""The values of slope arithmetic: intervals of values with intervals of derivatives.

A derivative with respect to an array v is stored as a vector if it is diagonal: for a pointwise law on
10⁵ points the matrix would not fit into memory.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

Values = Any
"""An array, or the scalar that NumPy returns for an array without axes."""

MAX_ENTRIES = 4_000_000
"""Largest number of entries of a matrix of derivatives."""


class TooLarge(Exception):
    """A matrix of derivatives is not diagonal and has more than `MAX_ENTRIES` entries."""


class Part(NamedTuple):
    """The derivative ∂q/∂v for one array v: every entry lies within `radius` of `center`.

    If not `full`, it is diagonal and has the shape of q: the k-th entry of q depends on the k-th entry
    of v only. If `full`, it has one more axis in front, that of the entries of v.
    """

    center: Values
    radius: Values
    full: bool


class Slope(NamedTuple):
    """The bounds low ≤ q ≤ high, and ∂q/∂vₖ for every k in `parts`; q does not depend on other vₖ.

    `source`: how q was computed (`sources.Source`), if that is kept; `undefined`: whether q may be NaN
    somewhere, as log x is for x < 0, or was computed from such values.
    """

    low: Values
    high: Values
    parts: dict[int, Part]
    source: Any = None
    undefined: bool = False


def interval(low: Any, high: Any) -> Slope:
    """Return a quantity between two arrays, without derivatives."""
    low, high = np.broadcast_arrays(np.asarray(low, float), np.asarray(high, float))
    return Slope(low, high, {})


def is_slope(value: Any) -> bool:
    return isinstance(value, Slope)


def columns(part: Part, size: int) -> Part:
    """Return the part in full form. `size` is the largest number of entries of q and of the quantities
    that are computed from it.

    **Raises:** `TooLarge` if the matrix would be too large.
    """
    if entries(part) * size > MAX_ENTRIES:
        raise TooLarge
    if part.full:
        return part
    shape = (entries(part), *part.center.shape)
    spread = lambda v: np.diag(v.ravel()).reshape(shape)  # noqa: E731
    return Part(spread(part.center), spread(part.radius), True)


def entries(part: Part) -> int:
    """Return the number of entries of v."""
    return part.center.shape[0] if part.full else part.center.size


def mapped(parts: dict[int, Part], fn: Callable[[Part], Part]) -> dict[int, Part]:
    return {k: fn(part) for k, part in parts.items()}


def together(slopes: list[Slope], full: bool = False, size: int = 0) -> dict[int, list[Part]]:
    """Return, for every array on which a slope depends, the parts of all slopes in the same form.

    Missing parts are zero. All parts are full if one of them is, or if `full`; `size` is the number of
    entries of the result.
    """
    parts_by_array = {}
    for k in {k: None for x in slopes for k in x.parts}:
        operands = [x.parts.get(k) for x in slopes]
        first = next(part for part in operands if part is not None)
        is_full = full or any(part is not None and part.full for part in operands)
        parts = []
        for x, part in zip(slopes, operands, strict=True):
            if part is None:
                shape = np.shape(x.low)
                zero = np.zeros((entries(first), *shape) if is_full else shape)
                part = Part(zero, zero, is_full)
            parts.append(columns(part, max(size, np.size(x.low))) if is_full else part)
        parts_by_array[k] = parts
    return parts_by_array


def product(a: Values, b: Values) -> Values:
    """Return a b with 0 · ∞ = 0."""
    out = a * b
    return np.where((a == 0) | (b == 0), 0.0, out) if np.isnan(out).any() else out


def scaled(part: Part, low: Values, high: Values) -> Part:
    """Return the part times numbers between low and high, entry by entry."""
    is_bounded = np.isfinite(low) & np.isfinite(high)
    middle = np.where(is_bounded, 0.5 * (low + high), 0.0)
    spread = np.where(is_bounded, 0.5 * (high - low), np.inf)
    radius = product(np.abs(middle), part.radius)
    radius = radius + product(spread, np.abs(part.center) + part.radius)
    return Part(middle * part.center, radius, part.full)


def added(x: Slope, y: Slope, sign: float = 1.0) -> dict[int, Part]:
    """Return the parts of x ± y."""
    return {
        k: Part(a.center + sign * b.center, a.radius + b.radius, a.full)
        for k, (a, b) in together([x, y]).items()
    }


def sharper(a: Slope, b: Slope) -> Slope:
    """Return the sharper bounds of two enclosures of one value, entry by entry."""
    parts = {}
    for k in a.parts.keys() & b.parts.keys():
        p, q = a.parts[k], b.parts[k]
        if p.full != q.full:
            p, q = (columns(part, a.low.size) for part in (p, q))
        is_better = q.radius < p.radius
        center, radius = (np.where(is_better, v, w) for v, w in zip(q[:2], p[:2], strict=True))
        parts[k] = Part(center, radius, p.full)
    low, high = np.maximum(a.low, b.low), np.minimum(a.high, b.high)
    return Slope(low, high, parts, a.source, a.undefined and b.undefined)


def hull(a: Part, b: Part) -> Part:
    """Return the smallest part that contains two parts of the same form."""
    low = np.minimum(a.center - a.radius, b.center - b.radius)
    high = np.maximum(a.center + a.radius, b.center + b.radius)
    return between(low, high, a.full)


def between(low: Values, high: Values, full: bool) -> Part:
    """Return the part between two bounds; the radius is infinite where a bound is."""
    is_bounded = np.isfinite(low) & np.isfinite(high)
    center = np.where(is_bounded, 0.5 * (low + high), 0.0)
    return Part(center, np.where(is_bounded, 0.5 * (high - low), np.inf), full)


def negative(x: Slope) -> Slope:
    """Return −x."""
    return Slope(-x.high, -x.low, mapped(x.parts, lambda p: p._replace(center=-p.center)))


def lift(value: Any, shape: tuple[int, ...]) -> Slope:
    """Return a slope of this shape from a slope or an array, by broadcasting."""
    if not is_slope(value):
        value = np.asarray(value)
        value = Slope(value, value, {})
    if value.low.shape == shape:
        return value
    # Add axes of length one in front, then repeat.
    padding = (1,) * (len(shape) - value.low.ndim)

    def repeated(part: Part) -> Part:
        full = columns(part, math.prod(shape))
        center, radius = (
            np.broadcast_to(v.reshape((len(v), *padding, *v.shape[1:])), (len(v), *shape))
            for v in (full.center, full.radius)
        )
        return Part(center, radius, True)

    low, high = (np.broadcast_to(v, shape) for v in (value.low, value.high))
    return Slope(low, high, mapped(value.parts, repeated))


def is_dependent(part: Part) -> Values:
    """Return a mask of the entries of the derivative that may be nonzero."""
    return (part.center != 0) | (part.radius != 0)
