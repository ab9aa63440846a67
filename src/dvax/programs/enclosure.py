"""Linear enclosures: rigorous bounds on the deviation of a function of time from a line.

Every quantity over a step is represented by (a, b, dev): its value at the start, its value at the end,
and a bound |q(θ) − ((1−θ)a + θb)| ≤ dev for all θ in [0, 1]. Each operation has a rule for these:

    sum          the deviations add
    product      |q r − line| ≤ |q| dev_r + |r| dev_q + dev_q dev_r + |Δq Δr|/4
    max, min     the larger deviation, plus |d₀d₁|/(|d₀| + |d₁|) at a crossing, d the difference
    smooth φ     sup|φ′| dev + min(sup|φ″| Δ²/8, sup|φ′| |Δ|/2) over the range of the argument

The deviation is O(h²) for smooth functions and O(h) with a kink in the step, and it is always an upper
bound. An operation without a rule raises `NoEnclosure`; the defect is then sampled, and called
estimated.
"""

import contextlib
import contextvars
import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._jax.jaxprs import bind
from .._lookup import count_up_to
from .._tree import Tree
from .interpreter import Domain, Rule, interpret, is_real, same_for, unroll
from .primitives import COMPARING, JOINING, LOGICAL, REARRANGING, STEPWISE, SUMMING, TABLES
from .smooth import (
    SMOOTH,
    SMOOTH_NAMES,
    Bounds,
    exponential_bounds,
    integer_power,
    power_bounds,
    smooth,
)

_below_parabola = contextvars.ContextVar("below_parabola", default=False)


@contextlib.contextmanager
def below_parabola() -> Iterator[None]:
    """Make enclosures in this block satisfy the stronger bound |q(θ) − line(θ)| ≤ 4θ(1−θ) dev.

    The rules for sums, products and smooth functions satisfy it already. A kink between slopes that
    differ by 2L stays below the parabola of height Lh/2, wherever it is in the step. A jump has no such
    bound: dev = ∞.
    """
    token = _below_parabola.set(True)
    try:
        yield
    finally:
        _below_parabola.reset(token)


class NoEnclosure(Exception):
    """An operation has no rule for linear enclosures; the argument is its name."""


class LinearEnclosure(NamedTuple):
    """The enclosure (a, b, dev) of an array. For integers and Booleans dev is 0 if they are constant,
    else infinity."""

    a: jax.Array
    b: jax.Array
    dev: jax.Array

    @property
    def largest(self) -> jax.Array:
        """A bound on |q| over the step."""
        return jnp.maximum(jnp.abs(self.a), jnp.abs(self.b)) + self.dev

    @property
    def lowest(self) -> jax.Array:
        return jnp.minimum(self.a, self.b) - self.dev

    @property
    def highest(self) -> jax.Array:
        return jnp.maximum(self.a, self.b) + self.dev


def _map(fn: Callable[..., Any], *operands: LinearEnclosure) -> LinearEnclosure:
    """Return fn of the starts, of the ends and of the deviations."""
    return LinearEnclosure(*(fn(*parts) for parts in zip(*operands, strict=True)))


def straight(a: Tree, b: Tree) -> Tree:
    """Return a tree of enclosures of functions that are linear in time (dev = 0)."""
    return jtu.tree_map(lambda p, q: LinearEnclosure(p, q, _no_deviation(p)), a, b)


def constant(a: Tree) -> Tree:
    """Return a tree of enclosures of constants."""
    return straight(a, a)


def enclose(fn: Callable[..., Tree], *args: Tree) -> Tree:
    """Return the enclosures of fn(*args), given trees of linear enclosures.

    **Raises:** `NoEnclosure` if fn uses an operation without a rule.
    """
    leaves, structure = jtu.tree_flatten(args, is_leaf=is_enclosure)
    starts = structure.unflatten([leaf.a for leaf in leaves])
    program, shape = jax.make_jaxpr(fn, return_shape=True)(*starts)
    results = interpret(program, leaves, _DOMAIN)
    return jtu.tree_structure(shape).unflatten(list(map(_lift, results)))


