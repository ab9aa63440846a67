"""Quotients and logarithms of sums of exponentials, such as shares of a logit model, taken as a whole.

With a sum S = Σₖ e^{aₖ} and the weights pₖ = e^{aₖ}/S, which are at most 1 together,

    s = eᵛ/S = 1/Σₖ e^{δₖ},  ∂s = −Σₖ s pₖ ∂δₖ,  δₖ = aₖ − v,    ∂ log S = Σₖ pₖ ∂aₖ.

Interval arithmetic forgets that eᵛ is a term of S, and that a number which is subtracted from all
exponents, so that none overflows, has no effect. Here exponents are affine forms in values of the
program, in which equal values cancel. If n terms are eᵛ itself, then Σ s pₖ = s (1 − n s) over the
others, at most 1/(4 n).
"""

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..interpreter import is_real
from ..primitives import REARRANGING
from .rules_structural import INDEXED, positions
from .values import MAX_ENTRIES, Part, Slope, TooLarge, Values, between, columns, is_slope, product

_MAX_ATOMS = 8
"""Largest number of values in an affine form."""

_DEPTH, _MAX_TERMS = 8, 64
"""Largest number of operations one after the other in an exponent, and in a sum."""


_MAX_JOINED = 512
"""Largest number of terms of sums that are added."""

_UNDERFLOW = 1e-307
"""The smallest upper bound of a weight: more than 1 over the largest floating-point number."""


class _Atom(NamedTuple):
    """The entries `places` of a value, times `factors`."""

    root: Slope
    places: Values
    factors: Values


class _Form(NamedTuple):
    """An array that is affine in other values: a constant plus the sum of the atoms."""

    constant: Values
    atoms: tuple[_Atom, ...]

    def map(self, fn: Any) -> "_Form":
        """Return the form with its entries rearranged."""
        return _Form(fn(self.constant), tuple(_Atom(r, fn(p), fn(c)) for r, p, c in self.atoms))

    def times(self, factor: Values) -> "_Form":
        atoms = (_Atom(r, p, c * factor) for r, p, c in self.atoms)
        return _Form(self.constant * factor, tuple(atoms))

    def plus(self, other: "_Form", sign: float = 1.0) -> "_Form":
        """Return the sum of two forms that broadcast. Equal values are added as one."""
        shape = np.broadcast_shapes(self.constant.shape, other.constant.shape)
        atoms: list[_Atom] = []
        for form, times in ((self, 1.0), (other, sign)):
            for root, places, factors in form.map(lambda v: np.broadcast_to(v, shape)).atoms:
                left = times * factors
                for k, (known, at, before) in enumerate(atoms):
                    if _is_same(known, root):
                        same = at == places
                        atoms[k] = _Atom(known, at, before + np.where(same, left, 0.0))
                        left = np.where(same, 0.0, left)
                if left.any():
                    atoms.append(_Atom(root, places, left))
        return _Form(self.constant + sign * other.constant, tuple(atoms))

    def bounds(self) -> tuple[Values, Values]:
        low = high = self.constant
        for root, places, factors in self.atoms:
            ends = [product(factors, np.ravel(v)[places]) for v in (root.low, root.high)]
            low, high = low + np.minimum(*ends), high + np.maximum(*ends)
        return low, high

    def parts(self) -> dict[int, Part]:
        found: dict[int, Part] = {}
        for root, places, factors in self.atoms:
            for k, part in root.parts.items():
                full = columns(part, max(root.low.size, places.size))
                rows = (v.reshape(len(v), -1)[:, places] for v in full[:2])
                center, radius = (product(f, v) for f, v in zip((factors, abs(factors)), rows))
                if k in found:
                    center, radius = center + found[k].center, radius + found[k].radius
                found[k] = Part(center, radius, True)
        return found

    def is_zero(self) -> Values:
        """Return where the form is 0 whatever the values are."""
        return np.logical_and.reduce([self.constant == 0, *(a.factors == 0 for a in self.atoms)])


def _is_same(a: Slope, b: Slope) -> bool:
    return a is b or (None not in (a.source, b.source) and a.source.key == b.source.key)


def _atom(value: Slope) -> _Form:
    places = np.arange(value.low.size).reshape(value.low.shape)
    return _Form(np.zeros(value.low.shape), (_Atom(value, places, np.ones(value.low.shape)),))


