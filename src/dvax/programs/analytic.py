"""Enclosures of an analytic function of time in the complex plane, which bound its interpolation error.

A value is enclosed in two discs: one for all real t of an interval, and one for all t of a disc around
it in the complex plane, to which the function is continued. Comparisons, steps and tables are decided
by the first: what the program computes for all real t of the interval is then one analytic function.
Where that is not so, the radius is infinite.

Source of the bound that this serves: Trefethen, *Approximation Theory and Approximation Practice*
(2013), Theorem 8.2.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._jax.jaxprs import bind
from .interpreter import Domain, Rule, interpret, is_real, same_for
from .primitives import COMPARING, LOGICAL, REARRANGING, STEPWISE, SUMMING

_ROUNDING = 4.0
"""By so many roundings the radius of each result is larger."""


class Analytic(NamedTuple):
    """A value in discs: for the real times (`center`, `radius`), and for complex ones (`z`, `reach`).
    Centers of the first are real."""

    center: Any
    radius: Any
    z: Any
    reach: Any

    @property
    def low(self) -> Any:
        return self.center - self.radius

    @property
    def high(self) -> Any:
        return self.center + self.radius


class Decided(NamedTuple):
    """Integers or Boolean values that are the same for all times, if `known`."""

    value: Any
    known: Any


class _UnknownOperation(Exception):
    pass


def complex_radius(fn: Callable[[Any], Any], low: Any, high: Any, reach: Any) -> jax.Array:
    """Return a bound on |f(t) − c| for a complex number c and all complex t within `reach` of the
    middle of the real interval [low, high], entry by entry of the flat output; infinite where f is not
    proved to be analytic there."""
    time = jnp.asarray(low)
    program, shape = jax.make_jaxpr(fn, return_shape=True)(time)
    middle = 0.5 * (low + high)
    # Centers of the second discs are complex, and their radii are real.
    with jax.numpy_dtype_promotion("standard"):
        t = Analytic(middle, 0.5 * (high - low), middle + 0j, reach)
        try:
            found = interpret(program, [t], _DOMAIN)
        except _UnknownOperation:
            size = sum(int(np.prod(leaf.shape)) for leaf in jtu.tree_leaves(shape))
            return jnp.full(size, jnp.inf, time.dtype)
        radius = jnp.concatenate([_lifted(v, time.dtype).reach.ravel() for v in found])
    return jnp.where(jnp.isnan(radius), jnp.inf, radius)


def _unknown(eqn: Any, operands: list[Any]) -> list[Any]:
    raise _UnknownOperation(eqn.primitive.name)


def _apply(rule: Rule, eqn: Any, operands: list[Any]) -> list[Any] | None:
    results = rule(eqn, operands)
    if results is None:
        return None
    return results if isinstance(results, list) else [results]


def _lifted(value: Any, dtype: Any = None) -> Analytic:
    if isinstance(value, Analytic):
        return value
    if isinstance(value, Decided):
        value, unknown = value.value, jnp.where(value.known, 0.0, jnp.inf)
    else:
        unknown = 0.0
    center = jnp.asarray(value, dtype or jnp.result_type(float))
    radius = jnp.zeros_like(center) + jnp.asarray(unknown, center.dtype)
    return Analytic(center, radius, center + 0j, radius)


def _result(center: Any, radius: Any, z: Any, reach: Any) -> Analytic:
    """Return discs that also contain rounding errors."""
    unit = _ROUNDING * jnp.finfo(jnp.result_type(center)).eps
    return Analytic(center, radius + unit * jnp.abs(center), z, reach + unit * jnp.abs(z))


def _both(rule: Callable[..., tuple[Any, Any]], *values: Analytic) -> Analytic:
    """Apply a rule of discs to both discs of these values."""
    real = rule(*(pair for v in values for pair in (v.center, v.radius)))
    whole = rule(*(pair for v in values for pair in (v.z, v.reach)))
    return _result(jnp.real(real[0]), real[1], *whole)


def _elementwise(rule: Callable[..., tuple[Any, Any]]) -> Rule:
    def of(eqn: Any, operands: list[Any]) -> Any:
        if not is_real(eqn.outvars[0].aval):
            return _whole_numbers(eqn, operands)
        shape = eqn.outvars[0].aval.shape
        values = (_lifted(v) for v in operands)
        return _both(
            rule, *(Analytic(*(jnp.broadcast_to(part, shape) for part in v)) for v in values)
        )

    return of


def _whole_numbers(eqn: Any, operands: list[Any]) -> list[Any]:
    """Return the results of an operation on integers or Boolean values."""
    if any(isinstance(v, Analytic) for v in operands):
        return _unknown(eqn, operands)
    known = jnp.asarray(True)
    for v in operands:
        known = known & (v.known if isinstance(v, Decided) else True)
    plain = [v.value if isinstance(v, Decided) else v for v in operands]
    return [Decided(v, known) for v in bind(eqn, plain)]


def _product(c: Any, r: Any, d: Any, s: Any) -> tuple[Any, Any]:
    # An exact zero remains one: it is the factor of what is switched off.
    return c * d, jnp.where(
        ((c == 0) & (r == 0)) | ((d == 0) & (s == 0)), 0.0, jnp.abs(c) * s + jnp.abs(d) * r + r * s
    )


def _inverse(c: Any, r: Any) -> tuple[Any, Any]:
    gap = jnp.abs(c) ** 2 - r**2
    is_apart = jnp.abs(c) > r
    safe = jnp.where(is_apart, gap, 1.0)
    return jnp.conj(c) / safe, jnp.where(is_apart, r / safe, jnp.inf)


def _quotient(c: Any, r: Any, d: Any, s: Any) -> tuple[Any, Any]:
    return _product(c, r, *_inverse(d, s))


def _exp(c: Any, r: Any) -> tuple[Any, Any]:
    return jnp.exp(c), jnp.exp(jnp.real(c)) * jnp.expm1(r)


def _log(c: Any, r: Any) -> tuple[Any, Any]:
    # A disc on the right of 0 avoids the cut.
    is_right = jnp.real(c) > r
    safe = jnp.where(is_right, c, 1.0)
    share = jnp.where(is_right, r, 0.0) / jnp.abs(safe)
    return jnp.log(safe), jnp.where(is_right, -jnp.log1p(-share), jnp.inf)


def _sin(c: Any, r: Any) -> tuple[Any, Any]:
    return jnp.sin(c), jnp.cosh(jnp.abs(jnp.imag(c)) + r) * r


def _shifted(rule: Callable[[Any, Any], tuple[Any, Any]], shift: float) -> Callable[..., Any]:
    return lambda c, r: rule(c + shift, r)


def _scaled(factor: float, c: Any, r: Any) -> tuple[Any, Any]:
    return factor * c, abs(factor) * r


def _sum(c: Any, r: Any, d: Any, s: Any) -> tuple[Any, Any]:
    return c + d, r + s


def _logistic(c: Any, r: Any) -> tuple[Any, Any]:
    return _inverse(*_sum(*_exp(-c, r), jnp.ones_like(c), 0.0))


def _tanh(c: Any, r: Any) -> tuple[Any, Any]:
    return _sum(*_scaled(2.0, *_logistic(2.0 * c, 2.0 * r)), -jnp.ones_like(c), 0.0)


def _half_sum(sign: float) -> Callable[..., Any]:
    """Return ½(e^z + sign e^{−z})."""
    return lambda c, r: _scaled(
        0.5, *_sum(*_exp(c, r), *_scaled(sign, *_exp(-c, r)))
    )  # fmt: skip


def _power(eqn: Any, operands: list[Any]) -> Any:
    base, exponent = operands
    if isinstance(exponent, Analytic | Decided):
        return _unknown(eqn, operands)
    p = jnp.asarray(exponent)
    return _elementwise(lambda c, r: _exp(*_product(*_log(c, r), p.astype(c.dtype), 0.0 * r)))(
        eqn, [base]
    )


def _root(p: float) -> Rule:
    return _elementwise(lambda c, r: _exp(*_scaled(p, *_log(c, r))))


def _integer_power(eqn: Any, operands: list[Any]) -> Any:
    n = eqn.params["y"]

    def rule(c: Any, r: Any) -> tuple[Any, Any]:
        found = jnp.ones_like(c), 0.0 * r
        for _ in range(abs(n)):
            found = _product(*found, c, r)
        return _inverse(*found) if n < 0 else found

    return _elementwise(rule)(eqn, operands)


def _linear(eqn: Any, operands: list[Any]) -> Any:
    """Apply an operation that moves or adds entries of one argument."""
    if not is_real(eqn.outvars[0].aval):
        return _whole_numbers(eqn, operands)
    if any(isinstance(v, Analytic | Decided) for v in operands[1:]):
        return _unknown(eqn, operands)
    v = _lifted(operands[0])
    one = lambda part: bind(eqn, [part, *operands[1:]])[0]  # noqa: E731
    z = one(jnp.real(v.z)) + 1j * one(jnp.imag(v.z))
    return _result(one(v.center), one(v.radius), z, one(v.reach))


def _joined(eqn: Any, operands: list[Any]) -> Any:
    if not is_real(eqn.outvars[0].aval):
        return _whole_numbers(eqn, operands)
    values = [_lifted(v) for v in operands]
    one = lambda parts: bind(eqn, parts)[0]  # noqa: E731
    z = one([jnp.real(v.z) for v in values]) + 1j * one([jnp.imag(v.z) for v in values])
    return Analytic(
        one([v.center for v in values]), one([v.radius for v in values]), z,
        one([v.reach for v in values]),
    )  # fmt: skip


def _matrix_product(eqn: Any, operands: list[Any]) -> Any:
    if not is_real(eqn.outvars[0].aval):
        return _whole_numbers(eqn, operands)
    a, b = map(_lifted, operands)
    one = lambda p, q: bind(eqn, [p, q])[0]  # noqa: E731
    size = lambda c, r, d, s: one(jnp.abs(c), s) + one(r, jnp.abs(d)) + one(r, s)  # noqa: E731
    parts = [[jnp.real(v.z), jnp.imag(v.z)] for v in (a, b)]
    (p, q), (u, v) = parts
    z = one(p, u) - one(q, v) + 1j * (one(p, v) + one(q, u))
    unit = _ROUNDING * jnp.finfo(a.center.dtype).eps
    rounding = unit * one(jnp.abs(a.center), jnp.abs(b.center))
    reach = size(a.z, a.reach, b.z, b.reach) + unit * one(jnp.abs(a.z), jnp.abs(b.z))
    return Analytic(
        one(a.center, b.center), size(a.center, a.radius, b.center, b.radius) + rounding, z, reach
    )


def _compared(eqn: Any, operands: list[Any]) -> Any:
    if not any(isinstance(v, Analytic) for v in operands):
        return _whole_numbers(eqn, operands)
    a, b = map(_lifted, operands)
    # Comparisons are monotone in both arguments, and ends decide them.
    ends = [
        bind(eqn, [p, q])[0]
        for p, q in ((a.low, b.high), (a.high, b.low), (a.low, b.low), (a.high, b.high))
    ]
    known = jnp.all(jnp.stack([jnp.all(ends[0] == e) for e in ends[1:]]))
    if eqn.primitive.name in ("eq", "ne", "eq_to"):
        apart = (a.high < b.low) | (b.high < a.low)
        equal = (a.radius == 0) & (b.radius == 0)
        known = jnp.all(apart | equal)
    finite = jnp.all(jnp.isfinite(a.radius) & jnp.isfinite(b.radius))
    return Decided(bind(eqn, [a.center, b.center])[0], known & finite)


def _selected(eqn: Any, operands: list[Any]) -> Any:
    which, *cases = operands
    if not is_real(eqn.outvars[0].aval):
        return _whole_numbers(eqn, operands)
    if isinstance(which, Analytic):
        return _unknown(eqn, operands)
    known = which.known if isinstance(which, Decided) else True
    flag = which.value if isinstance(which, Decided) else which
    values = [_lifted(v) for v in cases]
    one = lambda parts: bind(eqn, [flag, *parts])[0]  # noqa: E731
    z = one([jnp.real(v.z) for v in values]) + 1j * one([jnp.imag(v.z) for v in values])
    spread = lambda r: jnp.where(known, r, jnp.inf)  # noqa: E731
    return Analytic(
        one([v.center for v in values]), spread(one([v.radius for v in values])), z,
        spread(one([v.reach for v in values])),
    )  # fmt: skip


def _chosen(first: Any, second: Any, takes_first: Any, takes_second: Any) -> Analytic:
    """Return the first value, or the second one, where that is decided, else an unknown one."""
    pick = lambda p, q: jnp.where(takes_first, p, q)  # noqa: E731
    found = [pick(*pair) for pair in zip(first, second, strict=True)]
    known = takes_first | takes_second
    return Analytic(
        found[0], jnp.where(known, found[1], jnp.inf), found[2], jnp.where(known, found[3], jnp.inf)
    )


def _extremum(sign: float) -> Rule:
    def of(eqn: Any, operands: list[Any]) -> Any:
        if not is_real(eqn.outvars[0].aval):
            return _whole_numbers(eqn, operands)
        shape = eqn.outvars[0].aval.shape
        a, b = (Analytic(*(jnp.broadcast_to(part, shape) for part in _lifted(v))) for v in operands)
        is_above, is_below = a.low >= b.high, a.high <= b.low
        return _chosen(a, b, is_above, is_below) if sign > 0 else _chosen(a, b, is_below, is_above)

    return of


def _clamped(eqn: Any, operands: list[Any]) -> Any:
    if not is_real(eqn.outvars[0].aval):
        return _whole_numbers(eqn, operands)
    shape = eqn.outvars[0].aval.shape
    low, v, high = (
        Analytic(*(jnp.broadcast_to(part, shape) for part in _lifted(o))) for o in operands
    )
    above = _chosen(v, low, v.low >= low.high, v.high <= low.low)
    return _chosen(above, high, above.high <= high.low, above.low >= high.high)


def _modulus(eqn: Any, operands: list[Any]) -> Any:
    if not is_real(eqn.outvars[0].aval):
        return _whole_numbers(eqn, operands)
    v = _lifted(operands[0])
    minus = Analytic(-v.center, v.radius, -v.z, v.reach)
    return _chosen(v, minus, v.low >= 0, v.high <= 0)


def _step(eqn: Any, operands: list[Any]) -> Any:
    if not isinstance(operands[0], Analytic):
        return _whole_numbers(eqn, operands)
    v = operands[0]
    low, high = bind(eqn, [v.low])[0], bind(eqn, [v.high])[0]
    unknown = jnp.where(low == high, 0.0, jnp.inf)
    return Analytic(low, unknown, low + 0j, unknown)


def _remainder(eqn: Any, operands: list[Any]) -> Any:
    """Return a − n b, where the integer n is decided."""
    if not is_real(eqn.outvars[0].aval):
        return _whole_numbers(eqn, operands)
    a, b = map(_lifted, operands)
    ratio = _both(_quotient, a, b)
    low, high = jnp.trunc(ratio.low), jnp.trunc(ratio.high)
    unknown = jnp.where(low == high, 0.0, jnp.inf)
    n = Analytic(-low, unknown, -low + 0j, unknown)
    return _both(_sum, a, _both(_product, n, b))


def _converted(eqn: Any, operands: list[Any]) -> Any:
    v, out = operands[0], eqn.outvars[0].aval
    if is_real(out):
        # With fewer digits the result is a step function.
        is_shorter = (
            isinstance(v, Analytic) and jnp.finfo(v.center.dtype).bits > jnp.finfo(out.dtype).bits
        )
        return _unknown(eqn, operands) if is_shorter else _lifted(v)
    if isinstance(v, Analytic):
        if out.dtype == jnp.bool_:
            return _unknown(eqn, operands)
        low, high = bind(eqn, [v.low])[0], bind(eqn, [v.high])[0]
        return Decided(low, jnp.all((low == high) & jnp.isfinite(v.radius)))
    return _whole_numbers(eqn, operands)


def _indexed(eqn: Any, operands: list[Any]) -> Any:
    """Return entries of an array at decided indices."""
    array, *indices = operands
    if any(isinstance(v, Analytic) for v in indices):
        return _unknown(eqn, operands)
    if not is_real(eqn.outvars[0].aval):
        return _whole_numbers(eqn, operands)
    known = jnp.asarray(True)
    for v in indices:
        known = known & (v.known if isinstance(v, Decided) else True)
    places = [v.value if isinstance(v, Decided) else v for v in indices]
    v = _lifted(array)
    one = lambda part: bind(eqn, [part, *places])[0]  # noqa: E731
    spread = lambda r: jnp.where(known, r, jnp.inf)  # noqa: E731
    z = one(jnp.real(v.z)) + 1j * one(jnp.imag(v.z))
    return Analytic(one(v.center), spread(one(v.radius)), z, spread(one(v.reach)))


def _place_in(eqn: Any, operands: list[Any]) -> Any:
    """Return the place of a value in a table."""
    table, v = operands
    if not isinstance(v, Analytic) or isinstance(table, Analytic | Decided):
        return _unknown(eqn, operands)
    low, high = bind(eqn, [table, v.low])[0], bind(eqn, [table, v.high])[0]
    return Decided(low, jnp.all((low == high) & jnp.isfinite(v.radius)))


def _table(degree: int) -> Rule:
    """Return the rule of a signal of this degree between the times of its table."""

    def of(eqn: Any, operands: list[Any]) -> Any:
        times, values, *slopes, t = operands
        if not isinstance(t, Analytic) or any(
            isinstance(v, Analytic | Decided) for v in (times, values, *slopes)
        ):
            return _unknown(eqn, operands)
        times, values, *slopes = map(jnp.asarray, (times, values, *slopes))
        last = len(times) - 2
        place = lambda s: jnp.searchsorted(times, s, side="right") - 1  # noqa: E731
        first, other = place(t.low), place(t.high)
        inside = (times[0] <= t.low) & (t.high <= times[-1]) & (first == other)
        i = jnp.clip(first, 0, last)
        width = times[i + 1] - times[i]
        fixed = lambda v: _lifted(v, values.dtype)  # noqa: E731
        share = _both(_quotient, _both(_sum, t, fixed(-times[i])), fixed(width))
        v0, v1 = values[i], values[i + 1]
        share = Analytic(*(jnp.broadcast_to(part, v0.shape) for part in share))
        if degree == 0:
            found = fixed(v0)
        elif degree == 1:
            found = _both(_sum, fixed(v0), _both(_product, share, fixed(v1 - v0)))
        else:
            d0, d1 = width * slopes[0][i], width * slopes[0][i + 1]
            third, second = d0 + d1 - 2.0 * (v1 - v0), 3.0 * (v1 - v0) - 2.0 * d0 - d1
            found = fixed(third)
            for c in (second, d0, v0):
                found = _both(_sum, _both(_product, found, share), fixed(c))
        spread = lambda r: jnp.where(inside, r, jnp.inf)  # noqa: E731
        return Analytic(found.center, spread(found.radius), found.z, spread(found.reach))

    return of


RULES: dict[str, Rule] = {
    **same_for({"add", "add_any"}, _elementwise(_sum)),
    "sub": _elementwise(lambda c, r, d, s: (c - d, r + s)),
    "neg": _elementwise(lambda c, r: (-c, r)),
    "mul": _elementwise(_product),
    "div": _elementwise(_quotient),
    "square": _elementwise(lambda c, r: _product(c, r, c, r)),
    "integer_pow": _integer_power,
    "pow": _power,
    "exp": _elementwise(_exp),
    "exp2": _elementwise(lambda c, r: _exp(*_scaled(float(np.log(2.0)), c, r))),
    "expm1": _elementwise(lambda c, r: _sum(*_exp(c, r), -jnp.ones_like(c), 0.0)),
    "log": _elementwise(_log),
    "log1p": _elementwise(lambda c, r: _log(c + 1.0, r)),
    "sqrt": _root(0.5),
    "rsqrt": _root(-0.5),
    "sin": _elementwise(_sin),
    "cos": _elementwise(_shifted(_sin, 0.5 * np.pi)),
    "tan": _elementwise(lambda c, r: _quotient(*_sin(c, r), *_sin(c + 0.5 * np.pi, r))),
    "sinh": _elementwise(_half_sum(-1.0)),
    "cosh": _elementwise(_half_sum(1.0)),
    "tanh": _elementwise(_tanh),
    "logistic": _elementwise(_logistic),
    "max": _extremum(1.0),
    "min": _extremum(-1.0),
    "clamp": _clamped,
    "abs": _modulus,
    "rem": _remainder,
    "select_n": _selected,
    "convert_element_type": _converted,
    "dot_general": _matrix_product,
    **same_for({"concatenate", "stack"}, _joined),
    **same_for(REARRANGING | SUMMING, _linear),
    **same_for({"gather", "dynamic_slice"}, _indexed),
    **same_for(COMPARING, _compared),
    **same_for(LOGICAL, _whole_numbers),
    **same_for(STEPWISE, _step),
    "searchsorted": _place_in,
    "dvax_constant_table": _table(0),
    "dvax_linear_table": _table(1),
    "dvax_cubic_table": _table(3),
}

_DOMAIN = Domain(RULES, lambda v: isinstance(v, Analytic | Decided), _unknown, _apply)