def has_enclosure(fn: Callable[..., Tree], *args: Tree) -> bool:
    """Return whether every operation of fn(*args), which calls `enclose`, has a rule."""
    try:
        jax.eval_shape(fn, *args)
    except NoEnclosure:
        return False
    return True


def _no_deviation(value: Any) -> jax.Array:
    return jnp.zeros(jnp.shape(value), _real(value))


def _real(value: Any) -> Any:
    """Return the type of a deviation: that of the value, or float32 for integers and Booleans."""
    dtype = jnp.result_type(value)
    return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.float32


def is_enclosure(value: Any) -> bool:
    return isinstance(value, LinearEnclosure)


def largest(x: LinearEnclosure, y: LinearEnclosure) -> LinearEnclosure:
    """Return the enclosure of max(x, y), which is that of x if x ≥ y over the whole step."""
    dev = _either(x, y, x.a - y.a, x.b - y.b)
    return LinearEnclosure(jnp.maximum(x.a, y.a), jnp.maximum(x.b, y.b), dev)


def smallest(x: LinearEnclosure, y: LinearEnclosure) -> LinearEnclosure:
    """Return the enclosure of min(x, y)."""
    dev = _either(x, y, y.a - x.a, y.b - x.b)
    return LinearEnclosure(jnp.minimum(x.a, y.a), jnp.minimum(x.b, y.b), dev)


def _either(x: LinearEnclosure, y: LinearEnclosure, d0: jax.Array, d1: jax.Array) -> jax.Array:
    """Return the deviation of max(x, y), where x − y is d0 at the start and d1 at the end."""
    margin = x.dev + y.dev
    mixed = jnp.maximum(x.dev, y.dev) + _crossing(d0, d1)
    otherwise = jnp.where(jnp.maximum(d0, d1) <= -margin, y.dev, mixed)
    return jnp.where(jnp.minimum(d0, d1) >= margin, x.dev, otherwise)


def times(x: LinearEnclosure, y: LinearEnclosure) -> LinearEnclosure:
    """Return the enclosure of x y."""
    bend = 0.25 * jnp.abs((x.b - x.a) * (y.b - y.a))
    ends = lambda q: jnp.maximum(jnp.abs(q.a), jnp.abs(q.b))  # noqa: E731
    dev = _safe(ends(x), y.dev) + _safe(ends(y), x.dev) + _safe(x.dev, y.dev) + bend
    return LinearEnclosure(x.a * y.a, x.b * y.b, dev)


def _crossing(d0: jax.Array, d1: jax.Array) -> jax.Array:
    """Return the deviation of max(0, d) from a line, for d linear from d0 to d1."""
    # If d0 or d1 is zero, so is the deviation.
    crosses = (d0 < 0) != (d1 < 0)
    total = jnp.where(crosses, jnp.abs(d0) + jnp.abs(d1), 1.0)
    if _below_parabola.get():
        bend = 0.25 * total
    else:
        # The quotient is at least ½, so that the product does not underflow.
        d0, d1 = jnp.abs(d0), jnp.abs(d1)
        bend = jnp.minimum(d0, d1) * (jnp.maximum(d0, d1) / total)
    # If the total is infinite or NaN, there is no bound.
    return jnp.where(crosses, jnp.where(jnp.isfinite(total), bend, jnp.inf), 0.0)


def _safe(factor: jax.Array, dev: jax.Array) -> jax.Array:
    """Return factor · dev with 0 · ∞ = 0: the factor vanishes over the whole step."""
    return jnp.where((factor == 0) | (dev == 0), 0.0, factor * dev)


def _composed(x: LinearEnclosure, phi: Callable, bounds: Bounds) -> LinearEnclosure:
    """Return the enclosure of φ(x), from bounds on |φ′| and |φ″| over the range of x."""
    slope, curvature = bounds(x.lowest, x.highest)
    # A chord of a function of slope m is at most 2θ(1 − θ)m|Δ| away from it.
    bend = jnp.minimum(_safe(curvature, (x.b - x.a) ** 2 / 8), _safe(slope, jnp.abs(x.b - x.a) / 2))
    dev = _safe(slope, x.dev) + bend
    return LinearEnclosure(phi(x.a), phi(x.b), dev)


