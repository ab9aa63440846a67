"""What slope arithmetic works on: an interval of values, and an interval of derivatives.

A derivative by an array v is kept as a vector as long as the k-th entry depends on the k-th of v alone:
for a law that is solved point by point on 10⁵ points no matrix would fit.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

Values = Any
"""An array, or the scalar that NumPy makes of one without axes."""

MOST = 4_000_000
"""Entries of the largest matrix that is written out."""


class TooLarge(Exception):
    """A matrix of derivatives that is not diagonal and has more than `MOST` entries."""


class Part(NamedTuple):
    """∂q/∂v for one array v: every entry within `radius` of `center`.

    Diagonal: shaped like q, the k-th entry of q depends on the k-th of v alone. Full: one more axis,
    the first, over the entries of v.
    """

    center: Values
    radius: Values
    full: bool


class Slope(NamedTuple):
    """low ≤ q ≤ high, and ∂q/∂vₖ for every k among `parts`; q depends on no other vₖ."""

    low: Values
    high: Values
    parts: dict[int, Part]


def interval(low: Any, high: Any) -> Slope:
    """A quantity that lies between two arrays, and that nothing is differentiated by."""
    low, high = np.broadcast_arrays(np.asarray(low, float), np.asarray(high, float))
    return Slope(low, high, {})


def is_slope(value: Any) -> bool:
    return isinstance(value, Slope)


def columns(part: Part, size: int) -> Part:
    """The part as a full one: an axis over the `size` entries of v in front."""
    if part.full:
        return part
    shape = part.center.shape
    if size * size > MOST:
        raise TooLarge
    spread = lambda v: np.diag(v.ravel()).reshape(size, *shape)  # noqa: E731
    return Part(spread(part.center), spread(part.radius), True)


def mapped(parts: dict[int, Part], fn: Callable[[Part], Part]) -> dict[int, Part]:
    return {k: fn(part) for k, part in parts.items()}


def entries(part: Part) -> int:
    return part.center.shape[0] if part.full else part.center.size


def product(a: Values, b: Values) -> Values:
    """a b with 0 · ∞ = 0."""
    out = a * b
    return np.where((a == 0) | (b == 0), 0.0, out) if np.isnan(out).any() else out


def scaled(part: Part, low: Values, high: Values) -> Part:
    """The part times a number, entry by entry, that lies between low and high."""
    known = np.isfinite(low) & np.isfinite(high)
    middle = np.where(known, 0.5 * (low + high), 0.0)
    spread = np.where(known, 0.5 * (high - low), np.inf)
    radius = product(np.abs(middle), part.radius)
    radius = radius + product(spread, np.abs(part.center) + part.radius)
    return Part(middle * part.center, radius, part.full)


def plus(a: Part, b: Part, sign: float = 1.0) -> Part:
    if a.full != b.full:
        a, b = columns(a, entries(a)), columns(b, entries(b))
    return Part(a.center + sign * b.center, a.radius + b.radius, a.full)


def added(a: dict[int, Part], b: dict[int, Part], sign: float = 1.0) -> dict[int, Part]:
    out = dict(a)
    for k, part in b.items():
        flipped = part._replace(center=sign * part.center)
        out[k] = plus(a[k], part, sign) if k in a else flipped
    return out


def hull(a: Part, b: Part) -> Part:
    """Any derivative between two."""
    if a.full != b.full:
        a, b = columns(a, entries(a)), columns(b, entries(b))
    low = np.minimum(a.center - a.radius, b.center - b.radius)
    high = np.maximum(a.center + a.radius, b.center + b.radius)
    return between(low, high, a.full)


def between(low: Values, high: Values, full: bool) -> Part:
    known = np.isfinite(low) & np.isfinite(high)
    return Part(
        np.where(known, 0.5 * (low + high), 0.0), np.where(known, 0.5 * (high - low), np.inf), full
    )


def nothing(given: list[Any], aval: Any) -> Slope:
    """What an operation without a rule leaves: anything, from everything that went in."""
    size = math.prod(aval.shape)
    low = np.full(aval.shape, -np.inf)
    parts = {}
    for value in given:
        for k, part in value.parts.items() if is_slope(value) else ():
            if entries(part) * size > MOST:
                raise TooLarge
            shape = (entries(part), *aval.shape)
            parts[k] = Part(np.zeros(shape), np.full(shape, np.inf), True)
    if np.issubdtype(aval.dtype, np.bool_):
        return Slope(np.zeros(aval.shape, bool), np.ones(aval.shape, bool), parts)
    return Slope(low, -low, parts)


def lift(value: Any, shape: tuple[int, ...]) -> Slope:
    """A slope of this shape, from a slope or an array that broadcasts to it."""
    if not is_slope(value):
        value = np.asarray(value)
        value = Slope(value, value, {})
    if value.low.shape == shape:
        return value
    # Axes of length one are repeated; a scalar has all of them.
    padding = (1,) * (len(shape) - value.low.ndim)
    parts = {}
    for k, part in value.parts.items():
        if entries(part) * math.prod(shape) > MOST:
            raise TooLarge
        full = columns(part, entries(part))
        center, radius = (
            np.broadcast_to(v.reshape((len(v), *padding, *v.shape[1:])), (len(v), *shape))
            for v in (full.center, full.radius)
        )
        parts[k] = Part(center, radius, True)
    return Slope(np.broadcast_to(value.low, shape), np.broadcast_to(value.high, shape), parts)


def touched(part: Part) -> Values:
    """Where q depends on v at all."""
    return (part.center != 0) | (part.radius != 0)
