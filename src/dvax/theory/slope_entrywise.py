"""The rules of slope arithmetic for operations entry by entry."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.special import erf

from .slope import (
    Part,
    Slope,
    Values,
    added,
    columns,
    entries,
    hull,
    is_slope,
    lift,
    mapped,
    product,
    scaled,
    touched,
)

Rule = Callable[[Any, list[Any]], Slope | None]
Ends = tuple[Values, Values]


def _lifted(eqn: Any, given: list[Any]) -> list[Slope]:
    return [lift(value, eqn.outvars[0].aval.shape) for value in given]


def _add(eqn: Any, given: list[Any]) -> Slope:
    x, y = _lifted(eqn, given)
    return Slope(x.low + y.low, x.high + y.high, added(x.parts, y.parts))


def _sub(eqn: Any, given: list[Any]) -> Slope:
    x, y = _lifted(eqn, given)
    return Slope(x.low - y.high, x.high - y.low, added(x.parts, y.parts, -1.0))


def _corners(x: Slope, y: Slope) -> Ends:
    products = [product(a, b) for a in (x.low, x.high) for b in (y.low, y.high)]
    return np.minimum.reduce(products), np.maximum.reduce(products)


def _mul(eqn: Any, given: list[Any]) -> Slope:
    x, y = _lifted(eqn, given)
    low, high = _corners(x, y)
    by_x = mapped(x.parts, lambda part: scaled(part, y.low, y.high))
    by_y = mapped(y.parts, lambda part: scaled(part, x.low, x.high))
    return Slope(low, high, added(by_x, by_y))


def _reciprocal(y: Slope) -> Slope:
    clear = (y.low > 0) | (y.high < 0)
    low = np.where(clear, 1.0 / y.high, -np.inf)
    high = np.where(clear, 1.0 / y.low, np.inf)
    a, b = -1.0 / y.low**2, -1.0 / y.high**2
    steepest = np.where(clear, np.minimum(a, b), -np.inf)
    flattest = np.where(clear, np.maximum(a, b), 0.0)
    return Slope(low, high, mapped(y.parts, lambda part: scaled(part, steepest, flattest)))


def _div(eqn: Any, given: list[Any]) -> Slope | None:
    if not jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.floating):
        return None  # integers are divided with a remainder
    x, y = _lifted(eqn, given)
    return _mul(eqn, [x, _reciprocal(y)])


def _neg(eqn: Any, given: list[Any]) -> Slope:
    (x,) = given
    return Slope(-x.high, -x.low, mapped(x.parts, lambda p: p._replace(center=-p.center)))


def _largest(x: Slope, y: Slope) -> Slope:
    first, second = x.low >= y.high, y.low >= x.high
    zero = lambda p: Part(np.zeros_like(p.center), np.zeros_like(p.radius), p.full)  # noqa: E731
    parts = {}
    for k in {**x.parts, **y.parts}:
        a = x.parts[k] if k in x.parts else zero(y.parts[k])
        b = y.parts[k] if k in y.parts else zero(x.parts[k])
        if a.full != b.full:
            a, b = columns(a, entries(a)), columns(b, entries(b))
        both = hull(a, b)
        pick = lambda i, a=a, b=b, both=both: np.where(  # noqa: E731
            first, a[i], np.where(second, b[i], both[i])
        )
        parts[k] = Part(pick(0), pick(1), a.full)
    return Slope(np.maximum(x.low, y.low), np.maximum(x.high, y.high), parts)


def _max(eqn: Any, given: list[Any]) -> Slope:
    return _largest(*_lifted(eqn, given))


def _min(eqn: Any, given: list[Any]) -> Slope:
    x, y = _lifted(eqn, given)
    return _neg(eqn, [_largest(_neg(eqn, [x]), _neg(eqn, [y]))])


def _clamp(eqn: Any, given: list[Any]) -> Slope:
    low, x, high = given
    return _min(eqn, [_max(eqn, [x, low]), high])


def _smooth(values: Callable[..., Ends], slopes: Callable[..., Ends]) -> Rule:
    """φ entry by entry, from the range of φ and that of φ′ over an interval."""

    def rule(eqn: Any, given: list[Any]) -> Slope:
        x = given[0]
        low, high = values(x.low, x.high)
        down, up = slopes(x.low, x.high)
        return Slope(low, high, mapped(x.parts, lambda part: scaled(part, down, up)))

    return rule


def _rising(phi: Callable, slopes: Callable[..., Ends], begin: float = -np.inf) -> Rule:
    """An increasing φ on (begin, ∞)."""

    def values(low: Values, high: Values) -> Ends:
        inside = low >= begin
        return np.where(inside, phi(low), -np.inf), np.where(inside, phi(high), np.inf)

    def bounded(low: Values, high: Values) -> Ends:
        down, up = slopes(low, high)
        inside = low >= begin
        return np.where(inside, down, -np.inf), np.where(inside, up, np.inf)

    return _smooth(values, bounded)


def _hill(phi: Callable) -> Callable[..., Ends]:
    """The range of an even φ that falls away from 0."""

    def values(low: Values, high: Values) -> Ends:
        nearest = np.where((low <= 0) & (high >= 0), 0.0, np.minimum(np.abs(low), np.abs(high)))
        return phi(np.maximum(np.abs(low), np.abs(high))), phi(nearest)

    return values


def _sech(v: Values) -> Values:
    # 1 − tanh² would cancel to 0 where the slope is small and not 0.
    return 1.0 / np.cosh(np.minimum(np.abs(v), 350.0))


def _valley(phi: Callable) -> Callable[..., Ends]:
    """The range of an even φ that rises away from 0."""
    hill = _hill(lambda v: -phi(v))

    def values(low: Values, high: Values) -> Ends:
        down, up = hill(low, high)
        return -up, -down

    return values


def _wave(shift: float) -> Callable[..., Ends]:
    """The range of sin(v + shift)."""

    def values(low: Values, high: Values) -> Ends:
        a, b = low + shift, high + shift
        wide = ~((b - a) < 2 * np.pi)
        top = np.floor((b - np.pi / 2) / (2 * np.pi)) >= np.ceil((a - np.pi / 2) / (2 * np.pi))
        floor = np.floor((b + np.pi / 2) / (2 * np.pi)) >= np.ceil((a + np.pi / 2) / (2 * np.pi))
        ends = np.sin(a), np.sin(b)
        return (
            np.where(wide | floor, -1.0, np.minimum(*ends)),
            np.where(wide | top, 1.0, np.maximum(*ends)),
        )

    return values


def _powers(low: Values, high: Values, n: int) -> Ends:
    """The range of vⁿ, n ≥ 0."""
    if n == 0:
        return np.ones_like(low), np.ones_like(high)
    if n % 2:
        return low**n, high**n
    across = (low <= 0) & (high >= 0)
    return np.where(across, 0.0, np.minimum(low**n, high**n)), np.maximum(low**n, high**n)


def _integer_pow(eqn: Any, given: list[Any]) -> Slope:
    n = eqn.params.get("y", 2)
    if n < 0:
        return _reciprocal(_power(given[0], -n))
    return _power(given[0], n)


def _power(x: Slope, n: int) -> Slope:
    low, high = _powers(x.low, x.high, n)
    down, up = _powers(x.low, x.high, n - 1) if n > 0 else (np.zeros(()), np.zeros(()))
    parts = mapped(x.parts, lambda part: scaled(part, n * down, n * up))
    return Slope(low, high, parts)


def _pow(eqn: Any, given: list[Any]) -> Slope | None:
    """vᵖ for a fixed number p > 0 and v ≥ 0."""
    x, p = given
    if is_slope(p) or not is_slope(x) or np.size(p) != 1 or not float(p) > 0:
        return None
    p = float(p)
    slopes = lambda a, b: np.sort([p * a ** (p - 1), p * b ** (p - 1)], axis=0)  # noqa: E731
    return _rising(lambda v: v**p, lambda a, b: tuple(slopes(a, b)), 0.0)(eqn, [x])


def _rsqrt(eqn: Any, given: list[Any]) -> Slope | None:
    root = _sqrt(eqn, given)
    return None if root is None else _reciprocal(root)


def _abs(eqn: Any, given: list[Any]) -> Slope:
    (x,) = given
    return _largest(x, _neg(eqn, [x]))


def _stairs(phi: Callable) -> Rule:
    """A φ of steps: constant where both ends of the interval are on the same one."""

    def rule(eqn: Any, given: list[Any]) -> Slope:
        (x,) = given
        low, high = phi(x.low), phi(x.high)
        jump = np.where(low == high, 0.0, np.inf)
        still = lambda p: Part(  # noqa: E731
            np.zeros_like(p.center), np.where(touched(p), jump, 0.0), p.full
        )
        return Slope(low, high, mapped(x.parts, still))

    return rule


def _round(eqn: Any, given: list[Any]) -> Slope | None:
    """Halves go to the even side, or away from zero."""
    to_even = eqn.params["rounding_method"] == lax.RoundingMethod.TO_NEAREST_EVEN
    away = lambda v: np.sign(v) * np.floor(np.abs(v) + 0.5)  # noqa: E731
    return _stairs(np.round if to_even else away)(eqn, given)


def _marks(*slopes: Slope) -> dict[int, Part]:
    """What truth values depend on: no derivatives, 1 where there is a dependence."""
    marks: dict[int, Part] = {}
    for x in slopes:
        one = mapped(x.parts, lambda p: Part(touched(p) * 1.0, np.zeros_like(p.radius), p.full))
        marks = added(marks, one)
    return marks


def _compare(decide: Callable[[Slope, Slope], Ends]) -> Rule:
    def rule(eqn: Any, given: list[Any]) -> Slope:
        x, y = _lifted(eqn, given)
        low, high = decide(x, y)
        return Slope(low, high, _marks(x, y))

    return rule


def _equal(eqn: Any, given: list[Any]) -> Slope:
    x, y = _lifted(eqn, given)
    surely = (x.low == x.high) & (y.low == y.high) & (x.low == y.low)
    if eqn.invars[0] is eqn.invars[1]:
        # What code asks itself to find NaN.
        surely = np.ones(x.low.shape, bool)
    return Slope(surely, surely | (x.low <= y.high) & (y.low <= x.high), _marks(x, y))


def _unequal(eqn: Any, given: list[Any]) -> Slope:
    x = _equal(eqn, given)
    return Slope(~x.high, ~x.low, x.parts)


def _logic(fn: Callable) -> Rule:
    """What grows with each of its truth values."""

    def rule(eqn: Any, given: list[Any]) -> Slope | None:
        x = _lifted(eqn, given)
        if not all(v.low.dtype == bool for v in x):
            return None
        return Slope(fn(*(v.low for v in x)), fn(*(v.high for v in x)), _marks(*x))

    return rule


def _not(eqn: Any, given: list[Any]) -> Slope | None:
    (x,) = given
    return Slope(~x.high, ~x.low, x.parts) if x.low.dtype == bool else None


def _select(eqn: Any, given: list[Any]) -> Slope | None:
    which, *cases = given
    shape = eqn.outvars[0].aval.shape
    cases = [lift(case, shape) for case in cases]
    choice = lift(which, shape)
    if len(cases) != 2 or choice.low.dtype != bool:
        return None
    no, yes = cases
    known = choice.low == choice.high
    pick = lambda a, b: np.where(choice.low, b, a)  # noqa: E731
    low = np.where(known, pick(no.low, yes.low), np.minimum(no.low, yes.low))
    high = np.where(known, pick(no.high, yes.high), np.maximum(no.high, yes.high))
    blank = lambda p: Part(np.zeros_like(p.center), np.zeros_like(p.radius), p.full)  # noqa: E731
    parts = {}
    for k in {**no.parts, **yes.parts, **choice.parts}:
        every = [v.parts[k] for v in (no, yes, choice) if k in v.parts]
        if len({part.full for part in every}) > 1:
            every = [columns(part, entries(part)) for part in every]
        sample = every[0]
        a, b, by_choice = (
            (columns(v.parts[k], entries(v.parts[k])) if sample.full else v.parts[k])
            if k in v.parts
            else blank(sample)
            for v in (no, yes, choice)
        )
        # Where the choice itself may change with v the value may jump.
        loose = np.where(touched(by_choice), np.inf, hull(a, b).radius)
        radius = np.where(known, pick(a.radius, b.radius), loose)
        center = np.where(known, pick(a.center, b.center), hull(a, b).center)
        parts[k] = Part(center, radius, sample.full)
    return Slope(low, high, parts)


def _convert(eqn: Any, given: list[Any]) -> Slope | None:
    (x,) = given
    before, after = eqn.invars[0].aval.dtype, eqn.outvars[0].aval.dtype
    if jnp.issubdtype(after, jnp.floating) and jnp.issubdtype(before, jnp.floating):
        return x if jnp.finfo(after).eps <= jnp.finfo(before).eps else None
    if not jnp.issubdtype(after, jnp.floating):
        return None
    return _stairs(lambda v: np.asarray(v, float))(eqn, given)


_sqrt = _rising(np.sqrt, lambda a, b: (0.5 / np.sqrt(b), 0.5 / np.sqrt(a)), 0.0)

ENTRYWISE: dict[str, Rule] = {
    "add": _add,
    "add_any": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": _neg,
    "max": _max,
    "min": _min,
    "clamp": _clamp,
    "abs": _abs,
    "integer_pow": _integer_pow,
    "square": _integer_pow,
    "exp": _rising(np.exp, lambda a, b: (np.exp(a), np.exp(b))),
    "expm1": _rising(np.expm1, lambda a, b: (np.exp(a), np.exp(b))),
    "exp2": _rising(np.exp2, lambda a, b: (np.log(2) * np.exp2(a), np.log(2) * np.exp2(b))),
    "log": _rising(np.log, lambda a, b: (1 / b, 1 / a), 0.0),
    "log1p": _rising(np.log1p, lambda a, b: (1 / (1 + b), 1 / (1 + a)), -1.0),
    "sqrt": _sqrt,
    "rsqrt": _rsqrt,
    "pow": _pow,
    "eq": _equal,
    "ne": _unequal,
    "sinh": _rising(np.sinh, _valley(np.cosh)),
    "cosh": _smooth(_valley(np.cosh), lambda a, b: (np.sinh(a), np.sinh(b))),
    "tanh": _rising(np.tanh, _hill(lambda v: _sech(v) ** 2)),
    "logistic": _rising(
        lambda v: np.exp(-np.logaddexp(0.0, -v)), _hill(lambda v: 0.25 * _sech(0.5 * v) ** 2)
    ),
    "atan": _rising(np.arctan, _hill(lambda v: 1 / (1 + v**2))),
    "asinh": _rising(np.arcsinh, _hill(lambda v: 1 / np.sqrt(1 + v**2))),
    "erf": _rising(erf, _hill(lambda v: 2 / np.sqrt(np.pi) * np.exp(-(v**2)))),
    "sin": _smooth(_wave(0.0), _wave(np.pi / 2)),
    "cos": _smooth(_wave(np.pi / 2), _wave(np.pi)),
    "sign": _stairs(np.sign),
    "floor": _stairs(np.floor),
    "ceil": _stairs(np.ceil),
    "round": _round,
    "lt": _compare(lambda x, y: (x.high < y.low, x.low < y.high)),
    "le": _compare(lambda x, y: (x.high <= y.low, x.low <= y.high)),
    "gt": _compare(lambda x, y: (x.low > y.high, x.high > y.low)),
    "ge": _compare(lambda x, y: (x.low >= y.high, x.high >= y.low)),
    "and": _logic(np.logical_and),
    "or": _logic(np.logical_or),
    "not": _not,
    "select_n": _select,
    "convert_element_type": _convert,
}