def _operation(value: Any) -> tuple[str, Any, tuple[Any, ...]]:
    """Return the name of the operation that computed a value, the operation, and its operands."""
    source = value.source if is_slope(value) else None
    if source is None or source.eqn is None or not is_real(source.eqn.outvars[0].aval):
        return "", None, ()
    return source.eqn.primitive.name, source.eqn, source.operands


def _rearranged(eqn: Any, operands: tuple[Any, ...], form: _Form, behind: int = 0) -> _Form | None:
    """Return the form of rearranged entries; `behind`: number of axes behind them that stay."""
    places = positions(eqn, list(operands))
    if places is None or (places < 0).any():
        return None

    def rearranged(v: Values) -> Values:
        tail = v.shape[v.ndim - behind :] if behind else ()
        return v.reshape(-1, *tail)[places]

    return form.map(rearranged)


def _form(value: Any, depth: int = _DEPTH) -> _Form:
    """Return a value as an affine form in values that are not affine themselves."""
    if not is_slope(value):
        return _Form(np.asarray(value, float), ())
    name, eqn, operands = _operation(value)
    form = None
    if depth == 0:
        return _atom(value)
    if name in REARRANGING | INDEXED and not any(map(is_slope, operands[1:])):
        form = _rearranged(eqn, operands, _form(operands[0], depth - 1))
    elif name in ("add", "add_any", "sub"):
        left, right = (_form(v, depth - 1) for v in operands)
        form = left.plus(right, -1.0 if name == "sub" else 1.0)
    elif name == "neg":
        form = _form(operands[0], depth - 1).times(-1.0)
    elif name == "mul" and not all(map(is_slope, operands)):
        factor, other = sorted(operands, key=is_slope)
        form = _form(other, depth - 1).times(np.asarray(factor, float))
    elif name == "div" and not is_slope(operands[1]):
        form = _form(operands[0], depth - 1).times(1.0 / np.asarray(operands[1], float))
    if form is None or len(form.atoms) > _MAX_ATOMS or not np.isfinite(form.constant).all():
        return _atom(value)
    return form.map(lambda v: np.broadcast_to(v, value.low.shape))


def _exponents(value: Any, depth: int = _MAX_TERMS) -> _Form | None:
    """Return a for a value Σₖ e^{aₖ}, with an axis for the terms behind the others; None where it is
    not such a sum."""
    if not is_slope(value):
        constant = np.asarray(value, float)
        if not (constant > 0).all() or not np.isfinite(constant).all():
            return None
        return _Form(np.log(constant)[..., None], ())
    name, eqn, operands = _operation(value)
    if name == "exp":
        return _form(operands[0]).map(lambda v: v[..., None])
    rule = _SUMS.get(name)
    if rule is None or depth == 0:
        return None
    terms = []
    for operand in operands[:1] if name in INDEXED else operands:
        terms.append(_exponents(operand, depth - 1))
        if terms[-1] is None:
            return None
    return rule(eqn, operands, *terms)


def _total(eqn: Any, operands: tuple[Any, ...], terms: _Form) -> _Form:
    """Return the terms of a sum over axes."""
    axes, of = tuple(eqn.params["axes"]), np.shape(operands[0].low)

    def behind(v: Values) -> Values:
        v = np.broadcast_to(v, (*of, v.shape[-1]))
        last = range(len(of) - len(axes), len(of))
        return np.moveaxis(v, axes, last).reshape(*eqn.outvars[0].aval.shape, -1)

    return terms.map(behind)


def _sum(eqn: Any, operands: tuple[Any, ...], a: _Form, b: _Form) -> _Form:
    return _joined(a, b, eqn.outvars[0].aval.shape)


