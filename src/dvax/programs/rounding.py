"""A bound on the rounding error of evaluating F, by running error analysis.

The interpreter propagates a bound e ≥ |fl(v) − v| for every intermediate value v of the traced program,
where v is the value in exact arithmetic for the same inputs and constants (Higham 2002, Accuracy and
Stability of Numerical Algorithms, Section 3.3). With a unit roundoff below ε:

    sum        e = e_a + e_b + ε|v|
    product    e = |a|e_b + |b|e_a + e_a e_b + ε|v|
    quotient   e = (e_a + |v|e_b)/(|b| − e_b) + ε|v|
    Σ, k terms e = Σ e_i + kε Σ|a_i|, in any order of summation; matrix products likewise
    φ(a)       e = sup|φ′|e_a + 8ε|v| over [a − e_a, a + e_a], for φ accurate to a few ulps
    a < b      uncertain if |a − b| ≤ e_a + e_b: a selection then has the difference of the cases as its
               error; likewise for steps (sign, floor)

For F(y) = My − q the bound is (n + 3)ε(|M||y| + |q|). An operation without a rule gets an estimate from
the relative errors of its arguments, and the result is then not proved.
"""

import functools
import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._jax.jaxprs import bind
from .._tree import Tree
from .interpreter import Domain, Rule, interpret, is_real, same_for
from .primitives import COMPARING, JOINING, REARRANGING, STEPWISE, SUMMING
from .smooth import SMOOTH_NAMES, smooth


class _Value(NamedTuple):
    """A computed array and an entrywise bound on its error, which is 0 if it is `exact`."""

    value: jax.Array
    error: jax.Array
    exact: bool = False


def rounding_error(F: Callable[[Tree], Tree], y: Tree) -> tuple[Tree, bool]:
    """Return an entrywise bound on |fl(F(y)) − F(y)|, and whether it is proved: every operation of F
    has a rule."""
    program, shape = jax.make_jaxpr(F, return_shape=True)(y)
    unknown: set[str] = set()
    apply = partial(_with_errors, unknown)
    # Operations on constants round too, so all values are abstract.
    domain = Domain(RULES, lambda value: True, partial(apply, None), apply)
    results = interpret(program, [_exact(leaf) for leaf in jtu.tree_leaves(y)], domain)
    return jtu.tree_structure(shape).unflatten([_lift(v).error for v in results]), not unknown


def _exact(value: Any) -> _Value:
    value = jnp.asarray(value)
    return _Value(value, jnp.zeros(value.shape, value.dtype), True)


def _lift(value: Any) -> _Value:
    return value if isinstance(value, _Value) else _exact(value)


def _value(value: Any) -> Any:
    return value.value if isinstance(value, _Value) else value


def _eps(array: Any) -> float:
    return float(jnp.finfo(array.dtype).eps)


def _with_errors(unknown: set[str], rule: Rule | None, eqn: Any, operands: list[Any]) -> list[Any]:
    """Return the results of an operation with their errors. Without a rule, estimate the errors and add
    the name of the operation to `unknown`."""
    out = bind(eqn, [_value(v) for v in operands])
    if not any(map(is_real, out)):
        # Integers count as exact; Boolean values may be uncertain.
        return [_with_doubt(eqn, operands, v) if v.dtype == bool else v for v in out]
    x = list(map(_lift, operands))
    if rule is None or any(jnp.issubdtype(v.value.dtype, jnp.complexfloating) for v in x):
        unknown.add(eqn.primitive.name)
        return [_Value(v, _estimate(v, x)) for v in out]
    errors = rule(eqn, x, out[0])
    errors = errors if isinstance(errors, list) else [errors]
    return [_Value(v, e) for v, e in zip(out, errors, strict=True)]


# Each rule returns the error of the result v of an operation on x.


