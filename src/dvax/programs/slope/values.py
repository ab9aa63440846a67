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
    """The part as a full one: an axis over the entries of v in front. `size` is that of the largest
    array that it, or what is made of it, is a derivative of.

    **Raises:** `TooLarge`.
    """
    if entries(part) * size > MOST:
        raise TooLarge
    if part.full:
        return part
    shape = (entries(part), *part.center.shape)
    spread = lambda v: np.diag(v.ravel()).reshape(shape)  # noqa: E731
    return Part(spread(part.center), spread(part.radius), True)


def entries(part: Part) -> int:
    """How many entries v has."""
    return part.center.shape[0] if part.full else part.center.size


def mapped(parts: dict[int, Part], fn: Callable[[Part], Part]) -> dict[int, Part]:
    return {k: fn(part) for k, part in parts.items()}


def together(slopes: list[Slope], full: bool = False, size: int = 0) -> dict[int, list[Part]]:
    """For every array that one of the slopes depends on, the parts of all of them, zero where there is
    no dependence, and all diagonal or all full (always full where asked for, for results of this size).
    """
    found = {}
    for k in {k: None for x in slopes for k in x.parts}:
        given = [x.parts.get(k) for x in slopes]
        first = next(part for part in given if part is not None)
        wide = full or any(part is not None and part.full for part in given)
        parts = []
        for x, part in zip(slopes, given, strict=True):
            if part is None:
                shape = np.shape(x.low)
                blank = np.zeros((entries(first), *shape) if wide else shape)
                part = Part(blank, blank, wide)
            parts.append(columns(part, max(size, np.size(x.low))) if wide else part)
        found[k] = parts
    return found


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


def added(x: Slope, y: Slope, sign: float = 1.0) -> dict[int, Part]:
    """The parts of x ± y."""
    return {
        k: Part(a.center + sign * b.center, a.radius + b.radius, a.full)
        for k, (a, b) in together([x, y]).items()
    }


def hull(a: Part, b: Part) -> Part:
    """Any derivative between two of the same form."""
    low = np.minimum(a.center - a.radius, b.center - b.radius)
    high = np.maximum(a.center + a.radius, b.center + b.radius)
    return between(low, high, a.full)


def between(low: Values, high: Values, full: bool) -> Part:
    known = np.isfinite(low) & np.isfinite(high)
    return Part(
        np.where(known, 0.5 * (low + high), 0.0), np.where(known, 0.5 * (high - low), np.inf), full
    )


def negative(x: Slope) -> Slope:
    """−x."""
    return Slope(-x.high, -x.low, mapped(x.parts, lambda p: p._replace(center=-p.center)))


def lift(value: Any, shape: tuple[int, ...]) -> Slope:
    """A slope of this shape, from a slope or an array that broadcasts to it."""
    if not is_slope(value):
        value = np.asarray(value)
        value = Slope(value, value, {})
    if value.low.shape == shape:
        return value
    # Axes of length one are repeated; a scalar has all of them.
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


def touched(part: Part) -> Values:
    """Where q depends on v at all."""
    return (part.center != 0) | (part.radius != 0)