def _lift(value: Any) -> LinearEnclosure:
    return value if is_enclosure(value) else constant(jnp.asarray(value))


def _constant_where(a: jax.Array, b: jax.Array, certain: jax.Array) -> LinearEnclosure:
    """Return an enclosure with dev = 0 where the value is certainly constant, and ∞ elsewhere."""
    dev = jnp.where(certain, 0.0, jnp.inf).astype(_real(a))
    return LinearEnclosure(a, b, jnp.broadcast_to(dev, jnp.shape(a)))


def _is_constant(x: LinearEnclosure) -> jax.Array:
    return (x.dev == 0) & (x.a == x.b)


def _on(eqn: Any) -> Callable[..., jax.Array]:
    """Return the operation as a function of arrays."""
    return lambda *values: bind(eqn, list(values))[0]


def _at_ends(eqn: Any, *operands: LinearEnclosure) -> tuple[jax.Array, jax.Array]:
    """Return the results of the operation at the start and at the end."""
    of = _on(eqn)
    return of(*(x.a for x in operands)), of(*(x.b for x in operands))


# Rules for arrays of any type.


def _compare(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    """Return the enclosure of a comparison: constant where the difference does not change sign."""
    x, y = map(_lift, operands)
    a, b = _at_ends(eqn, x, y)
    dev = x.dev + y.dev
    distance = lambda p, q: jnp.abs(p.astype(_real(p)) - q.astype(_real(q)))  # noqa: E731
    margin = jnp.minimum(distance(x.a, y.a), distance(x.b, y.b))
    # If the results at both ends agree, a line has the same result in between. With a deviation this
    # holds only if the difference is larger than the deviation.
    same_side = ((x.a < y.a) == (x.b < y.b)) & ((x.a > y.a) == (x.b > y.b))
    return _constant_where(a, b, (a == b) & ((dev == 0) | ((margin > dev) & same_side)))


def _select(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    which, cases, choose = operands[0], list(map(_lift, operands[1:])), _on(eqn)
    if not is_enclosure(which):
        return _map(lambda *parts: choose(which, *parts), *cases)
    if not all(is_real(case.a) for case in cases):
        return _discrete(eqn, operands)
    a = choose(which.a, *(case.a for case in cases))
    b = choose(which.b, *(case.b for case in cases))
    chosen_dev = choose(which.a, *(case.dev for case in cases))
    # If the choice may change during the step, the value is always one of the cases.
    distances = [jnp.maximum(jnp.abs(case.a - a), jnp.abs(case.b - b)) + case.dev for case in cases]
    largest_dev = functools.reduce(jnp.maximum, distances)
    if _below_parabola.get():
        largest_dev = jnp.full_like(largest_dev, jnp.inf)
    return LinearEnclosure(a, b, jnp.where(_is_constant(which), chosen_dev, largest_dev))


def _take(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    """Return the enclosure of entries at constant indices, or of entries of a constant array."""
    array, *indices = operands
    pick = _on(eqn)
    if not any(map(is_enclosure, indices)):
        return _map(lambda part: pick(part, *indices), array)
    if is_enclosure(array):
        raise NoEnclosure("gather from a moving array at moving places")
    indices = list(map(_lift, indices))
    a, b = pick(array, *(p.a for p in indices)), pick(array, *(p.b for p in indices))
    certain = jnp.all(jnp.stack([jnp.all(_is_constant(p)) for p in indices]))
    if _below_parabola.get() or not is_real(a):
        return _constant_where(a, b, certain)
    # For any indices, the value is an entry of the array, or what stands for those outside of it. If
    # that is NaN, as by default, f is undefined there.
    values, fill = jnp.ravel(array), eqn.params.get("fill_value")
    if fill is not None and not np.isnan(fill):
        values = jnp.append(values, jnp.asarray(fill, values.dtype))
    width = jnp.max(values) - jnp.min(values)
    return LinearEnclosure(a, b, jnp.broadcast_to(jnp.where(certain, 0.0, width), jnp.shape(a)))


def _scatter(eqn: Any, operands: list[Any]) -> LinearEnclosure | None:
    """Return the enclosure of a scatter at constant indices, which is linear in array and updates."""
    array, indices, new = operands
    if is_enclosure(indices):
        return None
    return _map(lambda p, q: _on(eqn)(p, indices, q), _lift(array), _lift(new))


def _update(eqn: Any, operands: list[Any]) -> LinearEnclosure | None:
    """Return the enclosure of an update of a block at constant indices."""
    array, new, *indices = operands
    if any(map(is_enclosure, indices)):
        return None
    return _map(lambda p, q: _on(eqn)(p, q, *indices), _lift(array), _lift(new))


def _convert(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    x, of = _lift(operands[0]), _on(eqn)
    before, after = eqn.invars[0].aval, eqn.outvars[0].aval
    if not is_real(before):
        return _discrete(eqn, operands)
    if is_real(after):
        if jnp.finfo(after.dtype).eps > jnp.finfo(before.dtype).eps:
            raise NoEnclosure("rounding to a shorter type")
        return _map(of, x)
    # The integer part of x is constant if both bounds have the same one.
    same = of(x.lowest) == of(x.highest)
    # The conversion to Boolean is constant if the bounds have the same sign.
    if after.dtype == bool:
        same = same & ((x.lowest > 0) | (x.highest < 0) | _is_constant(x))
    # Infinite bounds have no integer part.
    return _constant_where(of(x.a), of(x.b), same & jnp.isfinite(x.dev))


def _discrete(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    """Return the enclosure of integers or Booleans: constant where every argument is constant.

    **Raises:** `NoEnclosure` for an operation with floating-point arguments, unless it is one of
    `_ENTRYWISE`, or with several results.
    """
    name = eqn.primitive.name
    entrywise = name in _ENTRYWISE
    if eqn.primitive.multiple_results or (
        any(is_real(atom.aval) for atom in eqn.invars) and not entrywise
    ):
        raise NoEnclosure(name)
    x = list(map(_lift, operands))
    a, b = _at_ends(eqn, *x)
    certain = list(map(_is_constant, x))
    if not entrywise or any(np.shape(v.a) not in ((), np.shape(a)) for v in x):
        certain = list(map(jnp.all, certain))
    return _constant_where(a, b, functools.reduce(jnp.logical_and, certain))


_ENTRYWISE = COMPARING | LOGICAL | {
    "add", "sub", "mul", "max", "min", "neg", "sign", "abs", "convert_element_type", "select_n",
    "clamp",
}  # fmt: skip


def _loop(eqn: Any, operands: list[Any]) -> list[Any]:
    """Return the enclosures of an unrolled loop."""

    def row(value: Any, k: int) -> Any:
        return _map(lambda part: part[k], value) if is_enclosure(value) else value[k]

    def stack(rows: list[Any]) -> LinearEnclosure:
        return _map(lambda *parts: jnp.stack(parts), *map(_lift, rows))

    run = lambda program, x: interpret(program, x, _DOMAIN)  # noqa: E731
    results = unroll(eqn, operands, run, row, stack)
    if results is None:
        raise NoEnclosure("a loop of many turns")
    return results


# Rules for functions of dvax with a reserved name.


def _lower_or_inf(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    """Enclose the lower bound of a box; the solver of the law checks whether the box is empty."""
    shape = eqn.outvars[0].aval.shape
    return _map(lambda part: jnp.broadcast_to(part, shape), _lift(operands[0]))


def _refuse_evaluate(eqn: Any, operands: list[Any]) -> None:
    # Its interpolation formula has no useful bound over a step. The other run checked its own data
    # between samples.
    raise NoEnclosure("Solution.evaluate")


def _table(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    """Return the enclosure of a `dvax.signals.Table` (constant, linear or cubic) between two of its
    times; across a time dev is ∞."""
    times, values, *slopes, t = operands
    if any(map(is_enclosure, (times, values, *slopes))):
        raise NoEnclosure("a table that moves")
    a, b = (bind(eqn, [*operands[:-1], end])[0] for end in (t.a, t.b))
    times, values = jnp.asarray(times), jnp.asarray(values)
    count, last = count_up_to(times, t.lowest), times.shape[0] - 1
    is_one_piece = (count > last) | (t.highest <= times[jnp.minimum(count, last)])
    i = jnp.clip(count - 1, 0, last - 1)
    width = times[i + 1] - times[i]
    rise, slope, bend = values[i + 1] - values[i], jnp.zeros(()), jnp.zeros(())
    if eqn.params["name"] == "dvax_linear_table":
        slope = jnp.abs(rise / width)
    if slopes:
        d0, d1 = slopes[0][i] * width, slopes[0][i + 1] * width
        # v'' is linear between the two times.
        shares = (t.lowest - times[i]) / width, (t.highest - times[i]) / width
        second, third = 6.0 * rise - 4.0 * d0 - 2.0 * d1, 6.0 * (d0 + d1 - 2.0 * rise)
        bend = jnp.maximum(*(jnp.abs(second + third * s) for s in shares)) / width**2
        slope = jnp.maximum(
            *(jnp.abs(d0 + s * (second + 0.5 * third * s)) / width for s in shares)
        ) + bend * (t.highest - t.lowest)
    dev = _safe(slope, t.dev) + _safe(bend, (t.b - t.a) ** 2 / 8)
    dev = jnp.where(is_one_piece, dev, jnp.inf)
    return LinearEnclosure(a, b, jnp.broadcast_to(dev, a.shape).astype(a.dtype))


def _search(eqn: Any, operands: list[Any]) -> LinearEnclosure | None:
    """Return the enclosure of the index of x in a sorted array: constant if both bounds have the same
    index."""
    row, x = operands
    if is_enclosure(row):
        return None
    index = lambda v: _on(eqn)(row, v)  # noqa: E731
    certain = (index(x.lowest) == index(x.highest)) & jnp.all(row[1:] >= row[:-1])
    return _constant_where(index(x.a), index(x.b), certain)


# Rules for floating numbers.


def _linear(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    """Return the enclosure of an operation that only rearranges or adds entries."""
    return _map(_on(eqn), *map(_lift, operands))


def _split(eqn: Any, operands: list[Any]) -> list[LinearEnclosure]:
    return [LinearEnclosure(*parts) for parts in zip(*(bind(eqn, [part]) for part in operands[0]))]


def _with_constant(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    """Return the enclosure of a sum or product with a constant.

    It has no curvature term, and most operations of laws are of this kind.
    """
    first, of = is_enclosure(operands[0]), _on(eqn)
    x, c = operands if first else reversed(operands)
    a, b = (of(x.a, c), of(x.b, c)) if first else (of(c, x.a), of(c, x.b))
    if eqn.primitive.name != "mul":
        return LinearEnclosure(a, b, jnp.broadcast_to(x.dev, a.shape))
    if _is_plain(c, x.dev.dtype):
        return LinearEnclosure(a, b, abs(float(c)) * jnp.broadcast_to(x.dev, a.shape))
    return LinearEnclosure(a, b, _safe(jnp.abs(c), x.dev))


def _is_plain(c: Any, dtype: Any) -> bool:
    """Return whether c is a concrete number, finite and not subnormal."""
    is_number = isinstance(c, (float, int, np.generic, np.ndarray)) and np.ndim(c) == 0
    return is_number and bool(np.isfinite(c) & (np.abs(c) >= jnp.finfo(dtype).tiny))


def _sum(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    if not all(map(is_enclosure, operands)):
        return _with_constant(eqn, operands)
    x, y = operands
    of = _on(eqn)
    return LinearEnclosure(of(x.a, y.a), of(x.b, y.b), x.dev + y.dev)


def _product(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    return times(*operands) if all(map(is_enclosure, operands)) else _with_constant(eqn, operands)


def _quotient(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    x, c = _lift(operands[0]), operands[1]
    if is_enclosure(c):
        # If an entry of the denominator may vanish, its deviation is infinite; no error is raised.
        return times(x, _composed(c, lambda v: 1.0 / v, integer_power(-1).bounds))
    dev = x.dev / jnp.abs(c)
    if not _is_plain(c, x.dev.dtype):
        # ∞/∞ is unknown, and so is 0/0 unless c is nonzero and the quotient underflowed.
        dev = jnp.where(jnp.isnan(dev), jnp.where((x.dev == 0) & (c != 0), 0.0, jnp.inf), dev)
    return LinearEnclosure(x.a / c, x.b / c, dev)


def _negative(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    x = operands[0]
    return LinearEnclosure(-x.a, -x.b, x.dev)


def _modulus(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    return largest(operands[0], _negative(eqn, operands))


def _clamp(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    low, x, high = map(_lift, operands)
    return smallest(largest(x, low), high)


def _stairs(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    """Return the enclosure of a monotone step function, which stays between its values at the
    bounds."""
    x, phi = operands[0], _on(eqn)
    rise = phi(x.highest) - phi(x.lowest)
    if _below_parabola.get():
        rise = jnp.where(rise == 0.0, 0.0, jnp.inf)
    return LinearEnclosure(phi(x.a), phi(x.b), rise)


def _smooth(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    phi = smooth(eqn)
    assert phi is not None
    return _composed(operands[0], _on(eqn), phi.bounds)


def _power(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    x, y = operands
    of = _on(eqn)
    if not is_enclosure(y):
        return _composed(x, lambda v: of(v, y), lambda low, high: power_bounds(low, high, y))
    if not is_enclosure(x):
        return _composed(y, lambda v: of(x, v), lambda low, high: exponential_bounds(low, high, x))
    # x^y = exp(y log x), for x > 0.
    exponent = times(y, _composed(x, jnp.log, SMOOTH["log"].bounds))
    dev = _composed(exponent, jnp.exp, SMOOTH["exp"].bounds).dev
    return LinearEnclosure(of(x.a, y.a), of(x.b, y.b), dev)


def _remainder(eqn: Any, operands: list[Any]) -> LinearEnclosure | None:
    """Return the enclosure of x − c trunc(x/c) for constant c: that of x if the quotient is
    constant."""
    x, c = operands
    if is_enclosure(c):
        return None
    quotient = lambda v: jnp.trunc(v / c)  # noqa: E731
    # Enlarge the bounds of x by their rounding errors.
    slack = jnp.where(x.dev == 0.0, 0.0, 2 * jnp.finfo(x.a.dtype).eps * x.largest)
    is_constant = (quotient(x.lowest - slack) == quotient(x.highest + slack)) | _is_constant(x)
    jump = jnp.inf if _below_parabola.get() else 2.0 * jnp.abs(c)
    of = _on(eqn)
    return LinearEnclosure(of(x.a, c), of(x.b, c), jnp.where(is_constant, x.dev, x.dev + jump))


def _pad(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    (x, edge), of = map(_lift, operands), _on(eqn)
    of_x = of(x.dev, jnp.zeros_like(edge.dev))
    dev = jnp.maximum(of_x, of(jnp.zeros_like(x.dev), edge.dev))
    return LinearEnclosure(of(x.a, edge.a), of(x.b, edge.b), dev)


def _folded(combine: Callable[..., LinearEnclosure]) -> Rule:
    """Return the rule of a reduction, which combines the two halves of the entries repeatedly."""

    def rule(eqn: Any, operands: list[Any]) -> LinearEnclosure:
        x = operands[0]
        for axis in sorted(eqn.params["axes"], reverse=True):
            rows = _map(lambda part, axis=axis: jnp.moveaxis(part, axis, 0), x)
            if rows.a.shape[0] == 0:
                raise NoEnclosure("a reduction of nothing")
            # Each pass halves the number of rows.
            while (count := rows.a.shape[0]) > 1:
                half = count // 2
                first, second, odd = (
                    _map(lambda part, cut=cut: part[cut], rows)
                    for cut in (slice(half), slice(half, 2 * half), slice(2 * half, None))
                )
                rows = _map(lambda p, q: jnp.concatenate([p, q]), combine(first, second), odd)
            x = _map(lambda part: part[0], rows)
        return x

    return rule


def _matrix_product(eqn: Any, operands: list[Any]) -> LinearEnclosure:
    x, y, of = *operands, _on(eqn)
    # For a constant matrix M the deviation is |M| dev.
    if not is_enclosure(x):
        return LinearEnclosure(of(x, y.a), of(x, y.b), of(jnp.abs(x), y.dev))
    if not is_enclosure(y):
        return LinearEnclosure(of(x.a, y), of(x.b, y), of(x.dev, jnp.abs(y)))
    # Sum the rule of `times`.
    ends = lambda q: jnp.maximum(jnp.abs(q.a), jnp.abs(q.b))  # noqa: E731
    dev = of(ends(x), y.dev) + of(x.dev, ends(y)) + of(x.dev, y.dev)
    dev = dev + 0.25 * of(jnp.abs(x.b - x.a), jnp.abs(y.b - y.a))
    # A product 0 · ∞ is unknown.
    return LinearEnclosure(of(x.a, y.a), of(x.b, y.b), jnp.where(jnp.isnan(dev), jnp.inf, dev))


_OF_ANY_TYPE: dict[str, Rule] = {
    **same_for(COMPARING, _compare),
    **same_for({"gather", "dynamic_slice"}, _take),
    **same_for({"scatter", "scatter-add"}, _scatter),
    "dynamic_update_slice": _update,
    **same_for(LOGICAL, _discrete),
    "select_n": _select,
    "convert_element_type": _convert,
    "scan": _loop,
    **same_for(TABLES, _table),
    "dvax_lower_or_inf": _lower_or_inf,
    "dvax_evaluate": _refuse_evaluate,
    "searchsorted": _search,
}

_OF_FLOATS: dict[str, Rule] = {
    **same_for(REARRANGING | SUMMING | JOINING, _linear),
    **same_for(STEPWISE, _stairs),
    **same_for(SMOOTH_NAMES, _smooth),
    **same_for({"add", "add_any", "sub"}, _sum),
    **same_for({"split", "unstack"}, _split),
    "mul": _product,
    "div": _quotient,
    "neg": _negative,
    "abs": _modulus,
    "max": lambda eqn, operands: largest(*map(_lift, operands)),
    "min": lambda eqn, operands: smallest(*map(_lift, operands)),
    "clamp": _clamp,
    "pow": _power,
    "rem": _remainder,
    "pad": _pad,
    "reduce_max": _folded(largest),
    "reduce_min": _folded(smallest),
    "reduce_prod": _folded(times),
    "dot_general": _matrix_product,
}

RULES: dict[str, Rule] = {**_OF_ANY_TYPE, **_OF_FLOATS}


def _apply(rule: Rule, eqn: Any, operands: list[Any]) -> list[Any] | None:
    types = [atom.aval for atom in (*eqn.invars, *eqn.outvars)]
    if rule is not _loop and any(jnp.issubdtype(t.dtype, jnp.complexfloating) for t in types):
        return None
    if eqn.primitive.name in _OF_FLOATS and not all(map(is_real, types)):
        rule = _discrete
    result = rule(eqn, operands)
    return [result] if isinstance(result, LinearEnclosure) else result


def _unknown(eqn: Any, operands: list[Any]) -> list[Any]:
    types = [atom.aval for atom in (*eqn.invars, *eqn.outvars)]
    if all(map(is_real, types)) or any(jnp.issubdtype(t.dtype, jnp.complexfloating) for t in types):
        raise NoEnclosure(eqn.primitive.name)
    return [_discrete(eqn, operands)]


_DOMAIN = Domain(RULES, is_enclosure, _unknown, _apply)
