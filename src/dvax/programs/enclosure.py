"""Linear enclosures: how far a function of time is from the straight line between its ends.

Over one step every quantity is carried as (a, b, dev): its value at the start, its value at the end,
and a bound with |q(θ) − ((1−θ)a + θb)| ≤ dev for every θ in between. Each operation of the user's f and
h has a rule that keeps that true:

    sum          deviations add
    product      |q r − line| ≤ |q| dev_r + |r| dev_q + dev_q dev_r + |Δq Δr|/4
    max, min     deviations compare, and a crossing adds |d₀d₁|/(|d₀| + |d₁|), d the difference
    smooth φ     sup|φ′| dev + sup|φ″| Δ²/8 over the range of the argument

So a deviation is O(h²) where things are smooth, O(h) where a kink lies inside the step, and never
too small: an enclosure, where samples would be a guess.

What has no rule raises `NoEnclosure`, and the defect is sampled instead, and called estimated.
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
from .._tree import Tree
from .interpreter import Domain, Rule, interpret, is_real, same_for, unrolled
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
    """Within this block enclosures satisfy |q(θ) − line(θ)| ≤ 4θ(1−θ) dev, not only ≤ dev.

    The rules for sums, products and smooth functions have this shape by themselves. A kink between
    slopes that differ by 2L may lie near an end of the step: its deviation is below the parabola of
    height Lh/2, whatever its place. A jump has no such bound: dev = ∞.
    """
    token = _below_parabola.set(True)
    try:
        yield
    finally:
        _below_parabola.reset(token)


class NoEnclosure(Exception):
    """An operation that linear enclosures have no rule for; its name is the argument."""


class LinearEnclosure(NamedTuple):
    """(a, b, dev) of one array. Integers and booleans have dev 0 where constant, else infinity."""

    a: jax.Array
    b: jax.Array
    dev: jax.Array

    @property
    def largest(self) -> jax.Array:
        """sup |q| over the step."""
        return jnp.maximum(jnp.abs(self.a), jnp.abs(self.b)) + self.dev

    @property
    def lowest(self) -> jax.Array:
        return jnp.minimum(self.a, self.b) - self.dev

    @property
    def highest(self) -> jax.Array:
        return jnp.maximum(self.a, self.b) + self.dev


def _map(fn: Callable[..., Any], *given: LinearEnclosure) -> LinearEnclosure:
    """Return fn of the starts, of the ends and of the deviations."""
    return LinearEnclosure(*(fn(*parts) for parts in zip(*given, strict=True)))


def straight(a: Tree, b: Tree) -> Tree:
    """Return a tree of enclosures without deviation: what is linear in time."""
    return jtu.tree_map(lambda p, q: LinearEnclosure(p, q, _no_deviation(p)), a, b)


def constant(a: Tree) -> Tree:
    """Return a tree of enclosures of what is constant in time."""
    return straight(a, a)


def enclose(fn: Callable[..., Tree], *args: Tree) -> Tree:
    """Return fn of trees whose leaves are linear enclosures, as a tree of such.

    **Raises:** `NoEnclosure` where fn uses an operation without a rule.
    """
    leaves, structure = jtu.tree_flatten(args, is_leaf=is_enclosure)
    starts = structure.unflatten([leaf.a for leaf in leaves])
    program, shape = jax.make_jaxpr(fn, return_shape=True)(*starts)
    results = interpret(program, leaves, _DOMAIN)
    return jtu.tree_structure(shape).unflatten(list(map(_lift, results)))


def _no_deviation(value: Any) -> jax.Array:
    return jnp.zeros(jnp.shape(value), _real(value))


def _real(value: Any) -> Any:
    """The type of a deviation: that of the value, or for integers and truth values the shortest."""
    dtype = jnp.result_type(value)
    return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.float32


def is_enclosure(value: Any) -> bool:
    return isinstance(value, LinearEnclosure)


def largest(x: LinearEnclosure, y: LinearEnclosure) -> LinearEnclosure:
    """max(x, y): only the one that is larger all along matters, where there is such a one."""
    dev = _either(x, y, x.a - y.a, x.b - y.b)
    return LinearEnclosure(jnp.maximum(x.a, y.a), jnp.maximum(x.b, y.b), dev)


def smallest(x: LinearEnclosure, y: LinearEnclosure) -> LinearEnclosure:
    """min(x, y)."""
    dev = _either(x, y, y.a - x.a, y.b - x.b)
    return LinearEnclosure(jnp.minimum(x.a, y.a), jnp.minimum(x.b, y.b), dev)


def _either(x: LinearEnclosure, y: LinearEnclosure, d0: jax.Array, d1: jax.Array) -> jax.Array:
    """The deviation of the larger of two, x being ahead by d0 at the start and by d1 at the end."""
    doubt = x.dev + y.dev
    mixed = jnp.maximum(x.dev, y.dev) + _crossing(d0, d1)
    behind = jnp.where(jnp.maximum(d0, d1) <= -doubt, y.dev, mixed)
    return jnp.where(jnp.minimum(d0, d1) >= doubt, x.dev, behind)


def times(x: LinearEnclosure, y: LinearEnclosure) -> LinearEnclosure:
    """x y."""
    bend = 0.25 * jnp.abs((x.b - x.a) * (y.b - y.a))
    ends = lambda q: jnp.maximum(jnp.abs(q.a), jnp.abs(q.b))  # noqa: E731
    dev = _safe(ends(x), y.dev) + _safe(ends(y), x.dev) + _safe(x.dev, y.dev) + bend
    return LinearEnclosure(x.a * y.a, x.b * y.b, dev)


def _crossing(d0: jax.Array, d1: jax.Array) -> jax.Array:
    """The bend of max(0, d) for d linear from d0 to d1."""
    # Where one of them is zero, so is the bend.
    crosses = (d0 < 0) != (d1 < 0)
    total = jnp.where(crosses, jnp.abs(d0) + jnp.abs(d1), 1.0)
    if _below_parabola.get():
        bend = 0.25 * total
    else:
        # The quotient is ½ at least: no bend is lost to one that is too small for a number.
        d0, d1 = jnp.abs(d0), jnp.abs(d1)
        bend = jnp.minimum(d0, d1) * (jnp.maximum(d0, d1) / total)
    # From one infinity to the other, or from numbers whose sum is none, there is no bound.
    return jnp.where(crosses, jnp.where(jnp.isfinite(total), bend, jnp.inf), 0.0)


def _safe(factor: jax.Array, dev: jax.Array) -> jax.Array:
    """factor · dev with 0 · ∞ = 0: a factor that vanishes all along leaves nothing."""
    return jnp.where((factor == 0) | (dev == 0), 0.0, factor * dev)


def _composed(x: LinearEnclosure, phi: Callable, bounds: Bounds) -> LinearEnclosure:
    """φ(x), from bounds on |φ′| and |φ″| over the range of x."""
    slope, curvature = bounds(x.lowest, x.highest)
    dev = _safe(slope, x.dev) + _safe(curvature, (x.b - x.a) ** 2 / 8)
    return LinearEnclosure(phi(x.a), phi(x.b), dev)


def _lift(value: Any) -> LinearEnclosure:
    return value if is_enclosure(value) else constant(jnp.asarray(value))


def _constant_where(a: jax.Array, b: jax.Array, certain: jax.Array) -> LinearEnclosure:
    """A value that does not change where that is certain, and may be anything elsewhere."""
    dev = jnp.where(certain, 0.0, jnp.inf).astype(_real(a))
    return LinearEnclosure(a, b, jnp.broadcast_to(dev, jnp.shape(a)))


def _is_constant(x: LinearEnclosure) -> jax.Array:
    return (x.dev == 0) & (x.a == x.b)


def _on(eqn: Any) -> Callable[..., jax.Array]:
    """The operation as a function of arrays."""
    return lambda *values: bind(eqn, list(values))[0]


def _at_ends(eqn: Any, *given: LinearEnclosure) -> tuple[jax.Array, jax.Array]:
    """The results of the operation at the start and at the end."""
    of = _on(eqn)
    return of(*(x.a for x in given)), of(*(x.b for x in given))


# Rules for arrays of any type.


def _compare(eqn: Any, given: list[Any]) -> LinearEnclosure:
    """A comparison, certain where the difference keeps its sign all along."""
    x, y = map(_lift, given)
    a, b = _at_ends(eqn, x, y)
    dev = x.dev + y.dev
    apart = lambda p, q: jnp.abs(p.astype(_real(p)) - q.astype(_real(q)))  # noqa: E731
    margin = jnp.minimum(apart(x.a, y.a), apart(x.b, y.b))
    # A line that gives the same answer at both ends gives it in between; with a deviation, only
    # where it stays clear of zero.
    same_side = ((x.a < y.a) == (x.b < y.b)) & ((x.a > y.a) == (x.b > y.b))
    return _constant_where(a, b, (a == b) & ((dev == 0) | ((margin > dev) & same_side)))


def _select(eqn: Any, given: list[Any]) -> LinearEnclosure:
    which, cases, choose = given[0], list(map(_lift, given[1:])), _on(eqn)
    if not is_enclosure(which):
        return _map(lambda *parts: choose(which, *parts), *cases)
    if not all(is_real(case.a) for case in cases):
        return _discrete(eqn, given)
    a = choose(which.a, *(case.a for case in cases))
    b = choose(which.b, *(case.b for case in cases))
    settled = choose(which.a, *(case.dev for case in cases))
    # Where the choice may change on the way, the value is one of the cases at every moment.
    apart = [jnp.maximum(jnp.abs(case.a - a), jnp.abs(case.b - b)) + case.dev for case in cases]
    worst = functools.reduce(jnp.maximum, apart)
    if _below_parabola.get():
        worst = jnp.full_like(worst, jnp.inf)
    return LinearEnclosure(a, b, jnp.where(_is_constant(which), settled, worst))


def _take(eqn: Any, given: list[Any]) -> LinearEnclosure:
    """Entries of an array at fixed places, or of a fixed array at places that stay as they are."""
    array, *places = given
    pick = _on(eqn)
    if not any(map(is_enclosure, places)):
        return _map(lambda part: pick(part, *places), array)
    if is_enclosure(array):
        raise NoEnclosure("gather from a moving array at moving places")
    places = list(map(_lift, places))
    a, b = pick(array, *(p.a for p in places)), pick(array, *(p.b for p in places))
    certain = jnp.all(jnp.stack([jnp.all(_is_constant(p)) for p in places]))
    if _below_parabola.get() or not is_real(a):
        return _constant_where(a, b, certain)
    # Wherever they lead, the value is one of the array.
    apart = jnp.max(array) - jnp.min(array)
    return LinearEnclosure(a, b, jnp.broadcast_to(jnp.where(certain, 0.0, apart), jnp.shape(a)))


def _scatter(eqn: Any, given: list[Any]) -> LinearEnclosure | None:
    """Linear in the array and in what is written into it."""
    array, places, new = given
    if is_enclosure(places):
        return None
    return _map(lambda p, q: _on(eqn)(p, places, q), _lift(array), _lift(new))


def _update(eqn: Any, given: list[Any]) -> LinearEnclosure | None:
    """The same for a block of the array."""
    array, new, *places = given
    if any(map(is_enclosure, places)):
        return None
    return _map(lambda p, q: _on(eqn)(p, q, *places), _lift(array), _lift(new))


def _convert(eqn: Any, given: list[Any]) -> LinearEnclosure:
    x, of = _lift(given[0]), _on(eqn)
    before, after = eqn.invars[0].aval, eqn.outvars[0].aval
    if not is_real(before):
        return _discrete(eqn, given)
    if is_real(after):
        if jnp.finfo(after.dtype).eps > jnp.finfo(before.dtype).eps:
            raise NoEnclosure("rounding to a shorter type")
        return _map(of, x)
    # The whole part of x, or whether x is not zero: certain where both bounds have the same one.
    same = of(x.lowest) == of(x.highest)
    # Truth changes at zero alone, and both bounds may differ from it on different sides.
    if after.dtype == bool:
        same = same & ((x.lowest > 0) | (x.highest < 0) | _is_constant(x))
    # Infinite bounds have no whole part.
    return _constant_where(of(x.a), of(x.b), same & jnp.isfinite(x.dev))


def _discrete(eqn: Any, given: list[Any]) -> LinearEnclosure:
    """Integers and truth values: certain where every argument stays as it is.

    **Raises:** `NoEnclosure` for an operation that takes or makes other numbers, unless it acts entry
    by entry in a way that is known.
    """
    name = eqn.primitive.name
    entrywise = name in _ENTRYWISE
    if eqn.primitive.multiple_results or (
        any(is_real(atom.aval) for atom in eqn.invars) and not entrywise
    ):
        raise NoEnclosure(name)
    x = list(map(_lift, given))
    a, b = _at_ends(eqn, *x)
    certain = list(map(_is_constant, x))
    if not entrywise or any(np.shape(v.a) not in ((), np.shape(a)) for v in x):
        certain = list(map(jnp.all, certain))
    return _constant_where(a, b, functools.reduce(jnp.logical_and, certain))


_ENTRYWISE = COMPARING | LOGICAL | {
    "add", "sub", "mul", "max", "min", "neg", "sign", "abs", "convert_element_type", "select_n",
    "clamp",
}  # fmt: skip


def _loop(eqn: Any, given: list[Any]) -> list[Any]:
    """A loop of few turns, turn by turn."""

    def row(value: Any, k: int) -> Any:
        return _map(lambda part: part[k], value) if is_enclosure(value) else value[k]

    def stack(rows: list[Any]) -> LinearEnclosure:
        return _map(lambda *parts: jnp.stack(parts), *map(_lift, rows))

    found = unrolled(eqn, given, _DOMAIN, row, stack)
    if found is None:
        raise NoEnclosure("a loop of many turns")
    return found


# Rules for functions that dvax knows by name.


def _lower_or_inf(eqn: Any, given: list[Any]) -> LinearEnclosure:
    """Enclose the lower bound of a box; the solver of the law checks whether the box is empty."""
    shape = eqn.outvars[0].aval.shape
    return _map(lambda part: jnp.broadcast_to(part, shape), _lift(given[0]))


def _refuse_evaluate(eqn: Any, given: list[Any]) -> None:
    # Its quotients have no bound over most of a step, and another run has looked between samples.
    raise NoEnclosure("Solution.evaluate")


def _table(eqn: Any, given: list[Any]) -> LinearEnclosure:
    """Values of a `dvax.signals.Table`: a constant, a line or a cubic between two of its times, and
    without a bound across one."""
    times, values, *slopes, t = given
    if any(map(is_enclosure, (times, values, *slopes))):
        raise NoEnclosure("a table that moves")
    a, b = (bind(eqn, [*given[:-1], end])[0] for end in (t.a, t.b))
    times, values = jnp.asarray(times), jnp.asarray(values)
    method = "scan_unrolled" if times.shape[0] <= 4096 else "scan"
    passed = lambda t, side: jnp.searchsorted(times, t, side=side, method=method)  # noqa: E731
    whole = passed(t.highest, "left") <= passed(t.lowest, "right")
    i = jnp.clip(passed(t.lowest, "right") - 1, 0, times.shape[0] - 2)
    width = times[i + 1] - times[i]
    rise, slope, bend = values[i + 1] - values[i], jnp.zeros(()), jnp.zeros(())
    if eqn.params["name"] == "dvax_linear_table":
        slope = jnp.abs(rise / width)
    if slopes:
        d0, d1 = slopes[0][i] * width, slopes[0][i + 1] * width
        # v'' is a line in the share of the way between the two times.
        shares = (t.lowest - times[i]) / width, (t.highest - times[i]) / width
        first, turn = 6.0 * rise - 4.0 * d0 - 2.0 * d1, 6.0 * (d0 + d1 - 2.0 * rise)
        bend = jnp.maximum(*(jnp.abs(first + turn * s) for s in shares)) / width**2
        slope = jnp.maximum(
            *(jnp.abs(d0 + s * (first + 0.5 * turn * s)) / width for s in shares)
        ) + bend * (t.highest - t.lowest)
    dev = _safe(slope, t.dev) + _safe(bend, (t.b - t.a) ** 2 / 8)
    dev = jnp.where(whole, dev, jnp.inf)
    return LinearEnclosure(a, b, jnp.broadcast_to(dev, a.shape).astype(a.dtype))


def _search(eqn: Any, given: list[Any]) -> LinearEnclosure | None:
    """The place of x in a sorted row: certain where both of its bounds have the same."""
    row, x = given
    if is_enclosure(row):
        return None
    place = lambda v: _on(eqn)(row, v)  # noqa: E731
    certain = (place(x.lowest) == place(x.highest)) & jnp.all(row[1:] >= row[:-1])
    return _constant_where(place(x.a), place(x.b), certain)


# Rules for floating numbers.


def _linear(eqn: Any, given: list[Any]) -> LinearEnclosure:
    """What only moves entries about, or adds them up."""
    return _map(_on(eqn), *map(_lift, given))


def _split(eqn: Any, given: list[Any]) -> list[LinearEnclosure]:
    return [LinearEnclosure(*parts) for parts in zip(*(bind(eqn, [part]) for part in given[0]))]


def _with_constant(eqn: Any, given: list[Any]) -> LinearEnclosure:
    """A sum or product with a constant: no curvature, and laws are mostly made of these."""
    first, of = is_enclosure(given[0]), _on(eqn)
    x, c = given if first else reversed(given)
    a, b = (of(x.a, c), of(x.b, c)) if first else (of(c, x.a), of(c, x.b))
    if eqn.primitive.name != "mul":
        return LinearEnclosure(a, b, jnp.broadcast_to(x.dev, a.shape))
    if _is_plain(c, x.dev.dtype):
        return LinearEnclosure(a, b, abs(float(c)) * jnp.broadcast_to(x.dev, a.shape))
    return LinearEnclosure(a, b, _safe(jnp.abs(c), x.dev))


def _is_plain(c: Any, dtype: Any) -> bool:
    """Whether it is one number whose value is known, and neither infinite nor one that a product may
    take for zero."""
    known = isinstance(c, (float, int, np.generic, np.ndarray)) and np.ndim(c) == 0
    return known and bool(np.isfinite(c) & (np.abs(c) >= jnp.finfo(dtype).tiny))


def _sum(eqn: Any, given: list[Any]) -> LinearEnclosure:
    if not all(map(is_enclosure, given)):
        return _with_constant(eqn, given)
    x, y = given
    of = _on(eqn)
    return LinearEnclosure(of(x.a, y.a), of(x.b, y.b), x.dev + y.dev)


def _product(eqn: Any, given: list[Any]) -> LinearEnclosure:
    return times(*given) if all(map(is_enclosure, given)) else _with_constant(eqn, given)


def _quotient(eqn: Any, given: list[Any]) -> LinearEnclosure:
    x, c = _lift(given[0]), given[1]
    if is_enclosure(c):
        # A denominator that may vanish has no bound: infinity, not an error, for its entry alone.
        return times(x, _composed(c, lambda v: 1.0 / v, integer_power(-1).bounds))
    dev = x.dev / jnp.abs(c)
    if not _is_plain(c, x.dev.dtype):
        # ∞/∞ may be anything, and so may 0/0, unless c is only small.
        dev = jnp.where(jnp.isnan(dev), jnp.where((x.dev == 0) & (c != 0), 0.0, jnp.inf), dev)
    return LinearEnclosure(x.a / c, x.b / c, dev)


def _negative(eqn: Any, given: list[Any]) -> LinearEnclosure:
    x = given[0]
    return LinearEnclosure(-x.a, -x.b, x.dev)


def _modulus(eqn: Any, given: list[Any]) -> LinearEnclosure:
    return largest(given[0], _negative(eqn, given))


def _clamp(eqn: Any, given: list[Any]) -> LinearEnclosure:
    low, x, high = map(_lift, given)
    return smallest(largest(x, low), high)


def _stairs(eqn: Any, given: list[Any]) -> LinearEnclosure:
    """A monotone φ of finitely many values: over the step it stays between those at the extremes."""
    x, phi = given[0], _on(eqn)
    rise = phi(x.highest) - phi(x.lowest)
    if _below_parabola.get():
        rise = jnp.where(rise == 0.0, 0.0, jnp.inf)
    return LinearEnclosure(phi(x.a), phi(x.b), rise)


def _smooth(eqn: Any, given: list[Any]) -> LinearEnclosure:
    phi = smooth(eqn)
    assert phi is not None
    return _composed(given[0], _on(eqn), phi.bounds)


def _power(eqn: Any, given: list[Any]) -> LinearEnclosure:
    x, y = given
    of = _on(eqn)
    if not is_enclosure(y):
        return _composed(x, lambda v: of(v, y), lambda low, high: power_bounds(low, high, y))
    if not is_enclosure(x):
        return _composed(y, lambda v: of(x, v), lambda low, high: exponential_bounds(low, high, x))
    # x^y = exp(y log x), for x > 0.
    exponent = times(y, _composed(x, jnp.log, SMOOTH["log"].bounds))
    dev = _composed(exponent, jnp.exp, SMOOTH["exp"].bounds).dev
    return LinearEnclosure(of(x.a, y.a), of(x.b, y.b), dev)


def _remainder(eqn: Any, given: list[Any]) -> LinearEnclosure | None:
    """x − c trunc(x/c) with a fixed c: a line with the slope of x while the quotient stays."""
    x, c = given
    if is_enclosure(c):
        return None
    whole = lambda v: jnp.trunc(v / c)  # noqa: E731
    # Bounds on x that are sums are rounded, and a quotient at a whole number may be either.
    slack = jnp.where(x.dev == 0.0, 0.0, 2 * jnp.finfo(x.a.dtype).eps * x.largest)
    stays = (whole(x.lowest - slack) == whole(x.highest + slack)) | _is_constant(x)
    jumps = jnp.inf if _below_parabola.get() else 2.0 * jnp.abs(c)
    of = _on(eqn)
    return LinearEnclosure(of(x.a, c), of(x.b, c), jnp.where(stays, x.dev, x.dev + jumps))


def _pad(eqn: Any, given: list[Any]) -> LinearEnclosure:
    (x, edge), of = map(_lift, given), _on(eqn)
    of_x = of(x.dev, jnp.zeros_like(edge.dev))
    dev = jnp.maximum(of_x, of(jnp.zeros_like(x.dev), edge.dev))
    return LinearEnclosure(of(x.a, edge.a), of(x.b, edge.b), dev)


def _folded(join: Callable[..., LinearEnclosure]) -> Rule:
    """The join of all entries along the axes, two halves at a time."""

    def rule(eqn: Any, given: list[Any]) -> LinearEnclosure:
        x = given[0]
        for axis in sorted(eqn.params["axes"], reverse=True):
            rows = _map(lambda part, axis=axis: jnp.moveaxis(part, axis, 0), x)
            if rows.a.shape[0] == 0:
                raise NoEnclosure("a reduction of nothing")
            while (count := rows.a.shape[0]) > 1:
                half = count // 2
                first, second, odd = (
                    _map(lambda part, cut=cut: part[cut], rows)
                    for cut in (slice(half), slice(half, 2 * half), slice(2 * half, None))
                )
                rows = _map(lambda p, q: jnp.concatenate([p, q]), join(first, second), odd)
            x = _map(lambda part: part[0], rows)
        return x

    return rule


def _matrix_product(eqn: Any, given: list[Any]) -> LinearEnclosure:
    x, y, of = *given, _on(eqn)
    # A fixed matrix: deviations pass through its absolute values.
    if not is_enclosure(x):
        return LinearEnclosure(of(x, y.a), of(x, y.b), of(jnp.abs(x), y.dev))
    if not is_enclosure(y):
        return LinearEnclosure(of(x.a, y), of(x.b, y), of(x.dev, jnp.abs(y)))
    # The rule of `times`, summed.
    ends = lambda q: jnp.maximum(jnp.abs(q.a), jnp.abs(q.b))  # noqa: E731
    dev = of(ends(x), y.dev) + of(x.dev, ends(y)) + of(x.dev, y.dev)
    dev = dev + 0.25 * of(jnp.abs(x.b - x.a), jnp.abs(y.b - y.a))
    # 0 · ∞ may stand for anything.
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
    "split": _split,
    "mul": _product,
    "div": _quotient,
    "neg": _negative,
    "abs": _modulus,
    "max": lambda eqn, given: largest(*map(_lift, given)),
    "min": lambda eqn, given: smallest(*map(_lift, given)),
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


def _apply(rule: Rule, eqn: Any, given: list[Any]) -> list[Any] | None:
    types = [atom.aval for atom in (*eqn.invars, *eqn.outvars)]
    if rule is not _loop and any(jnp.issubdtype(t.dtype, jnp.complexfloating) for t in types):
        return None
    if eqn.primitive.name in _OF_FLOATS and not all(map(is_real, types)):
        rule = _discrete
    found = rule(eqn, given)
    return [found] if isinstance(found, LinearEnclosure) else found


def _unknown(eqn: Any, given: list[Any]) -> list[Any]:
    types = [atom.aval for atom in (*eqn.invars, *eqn.outvars)]
    if all(map(is_real, types)) or any(jnp.issubdtype(t.dtype, jnp.complexfloating) for t in types):
        raise NoEnclosure(eqn.primitive.name)
    return [_discrete(eqn, given)]


_DOMAIN = Domain(RULES, is_enclosure, _unknown, _apply)