def _rearranged(eqn: Any, x: list[_Value], v: jax.Array) -> list[jax.Array]:
    """Return the error for an operation that only rearranges entries."""
    return [jnp.abs(e) for e in bind(eqn, [one.error for one in x])]


def _indexed(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    """Return the error of entries of x at the indices in the other arguments."""
    return bind(eqn, [x[0].error, *(one.value for one in x[1:])])[0]


def _written(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    """Return the error of an array into which values are written at some indices."""
    real = [is_real(one.value) for one in x]
    return bind(eqn, [o.error if r else o.value for o, r in zip(x, real, strict=True)])[0]


def _added(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    """Return the error of an array to which values are added at some indices."""
    (a, p, _), (indices, *_), (b, q, _) = x
    add = lambda r, s: bind(eqn, [r, indices, s])[0]  # noqa: E731
    count = add(jnp.ones_like(a), jnp.ones_like(b))
    return 2 * add(p, q) + count * _eps(v) * add(jnp.abs(a), jnp.abs(b))


def _select(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    which, *cases = x
    chosen = bind(eqn, [which.value, *(case.error for case in cases)])[0]
    if which.exact:
        return chosen
    # Where the condition is uncertain, the exact value may be that of any case.
    distances = [jnp.abs(case.value - v) + case.error for case in cases]
    return jnp.where(which.error > 0, functools.reduce(jnp.maximum, distances), chosen)


def _extremum(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    return jnp.broadcast_to(jnp.maximum(x[0].error, x[1].error), v.shape)


def _largest_error(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    return jnp.max(x[0].error, axis=eqn.params["axes"])


def _step(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    # If the error of x may cross a step, the error of the result is the height of the steps.
    return jnp.where(x[0].error > 0, _rise(eqn, x[0], v), 0.0)


def _clamp(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    return jnp.maximum(x[1].error, jnp.maximum(x[0].error, x[2].error))


def _convert(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    error = x[0].error.astype(v.dtype)
    is_exact = is_real(x[0].value) and _eps(x[0].value) >= _eps(v)
    return error if is_exact else error + _eps(v) * jnp.abs(v)


def _sum(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    return x[0].error + x[1].error + _eps(v) * jnp.abs(v)


def _product(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    (a, p, _), (b, q, _) = x
    return _times(jnp.abs(a), q) + _times(jnp.abs(b) + q, p) + _eps(v) * jnp.abs(v)


def _quotient(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    (_, p, _), (b, q, _) = x
    least = jnp.abs(b) - q
    error = (p + jnp.abs(v) * q) / jnp.where(least > 0, least, 1.0)
    return jnp.where(least > 0, error, jnp.inf) + _eps(v) * jnp.abs(v)


def _long_sum(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    axes = eqn.params["axes"] if "axes" in eqn.params else (eqn.params["axis"],)
    count = math.prod(x[0].value.shape[axis] for axis in axes)
    size = bind(eqn, [jnp.abs(x[0].value)])[0]
    return 2 * bind(eqn, [x[0].error])[0] + (count + 1) * _eps(v) * size


def _matrix_product(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    (a, p, exact), (b, q, _) = x
    (axes, _), _ = eqn.params["dimension_numbers"]
    count = math.prod(a.shape[axis] for axis in axes)
    a, b = jnp.abs(a), jnp.abs(b)
    times = lambda r, s: bind(eqn, [r, s])[0]  # noqa: E731
    error = times(a, q + (count + 2) * _eps(v) * b)
    # Skip the product with zeros if a is exact. This also avoids a bug of XLA's CPU backend, which
    # sometimes computes such a product wrongly when it fuses it with a sum (jaxlib 0.10.2).
    return error if exact else error + times(p, b + q)


def _smooth(eqn: Any, x: list[_Value], v: jax.Array) -> jax.Array:
    # Use the largest slope in the interval of the argument. If the argument is exact, the slope does
    # not enter, even if it is infinite.
    phi = smooth(eqn)
    assert phi is not None
    slope = phi.bounds(x[0].value - x[0].error, x[0].value + x[0].error)[0]
    propagated = jnp.where(x[0].error > 0, 1.01 * slope * x[0].error, 0.0)
    power = abs(eqn.params["y"]) if eqn.primitive.name == "integer_pow" else 0
    return propagated + (8 + 2 * power) * _eps(v) * jnp.abs(v)


RULES: dict[str, Rule] = {
    **same_for(REARRANGING | JOINING, _rearranged),
    **same_for({"neg", "real", "imag", "optimization_barrier", "pad"}, _rearranged),
    **same_for({"dynamic_slice", "gather"}, _indexed),
    **same_for({"dynamic_update_slice", "scatter"}, _written),
    **same_for({"scatter-add", "scatter_add"}, _added),
    **same_for({"max", "min"}, _extremum),
    **same_for({"reduce_max", "reduce_min"}, _largest_error),
    **same_for({"add", "sub", "add_any"}, _sum),
    **same_for(STEPWISE, _step),
    **same_for(SUMMING, _long_sum),
    **same_for(SMOOTH_NAMES, _smooth),
    "select_n": _select,
    "abs": lambda eqn, x, v: x[0].error,
    "clamp": _clamp,
    "convert_element_type": _convert,
    "mul": _product,
    "div": _quotient,
    "dot_general": _matrix_product,
}
"""Functions of an equation, its arguments and its result that return the error of the result."""


def _times(factor: jax.Array, error: jax.Array) -> jax.Array:
    """Return factor · error with 0 · ∞ = 0."""
    return jnp.where((error > 0) & (factor > 0), factor * error, 0.0)


def _rise(eqn: Any, x: _Value, v: jax.Array) -> jax.Array:
    """Return a bound on the error of v, the computed value of a step function at x."""
    ends = [bind(eqn, [end])[0] for end in (x.value - x.error, x.value + x.error)]
    return functools.reduce(jnp.maximum, [jnp.abs(end - v) for end in ends])


def _with_doubt(eqn: Any, operands: list[Any], v: jax.Array) -> Any:
    """Return a Boolean value with error 1 where rounding may have changed it, 0 elsewhere."""
    if not any(isinstance(one, _Value) for one in operands):
        return v
    x = [_lift(one) for one in operands]
    if eqn.primitive.name in COMPARING and all(is_real(one.value) for one in x):
        error = x[0].error + x[1].error
        doubt = (error > 0) & (jnp.abs(x[0].value - x[1].value) <= error)
    else:
        doubt = functools.reduce(jnp.logical_or, [jnp.any(one.error > 0) for one in x])
        if all(one.value.shape in ((), v.shape) for one in x):
            doubt = functools.reduce(jnp.logical_or, [one.error > 0 for one in x])
    return _Value(v, jnp.broadcast_to(doubt, v.shape).astype(jnp.float32))


def _estimate(out: jax.Array, x: list[_Value]) -> jax.Array:
    """Return an estimate of the errors, relative to the largest entries, for a well-conditioned
    operation."""
    if not jnp.issubdtype(out.dtype, jnp.inexact):
        return jnp.zeros_like(out)
    eps, relative, size = _eps(out), jnp.asarray(0.0, jnp.finfo(out.dtype).dtype), 1
    for value in x:
        if value.value.size == 0 or not jnp.issubdtype(value.value.dtype, jnp.inexact):
            continue
        largest = jnp.max(jnp.abs(value.value)).astype(relative.dtype)
        worst = jnp.max(jnp.abs(value.error)).astype(relative.dtype)
        relative = relative + worst / jnp.where(largest > 0, largest, 1.0)
        size = max(size, value.value.size)
    largest = jnp.max(jnp.abs(out)) if out.size else jnp.zeros((), relative.dtype)
    return jnp.full(out.shape, (8 * relative + size * eps) * largest, jnp.finfo(out.dtype).dtype)