def _joined(a: _Form, b: _Form, shape: tuple[int, ...]) -> _Form:
    """Return the terms of two sums.

    **Raises:** `TooLarge`.
    """
    if a.constant.shape[-1] + b.constant.shape[-1] > _MAX_JOINED:
        raise TooLarge
    a, b = (f.map(lambda v: np.broadcast_to(v, (*shape, v.shape[-1]))) for f in (a, b))
    join = lambda v, w: np.concatenate([v, w], axis=-1)  # noqa: E731
    atoms, left = [], list(b.atoms)
    for root, *first in a.atoms:
        # One atom for both sums, where they have the same value.
        same = next((k for k, atom in enumerate(left) if _is_same(atom.root, root)), None)
        second = [np.zeros_like(b.constant, v.dtype) for v in first]
        if same is not None:
            second = left.pop(same)[1:]
        atoms.append(_Atom(root, *map(join, first, second)))
    for root, *second in left:
        atoms.append(_Atom(root, *(join(np.zeros_like(a.constant, v.dtype), v) for v in second)))
    return _Form(join(a.constant, b.constant), tuple(atoms))


def _product(eqn: Any, operands: tuple[Any, ...], a: _Form, b: _Form) -> _Form | None:
    """Return the terms of a sum times or over a constant."""
    if is_slope(operands[1]) and (eqn.primitive.name == "div" or is_slope(operands[0])):
        return None
    return a.plus(b, -1.0 if eqn.primitive.name == "div" else 1.0)


_SUMS: dict[str, Any] = {
    **dict.fromkeys(REARRANGING | INDEXED, partial(_rearranged, behind=1)),
    **dict.fromkeys(("add", "add_any"), _sum),
    **dict.fromkeys(("mul", "div"), _product),
    "reduce_sum": _total,
    "abs": lambda eqn, operands, terms: terms,
}


def _weights(a: _Form) -> tuple[Values, Values]:
    """Return bounds on pₖ = 1/Σⱼ e^{aⱼ − aₖ}."""
    if a.constant.size * a.constant.shape[-1] > MAX_ENTRIES:
        raise TooLarge
    pairs = a.map(lambda v: v[..., None, :]).plus(a.map(lambda v: v[..., :, None]), -1.0)
    low, high = pairs.bounds()
    least, largest = 1.0 / np.exp(high).sum(axis=-1), 1.0 / np.exp(low).sum(axis=-1)
    return least, np.maximum(largest, _UNDERFLOW)


def _sums(a: _Form) -> list[tuple[Values, Values]]:
    """Return the lower bounds, and the upper ones, of Σₖ e^{aₖ} over all terms, and over those that are
    not constantly 1."""
    is_other = ~a.is_zero()
    terms = [np.exp(v) for v in a.bounds()]
    return [(v.sum(axis=-1), v.sum(axis=-1, where=is_other)) for v in terms]


def _share(part: Values, total: Values) -> Values:
    """Return part/total, 1 where both overflow. (The difference of 1 and the rest would cancel.)"""
    return np.where(np.isinf(part) | (total == 0), 1.0, part / total)


def _combined(
    delta: _Form, weights: tuple[Values, Values], total: tuple[Values, Values], sign: float
) -> dict[int, Part]:
    """Return the parts of ± Σₖ wₖ ∂δₖ over the terms that are not 0, for weights ≥ 0 between these
    bounds with a sum between those of `total`."""
    is_other = ~delta.is_zero()
    parts = {}
    for k, part in delta.parts().items():
        low, high = part.center - part.radius, part.center + part.radius
        ends = [product(w, v) for w in weights for v in (low, high)]
        least = np.minimum.reduce(ends).sum(axis=-1, where=is_other)
        largest = np.maximum.reduce(ends).sum(axis=-1, where=is_other)
        # Another bound: the sum of the weights times numbers between the ends.
        first = low.min(axis=-1, where=is_other, initial=math.inf)
        last = high.max(axis=-1, where=is_other, initial=-math.inf)
        has_others = is_other.any(axis=-1)
        first, last = np.where(has_others, first, 0.0), np.where(has_others, last, 0.0)
        ends = [product(t, v) for t in total for v in (first, last)]
        least = np.maximum(least, np.minimum.reduce(ends))
        largest = np.minimum(largest, np.maximum.reduce(ends))
        least, largest = np.minimum(least, largest), np.maximum(least, largest)
        parts[k] = between(*((least, largest) if sign > 0 else (-largest, -least)), True)
    return parts


