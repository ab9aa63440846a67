"""A bound on the rounding error of evaluating F, by running error analysis.

Every intermediate value v of the traced program of F is carried with a bound e ≥ |fl(v) − v|, where v
is what exact arithmetic makes of the same inputs and constants (Higham 2002, Accuracy and Stability
of Numerical Algorithms, Section 3.3). With the unit roundoff below ε:

    sum        e = e_a + e_b + ε|v|
    product    e = |a|e_b + |b|e_a + e_a e_b + ε|v|
    quotient   e = (e_a + |v|e_b)/(|b| − e_b) + ε|v|
    Σ, k terms e = Σ e_i + kε Σ|a_i|, in any order of summation; matrix products likewise
    φ(a)       e = sup|φ′|e_a + 8ε|v| over [a − e_a, a + e_a], φ being right to a few ulps
    a < b      in doubt where |a − b| ≤ e_a + e_b: what it chooses is then off by how far the cases are
               apart; steps (sign, floor) likewise

For F(y) = My − q it is (n + 3)ε(|M||y| + |q|), as it should be. An operation without a rule gets an
estimate from the relative errors of its arguments, and then the result is not proved.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend.core import ClosedJaxpr

from .._jaxpr import bound, walked
from .._smooth_bounds import BOUNDS
from .._tree import Tree
from .structure import CALLS, CUSTOM, inner_jaxpr


class _Value(NamedTuple):
    """A computed array and a bound on its error, entry by entry; whether it is `exact`, its error 0."""

    value: jax.Array
    error: jax.Array
    exact: bool = False


_STRUCTURAL = {
    "neg", "copy", "copy_p", "reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose",
    "rev", "concatenate", "stack", "split", "stop_gradient", "optimization_barrier", "real", "imag",
    "reduce_max", "reduce_min", "max", "min", "pad",
}  # fmt: skip
_INDEXED = {"slice", "dynamic_slice", "gather"}
_SMOOTH = {
    "exp", "exp2", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "sinh",
    "cosh", "tanh", "asinh", "acosh", "atanh", "logistic", "erf", "erfc", "sqrt", "rsqrt", "cbrt",
    "square", "integer_pow",
}  # fmt: skip


def rounding_error(F: Callable[[Tree], Tree], y: Tree) -> tuple[Tree, bool]:
    """A bound on |fl(F(y)) − F(y)|, entry by entry, and whether every operation of F has a rule."""
    traced, shape = jax.make_jaxpr(F, return_shape=True)(y)
    unknown: set[str] = set()
    found = _carry(traced, [_exact(leaf) for leaf in jtu.tree_leaves(y)], unknown)
    return jtu.tree_structure(shape).unflatten([_lift(v).error for v in found]), not unknown


def _carry(traced: ClosedJaxpr, given: list[Any], unknown: set[str]) -> list[Any]:
    return walked(traced, given, lambda eqn, values: _apply(eqn, values, unknown))


def _exact(value: Any) -> _Value:
    value = jnp.asarray(value)
    return _Value(value, jnp.zeros(value.shape, value.dtype), True)


def _lift(value: Any) -> _Value:
    return value if isinstance(value, _Value) else _exact(value)


def _value(value: Any) -> Any:
    return value.value if isinstance(value, _Value) else value


def _eps(array: Any) -> float:
    return float(jnp.finfo(array.dtype).eps)


def _apply(eqn: Any, given: list[Any], unknown: set[str]) -> list[Any]:
    name = eqn.primitive.name
    inner = inner_jaxpr(eqn.params) if name in CALLS or name in CUSTOM else None
    if inner is not None and len(inner.jaxpr.invars) == len(given):
        return _carry(inner, given, unknown)
    out = bound(eqn, [_value(v) for v in given])
    if not any(jnp.issubdtype(v.dtype, jnp.floating) for v in out):
        # Integers are taken as computed, and so are truth values of which rounding leaves no doubt.
        return [_doubted(name, eqn, given, v) if v.dtype == bool else v for v in out]
    error = _rule(name, eqn, given, out)
    if error is None:
        if any(isinstance(v, _Value) for v in given) or name not in ("iota",):
            unknown.add(name)
        error = [_estimate(v, given) for v in out]
    return [_Value(v, e) for v, e in zip(out, error, strict=True)]


def _rule(name: str, eqn: Any, given: list[Any], out: list[Any]) -> list[jax.Array] | None:
    """The errors of the outputs; None where the operation has no rule."""
    if any(jnp.issubdtype(_value(v).dtype, jnp.complexfloating) for v in map(_lift, given)):
        return None
    if name in _INDEXED:
        return bound(eqn, [_lift(given[0]).error, *map(_value, given[1:])])
    if name == "select_n":
        chosen = bound(eqn, [_value(given[0]), *(_lift(v).error for v in given[1:])])[0]
        if not isinstance(given[0], _Value):
            return [chosen]
        # Where the condition is in doubt the value may be that of any case.
        cases = [_lift(v) for v in given[1:]]
        apart = [jnp.abs(case.value - out[0]) + case.error for case in cases]
        return [jnp.where(given[0].error > 0, functools.reduce(jnp.maximum, apart), chosen)]
    x = [_lift(v) for v in given]
    v = out[0]
    eps = _eps(v)
    if name in _STRUCTURAL:
        if name in ("max", "min"):
            return [jnp.broadcast_to(jnp.maximum(x[0].error, x[1].error), v.shape)]
        if name in ("reduce_max", "reduce_min"):
            return [jnp.max(x[0].error, axis=eqn.params["axes"])]
        return [jnp.abs(e) for e in bound(eqn, [one.error for one in x])]
    if name == "abs":
        return [x[0].error]
    if name in ("sign", "floor", "ceil", "round"):
        # A value that its error may carry over a step is off by the height of the steps between.
        return [jnp.where(x[0].error > 0, _rise(eqn, x[0], v), 0.0)]
    if name == "clamp":
        return [jnp.maximum(x[1].error, jnp.maximum(x[0].error, x[2].error))]
    if name == "convert_element_type":
        error = x[0].error.astype(v.dtype)
        floating = jnp.issubdtype(x[0].value.dtype, jnp.floating)
        longer = floating and _eps(x[0].value) >= eps
        return [error if longer else error + eps * jnp.abs(v)]
    if name in ("add", "sub", "add_any"):
        return [x[0].error + x[1].error + eps * jnp.abs(v)]
    if name == "mul":
        (a, p, _), (b, q, _) = x
        return [_times(jnp.abs(a), q) + _times(jnp.abs(b) + q, p) + eps * jnp.abs(v)]
    if name == "div":
        (_, p, _), (b, q, _) = x
        room = jnp.abs(b) - q
        error = (p + jnp.abs(v) * q) / jnp.where(room > 0, room, 1.0)
        return [jnp.where(room > 0, error, jnp.inf) + eps * jnp.abs(v)]
    if name in ("reduce_sum", "cumsum"):
        axes = eqn.params["axes"] if name == "reduce_sum" else (eqn.params["axis"],)
        count = 1
        for axis in axes:
            count *= x[0].value.shape[axis]
        size = bound(eqn, [jnp.abs(x[0].value)])[0]
        return [2 * bound(eqn, [x[0].error])[0] + (count + 1) * eps * size]
    if name == "dot_general":
        (a, p, exact), (b, q, _) = x
        (axes, _), _ = eqn.params["dimension_numbers"]
        count = 1
        for axis in axes:
            count *= a.shape[axis]
        a, b = jnp.abs(a), jnp.abs(b)
        times = lambda r, s: bound(eqn, [r, s])[0]  # noqa: E731
        error = times(a, q + (count + 2) * eps * b)
        # A product with an array of zeros is no matter of time alone: XLA's CPU backend gets one wrong,
        # now and then, that it fuses with a sum (jaxlib 0.10.2).
        return [error if exact else error + times(p, b + q)]
    if name in _SMOOTH:
        # Of the largest slope within the error: where the argument is exact, a slope that may be
        # infinite does not matter.
        low, high = x[0].value - x[0].error, x[0].value + x[0].error
        power = {"integer_pow": eqn.params.get("y", 0), "square": 2}.get(name)
        slope = BOUNDS[name](low, high)[0] if power is None else _power_slope(low, high, power)
        through = jnp.where(x[0].error > 0, 1.01 * slope * x[0].error, 0.0)
        power = abs(power) if power is not None and name == "integer_pow" else 0
        return [through + (8 + 2 * power) * eps * jnp.abs(v)]
    if name == "iota":
        return [jnp.zeros_like(v)]
    return None


def _times(factor: jax.Array, error: jax.Array) -> jax.Array:
    """factor · error with 0 · ∞ = 0: a factor that is zero leaves nothing of an error."""
    return jnp.where((error > 0) & (factor > 0), factor * error, 0.0)


def _power_slope(low: jax.Array, high: jax.Array, n: int) -> jax.Array:
    """sup |n x^(n−1)| over [low, high]."""
    size = jnp.maximum(jnp.abs(low), jnp.abs(high))
    nearest = jnp.where(low > 0, low, jnp.where(high < 0, -high, 0.0))
    return abs(n) * (size ** (n - 1) if n >= 1 else nearest ** (n - 1))


def _rise(eqn: Any, x: _Value, v: jax.Array) -> jax.Array:
    """How far a step function of x may be from its computed value v."""
    ends = [bound(eqn, [end])[0] for end in (x.value - x.error, x.value + x.error)]
    return functools.reduce(jnp.maximum, [jnp.abs(end - v) for end in ends])


_COMPARED = {"lt", "le", "gt", "ge", "eq", "ne", "lt_to", "le_to", "eq_to"}


def _doubted(name: str, eqn: Any, given: list[Any], v: jax.Array) -> Any:
    """A truth value with error 1 where rounding may have decided it, else as it is."""
    if not any(isinstance(one, _Value) for one in given):
        return v
    x = [_lift(one) for one in given]
    if name in _COMPARED and all(jnp.issubdtype(one.value.dtype, jnp.floating) for one in x):
        room = x[0].error + x[1].error
        doubt = (room > 0) & (jnp.abs(x[0].value - x[1].value) <= room)
    else:
        doubt = functools.reduce(jnp.logical_or, [jnp.any(one.error > 0) for one in x])
        if all(one.value.shape in ((), v.shape) for one in x):
            doubt = functools.reduce(jnp.logical_or, [one.error > 0 for one in x])
    return _Value(v, jnp.broadcast_to(doubt, v.shape).astype(jnp.float32))


def _estimate(out: jax.Array, given: list[Any]) -> jax.Array:
    """Errors relative to the largest entries, through an operation that is not badly conditioned."""
    if not jnp.issubdtype(out.dtype, jnp.inexact):
        return jnp.zeros_like(out)
    eps, relative, size = _eps(out), jnp.asarray(0.0, jnp.finfo(out.dtype).dtype), 1
    for value in map(_lift, given):
        if value.value.size == 0 or not jnp.issubdtype(value.value.dtype, jnp.inexact):
            continue
        most = jnp.max(jnp.abs(value.value)).astype(relative.dtype)
        worst = jnp.max(jnp.abs(value.error)).astype(relative.dtype)
        relative = relative + worst / jnp.where(most > 0, most, 1.0)
        size = max(size, value.value.size)
    most = jnp.max(jnp.abs(out)) if out.size else jnp.zeros((), relative.dtype)
    return jnp.full(out.shape, (8 * relative + size * eps) * most, jnp.finfo(out.dtype).dtype)
