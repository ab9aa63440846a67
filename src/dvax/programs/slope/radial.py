"""Functions of a vector and its length, v g(s) and g(s) with s = |v|² or s = |v|, taken as a whole.

Examples: regularised friction v/√(ε² + |v|²), drag v |v|, v/(1 + |v|), exp(−|v|²) v. With |v|² = s,

    ∂(vⱼ g) = g ∂vⱼ + 2 g′ vⱼ Σₖ vₖ ∂vₖ,    0 ≤ vⱼ² ≤ s,    |vⱼ vₖ| ≤ s/2 for j ≠ k,

and with |v| = s the same holds with 1/s in place of 2, and s² in place of s. Interval arithmetic
forgets that g is small where v is large. So g and g′ are bounded on pieces of the interval of s, as
those of a chain are.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..._jax.known_functions import operation
from ..interpreter import is_real
from ..primitives import REARRANGING
from .chains import OPERATIONS, cuts, widened
from .rules_structural import positions
from .values import Part, Slope, TooLarge, Values, columns, is_slope, mapped, product, scaled


class _Length(NamedTuple):
    """The lengths of the vectors that are the rows of a value, on pieces of their intervals.

    - `key`: that of the source of the length; `vector`: the value;
    - `rows`: for each entry of the value, the number of its row;
    - `squared`: the largest |v|² on each piece; `change`: the largest |∂s/∂v| there.
    """

    key: int
    vector: Slope
    rows: Values
    squared: Values
    change: Values


class _Radial(NamedTuple):
    """A value factor · v · g(s), or g(s) if `factor` is None, on pieces of the intervals of s.

    `places`: for each entry, the number of its row (of g), or of the entry of v.
    """

    length: _Length
    g: Slope
    places: Values
    factor: Values | None


class RadialFunctions:
    """The values of one enclosure that are functions of a vector and its length.

    `operate(eqn, operands)` returns the result of an elementwise operation.
    """

    def __init__(self, operate: Callable[[Any, list[Any]], Slope | None]):
        self._operate = operate
        self._known: dict[int, tuple[Any, _Radial | None]] = {}

    def of(self, value: Slope) -> Slope | None:
        """Return the bounds on a value that follow from its being radial; None where it is not."""
        found = self._radial(value)
        if found is None or value.source.key == found.length.vector.source.key:
            return None
        try:
            return _vector(found) if found.factor is not None else _number(found)
        except TooLarge:
            return None

    def _radial(self, value: Any) -> _Radial | None:
        source = value.source if is_slope(value) else None
        if source is None or source.eqn is None:
            return None
        # Not by its key: in a branch the same operation has bounds that are valid only there. The
        # source is kept, so that no other one gets its id.
        if id(source) not in self._known:
            self._known[id(source)] = source, self._computed(value, source.eqn, source.operands)
        return self._known[id(source)][1]

    def _computed(self, value: Slope, eqn: Any, operands: tuple[Any, ...]) -> _Radial | None:
        if not is_real(eqn.outvars[0].aval):
            return None
        vector, scale = _argument(eqn, operands)
        if vector is not None:
            return _length(value, vector, scale, eqn)
        name = eqn.primitive.name
        if name in REARRANGING:
            inner = self._radial(operands[0])
            if inner is None or inner.factor is not None:
                return None
            places = positions(eqn, list(operands))
            if places is None or (places < 0).any():
                return None
            return inner._replace(places=inner.places.ravel()[places])
        if name not in OPERATIONS:
            return None
        return self._combined(eqn, operands)

    def _combined(self, eqn: Any, operands: tuple[Any, ...]) -> _Radial | None:
        """Return an elementwise operation on radial values, the vector itself, and constants."""
        found = [self._radial(v) for v in operands]
        known = next((f for f in found if f is not None), None)
        if known is None:
            return None
        length, shape, name = known.length, eqn.outvars[0].aval.shape, eqn.primitive.name
        key = length.vector.source.key
        numbers: list[Any] = []
        places, factor, over = None, None, False
        for k, (v, f) in enumerate(zip(operands, found, strict=True)):
            if f is None and is_slope(v):
                multiple = _multiple(v, key)
                if multiple is None or factor is not None:
                    return None
                factor, over = np.broadcast_to(multiple, shape), k == 1
                continue
            if f is None:
                numbers.append(np.asarray(v, float))
                continue
            if not _is_same(f.length, length):
                return None
            if f.factor is not None:
                if factor is not None:
                    return None
                factor, over = np.broadcast_to(f.factor, shape), k == 1
            else:
                own = np.broadcast_to(f.places, shape)
                if places is not None and not np.array_equal(own, places):
                    return None
                places = own
            numbers.append(f.g)
        if factor is None:
            return self._of_length(eqn, numbers, length, places)
        if shape != length.rows.shape or (places is not None and (places != length.rows).any()):
            return None
        linear = {"mul", "neg"} | (set() if over else {"div"})
        if name not in linear:
            return None
        # Constants change the factor, functions of s change g.
        slopes = [v for v in numbers if is_slope(v)]
        for constant in (v for v in numbers if not is_slope(v)):
            factor = factor * constant if name == "mul" else factor / constant
        if name == "neg":
            factor = -factor
        if len(slopes) == 2 or (name == "div" and found[0] is None and len(slopes) == 1):
            left = slopes[0] if len(slopes) == 2 else np.ones(())
            return self._times(eqn, left, slopes[-1], length, factor)
        g = slopes[0] if slopes else None
        return None if g is None else _Radial(length, g, length.rows, factor)

    def _times(
        self, eqn: Any, left: Any, right: Slope, length: _Length, factor: Values
    ) -> _Radial | None:
        g = self._operate(widened(eqn, right.low.shape), [left, right])
        return None if g is None else _Radial(length, g, length.rows, factor)

    def _of_length(
        self, eqn: Any, numbers: list[Any], length: _Length, places: Any
    ) -> _Radial | None:
        """Return the result of an operation on functions of s and constants."""
        shape = length.squared.shape
        one_to_one = np.array_equal(places.ravel(), np.arange(shape[1]))
        given = []
        for v in numbers:
            if not is_slope(v) and np.size(v) > 1:
                if not one_to_one or np.size(v) != shape[1]:
                    return None
                v = np.reshape(v, (1, -1))
            elif not is_slope(v):
                v = np.reshape(v, ())
            given.append(v)
        g = self._operate(widened(eqn, shape), given)
        return None if g is None else _Radial(length, g, places, None)


def _is_same(a: _Length, b: _Length) -> bool:
    """Return whether two lengths are the same one in the same region."""
    return a is b or (a.key == b.key and np.array_equal(a.squared, b.squared))


def _multiple(value: Slope, key: int) -> Values | None:
    """Return the constant whose product with the vector of this key is the value; None without one."""
    factor: Values = np.ones(())
    while value.source is not None and value.source.key != key and value.source.eqn is not None:
        name, operands = value.source.eqn.primitive.name, value.source.operands
        if name == "neg":
            factor = -factor
        elif name == "mul" and not all(map(is_slope, operands)):
            operands = sorted(operands, key=is_slope, reverse=True)
            factor = factor * np.asarray(operands[1], float)
        elif name == "div" and not is_slope(operands[1]):
            factor = factor / np.asarray(operands[1], float)
        else:
            return None
        value = operands[0]
    return factor if value.source is not None and value.source.key == key else None


def _argument(eqn: Any, operands: tuple[Any, ...]) -> tuple[Slope | None, float]:
    """Return v and c of an operation that computes c |v|² or, with c = 1, |v|, also of rows."""
    name, nothing = operation(eqn), (None, 1.0)
    if name == "norm":
        return operands[0], 1.0
    if name == "dot_general" and all(is_slope(v) and v.low.ndim == 1 for v in operands):
        # (−v) @ v is what Python reads in exp(−v @ v).
        for v, other in (operands, operands[::-1]):
            factor = None if v.source is None else _multiple(other, v.source.key)
            if factor is not None and np.size(factor) == 1:
                return v, float(factor)
        return nothing
    source = operands[0].source if name == "reduce_sum" and is_slope(operands[0]) else None
    if source is None or source.eqn is None:
        return nothing
    inner, given = source.eqn.primitive.name, source.operands
    squares = inner == "square" or (inner == "integer_pow" and source.eqn.params["y"] == 2)
    if inner == "mul" and all(map(is_slope, given)):
        squares = given[0].source.key == given[1].source.key
    return (given[0], 1.0) if squares else nothing


def _length(value: Slope, vector: Slope, scale: float, eqn: Any) -> _Radial | None:
    """Return the length of a vector, or of its rows, times `scale`, as a function of itself."""
    if vector.source is None or vector.low.size < 2 or scale == 0.0:
        return None
    name, shape = operation(eqn), vector.low.shape
    if name == "reduce_sum":
        axes = tuple(eqn.params["axes"])
    else:
        # The norm of all entries, or along the first or the last axis.
        out = value.low.shape
        axes = {
            (): tuple(range(len(shape))), shape[:-1]: (len(shape) - 1,), shape[1:]: (0,),
        }.get(out)  # fmt: skip
        if axes is None or (out != () and len(set(shape)) < len(shape)):
            return None
    low, high = np.sort([value.low.ravel() / scale, value.high.ravel() / scale], axis=0)
    low, is_norm = np.maximum(low, 0.0), name == "norm"
    # Pieces of |v|: in |v|² the smallest ones are too long for a function such as √(ε² + |v|²).
    roots = [v if is_norm else np.sqrt(v) for v in (low, np.maximum(high, low))]
    ends = cuts(*roots)
    if ends is None:
        return None
    numbers = np.arange(value.low.size).reshape(value.low.shape)
    rows = np.broadcast_to(np.expand_dims(numbers, axes), shape)
    if not is_norm:
        # The ends stay as they are: squares of roots are rounded.
        ends = np.concatenate([low[None], ends[1:-1] ** 2, np.maximum(high, low)[None]])
    first, last = ends[:-1], ends[1:]
    ones = np.ones_like(last)
    low, high = np.sort([scale * first, scale * last], axis=0)
    g = Slope(low, high, {0: Part(scale * ones, np.zeros_like(ones), False)})
    squared = last**2 if is_norm else last
    change = ones if is_norm else 2.0 * np.sqrt(last)
    return _Radial(_Length(value.source.key, vector, rows, squared, change), g, numbers, None)


def _slope_of(g: Slope) -> tuple[Values, Values]:
    """Return bounds on g′ on each piece."""
    part = g.parts.get(0)
    if part is None:
        return np.zeros_like(g.low), np.zeros_like(g.low)
    return part.center - part.radius, part.center + part.radius


def _magnitudes(part: Part, length: _Length) -> tuple[Part, Values]:
    """Return the part of v in full, and the sum of the largest |∂v| over the entries of each row."""
    full = columns(part, length.vector.low.size)
    sizes = (np.abs(full.center) + full.radius).reshape(len(full.center), -1)
    sums = np.zeros((len(sizes), length.squared.shape[1]))
    np.add.at(sums.T, length.rows.ravel(), sizes.T)
    return full, sums


def _number(found: _Radial) -> Slope:
    """Return the slope of g(s)."""
    length, g, places, _ = found
    reach = np.max(product(np.maximum(*map(np.abs, _slope_of(g))), length.change), axis=0)

    def derivative(part: Part) -> Part:
        _, sums = _magnitudes(part, length)
        radius = product(reach[places], sums[:, places])
        return Part(np.zeros_like(radius), radius, True)

    low, high = np.min(g.low, axis=0)[places], np.max(g.high, axis=0)[places]
    return Slope(low, high, mapped(length.vector.parts, derivative))


def _vector(found: _Radial) -> Slope:
    """Return the slope of factor · v · g(s)."""
    length, g, rows, factor = found
    v, factor = length.vector, np.asarray(factor)
    # The largest vⱼ² |∂s/∂v|/|v| on each piece.
    most = length.change * np.sqrt(length.squared)
    ends = [product(end, most) for end in _slope_of(g)]
    low = np.min(g.low + np.minimum(0.0, np.minimum(*ends)), axis=0)[rows]
    high = np.max(g.high + np.maximum(0.0, np.maximum(*ends)), axis=0)[rows]
    across = np.max(0.5 * np.maximum(*map(np.abs, ends)), axis=0)[rows]

    def derivative(part: Part) -> Part:
        full, sums = _magnitudes(part, length)
        own = scaled(full, low, high)
        others = np.maximum(sums[:, rows] - (np.abs(full.center) + full.radius), 0.0)
        radius = own.radius + product(across, others)
        return Part(product(factor, own.center), product(np.abs(factor), radius), True)

    # |v g| ≤ |v| |g| on each piece.
    size = np.max(product(np.sqrt(length.squared), np.maximum(*map(np.abs, g[:2]))), axis=0)
    reach = product(np.abs(factor), size[rows])
    return Slope(-reach, reach, mapped(v.parts, derivative))