def _quotient(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of c eᵛ/Σₖ e^{aₖ}, for a constant c."""
    over, factor = operands[0], 1.0
    while True:
        name, _, inside = _operation(over)
        if name == "neg":
            over, factor = inside[0], -factor
        elif name == "mul" and not all(map(is_slope, inside)):
            constant, over = sorted(inside, key=is_slope)
            factor = factor * np.asarray(constant, float)
        else:
            break
    if not is_slope(over) or not is_slope(operands[1]):
        return None
    v, a = _exponents(over), _exponents(operands[1])
    if v is None or a is None or v.constant.shape[-1] != 1:
        return None
    shape = eqn.outvars[0].aval.shape
    a = a.map(lambda w: np.broadcast_to(w, (*shape, w.shape[-1])))
    delta = a.plus(v, -1.0)
    (smallest, others), (largest_sum, most_others) = _sums(delta)
    low, high = 1.0 / largest_sum, np.maximum(1.0 / smallest, _UNDERFLOW)
    least, largest = _weights(a)
    own = delta.is_zero().sum(axis=-1)
    most = np.where(own > 0, 0.25 / np.maximum(own, 1), np.inf)
    at_ends = low * _share(most_others, largest_sum), high * _share(others, smallest)
    has_peak = (own > 0) & (2.0 * own * low <= 1.0) & (2.0 * own * high >= 1.0)
    total = np.minimum(*at_ends), np.where(has_peak, most, np.maximum(*at_ends))
    weights = low[..., None] * least, np.minimum(high[..., None] * largest, most[..., None])
    parts = _combined(delta, weights, total, -1.0)
    ends = [product(factor, end) for end in (low, high)]
    factor = np.broadcast_to(factor, shape)
    parts = {
        k: Part(product(factor, p.center), product(abs(factor), p.radius), True)
        for k, p in parts.items()
    }
    return Slope(np.minimum(*ends), np.maximum(*ends), parts)


def _logarithm(exponents: _Form, sign: float = 1.0) -> Slope:
    """Return the slope of ± log Σₖ e^{aₖ}."""
    ends = [np.logaddexp.reduce(v, axis=-1) for v in exponents.bounds()]
    least, largest = _weights(exponents)
    rest = tuple(_share(others, total) for total, others in _sums(exponents))
    parts = _combined(exponents, (least, largest), rest, sign)
    low, high = ends if sign > 0 else (-ends[1], -ends[0])
    return Slope(low, high, parts)


def _log_sum(value: Any, depth: int = _DEPTH) -> _Form | None:
    """Return a for a value log Σₖ e^{aₖ}, None where it is not one."""
    name, eqn, operands = _operation(value)
    if name == "log":
        return _exponents(operands[0])
    if name == "log1p":
        inner = _exponents(operands[0])
        one = _Form(np.zeros((*value.low.shape, 1)), ())
        return None if inner is None else _joined(one, inner, value.low.shape)
    if depth and name in REARRANGING | INDEXED:
        inner = _log_sum(operands[0], depth - 1)
        return None if inner is None else _rearranged(eqn, operands, inner, 1)
    return None


def _with_logarithm(eqn: Any, operands: list[Any]) -> Slope | None:
    """Return the slope of v ± log Σₖ e^{aₖ} = ± log Σₖ e^{aₖ ± v}, or of log Σₖ e^{aₖ} − v."""
    minus = -1.0 if eqn.primitive.name == "sub" else 1.0
    shape = eqn.outvars[0].aval.shape
    for k, sign in ((1, minus), (0, 1.0)):
        a = _log_sum(operands[k])
        if a is not None:
            a = a.map(lambda w: np.broadcast_to(w, (*shape, w.shape[-1])))
            v = _form(operands[1 - k]).map(lambda w: np.broadcast_to(w, shape)[..., None])
            return _logarithm(a.plus(v, minus), sign)
    return None


def of_exponentials(eqn: Any, operands: list[Any], result: Slope) -> Slope | None:
    """Return the slope of an operation on sums of exponentials; None where it is none."""
    name = eqn.primitive.name
    if name not in ("div", "log", "log1p", "add", "sub") or not is_real(eqn.outvars[0].aval):
        return None
    try:
        if name == "div":
            return _quotient(eqn, operands)
        if name in ("add", "sub"):
            return _with_logarithm(eqn, operands)
        a = _log_sum(result)
        return None if a is None else _logarithm(a)
    except TooLarge:
        return None
