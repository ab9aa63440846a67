"""Chord arithmetic: how far a function of time is from the straight line between its ends.

Over one step every quantity is carried as a *chord* (a, b, dev): its value at the start, its value
at the end, and a bound with |q(θ) − ((1−θ)a + θb)| ≤ dev for every θ in between. Each operation of
the user's f and h, read off its jaxpr, has a rule that keeps that true:

    sum          deviations add
    product      |q r − chord| ≤ |q| dev_r + |r| dev_q + dev_q dev_r + |Δq Δr|/4
    max, min     deviations compare, and a crossing adds |d₀d₁|/(|d₀| + |d₁|), d the difference
    smooth φ     sup|φ′| dev + sup|φ″| Δ²/8 over the range of the argument

So a deviation is O(h²) where things are smooth, O(h) where a kink lies inside the step, and never
too small: an enclosure, where samples would be a guess.

What has no rule raises `NoEnclosure`, and the defect is sampled instead, and called estimated.
"""

import contextlib
import contextvars
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr

from .._jaxpr import bound, is_search, scan_counts
from .._smooth_bounds import BOUNDS, exponential, power
from .._tree import Tree
from ..vi.structure import CALLS, evaluate

_below_parabola = contextvars.ContextVar("below_parabola", default=False)


@contextlib.contextmanager
def below_parabola() -> Iterator[None]:
    """Within this block enclosures satisfy |q(θ) − chord(θ)| ≤ 4θ(1−θ) dev, not only ≤ dev.

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
    """An operation that chord arithmetic has no rule for; its name is the argument."""


class Chord(NamedTuple):
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


def straight(a: Tree, b: Tree) -> Tree:
    """A tree of chords without deviation: what is linear in time."""
    return jtu.tree_map(lambda p, q: Chord(p, q, _still(p)), a, b)


def constant(a: Tree) -> Tree:
    """A tree of chords that do not move."""
    return straight(a, a)


def enclose(fn: Callable[..., Tree], *args: Tree) -> Tree:
    """fn of trees whose leaves are chords, as a tree of chords.

    **Raises:** `NoEnclosure` where fn uses an operation without a rule.
    """
    leaves, structure = jtu.tree_flatten(args, is_leaf=is_chord)
    starts = structure.unflatten([leaf.a for leaf in leaves])
    traced, shape = jax.make_jaxpr(fn, return_shape=True)(*starts)
    results = _interpret(traced, leaves)
    whole = [r if is_chord(r) else constant(jnp.asarray(r)) for r in results]
    return jtu.tree_structure(shape).unflatten(whole)


def _still(value: Any) -> jax.Array:
    """No deviation."""
    return jnp.zeros(jnp.shape(value), _real(value))


def _real(value: Any) -> Any:
    """The type of a deviation: that of the value, or for integers and truth values the shortest."""
    dtype = jnp.result_type(value)
    return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.float32


def is_chord(value: Any) -> bool:
    return isinstance(value, Chord)


def largest(x: Chord, y: Chord) -> Chord:
    """max(x, y): only the one that is larger all along matters, where there is such a one."""
    return Chord(jnp.maximum(x.a, y.a), jnp.maximum(x.b, y.b), _either(x, y, x.a - y.a, x.b - y.b))


def smallest(x: Chord, y: Chord) -> Chord:
    """min(x, y)."""
    return Chord(jnp.minimum(x.a, y.a), jnp.minimum(x.b, y.b), _either(x, y, y.a - x.a, y.b - x.b))


def _either(x: Chord, y: Chord, d0: jax.Array, d1: jax.Array) -> jax.Array:
    """The deviation of the larger of two, x being ahead by d0 at the start and by d1 at the end."""
    doubt = x.dev + y.dev
    mixed = jnp.maximum(x.dev, y.dev) + _crossing(d0, d1)
    behind = jnp.where(jnp.maximum(d0, d1) <= -doubt, y.dev, mixed)
    return jnp.where(jnp.minimum(d0, d1) >= doubt, x.dev, behind)


def times(x: Chord, y: Chord) -> Chord:
    """x y."""
    bend = 0.25 * jnp.abs((x.b - x.a) * (y.b - y.a))
    ends = lambda q: jnp.maximum(jnp.abs(q.a), jnp.abs(q.b))  # noqa: E731
    dev = _safe(ends(x), y.dev) + _safe(ends(y), x.dev) + _safe(x.dev, y.dev) + bend
    return Chord(x.a * y.a, x.b * y.b, dev)


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


def _smooth(x: Chord, phi: Callable, slope: jax.Array, bend: jax.Array) -> Chord:
    """φ(x) with sup|φ′| = slope and sup|φ″| = bend over the range of x."""
    dev = _safe(slope, x.dev) + _safe(bend, (x.b - x.a) ** 2 / 8)
    return Chord(phi(x.a), phi(x.b), dev)


def _reciprocal(x: Chord) -> Chord:
    nearest = jnp.where(x.lowest > 0, x.lowest, jnp.where(x.highest < 0, -x.highest, 0.0))
    # A denominator that may vanish has no bound: infinity, not an error, for its entry alone.
    return _smooth(x, lambda v: 1.0 / v, 1.0 / nearest**2, 2.0 / nearest**3)


def _power(x: Chord, n: int) -> Chord:
    if n < 0:
        return _reciprocal(_power(x, -n))
    slope = n * x.largest ** max(n - 1, 0)
    bend = n * (n - 1) * x.largest ** max(n - 2, 0)
    return _smooth(x, lambda v: v**n, jnp.asarray(slope), jnp.asarray(bend))


def _power_of(given: list[Any], bind: Callable) -> Chord:
    """x^c or c^x with a fixed c."""
    x, c = given
    if is_chord(x):
        return _smooth(x, lambda v: bind(v, c), *power(x.lowest, x.highest, c))
    return _smooth(c, lambda v: bind(x, v), *exponential(c.lowest, c.highest, x))


def _remainder(given: list[Any], bind: Callable) -> Chord:
    """x − c trunc(x/c) with a fixed c: a line with the slope of x while the quotient stays."""
    x, c = given
    if not is_chord(x):
        raise NoEnclosure("rem by what moves")
    whole = lambda v: jnp.trunc(v / c)  # noqa: E731
    # Bounds on x that are sums are rounded, and a quotient at a whole number may be either.
    slack = jnp.where(x.dev == 0.0, 0.0, 2 * jnp.finfo(x.a.dtype).eps * x.largest)
    stays = whole(x.lowest - slack) == whole(x.highest + slack)
    stays = stays | ((x.a == x.b) & (x.dev == 0.0))
    jumps = jnp.inf if _below_parabola.get() else 2.0 * jnp.abs(c)
    dev = jnp.where(stays, x.dev, x.dev + jumps)
    return Chord(bind(x.a, c), bind(x.b, c), dev)


def _stairs(phi: Callable) -> Callable[[Chord], Chord]:
    """A monotone φ of finitely many values: over the step it stays between those at the extremes."""

    def rule(x: Chord) -> Chord:
        rise = phi(x.highest) - phi(x.lowest)
        if _below_parabola.get():
            rise = jnp.where(rise == 0.0, 0.0, jnp.inf)
        return Chord(phi(x.a), phi(x.b), rise)

    return rule


_UNARY: dict[str, Callable[[Chord], Chord]] = {
    "abs": lambda x: largest(x, Chord(-x.a, -x.b, x.dev)),
    "neg": lambda x: Chord(-x.a, -x.b, x.dev),
    "square": lambda x: _power(x, 2),
    "sign": _stairs(jnp.sign),
    "floor": _stairs(jnp.floor),
    "ceil": _stairs(jnp.ceil),
    "round": _stairs(jnp.round),
}
_KEEPING = {
    "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "transpose", "slice", "rev",
    "reduce_sum", "cumsum", "copy", "copy_p", "stop_gradient", "concatenate", "stack",
}  # fmt: skip
_COMPARE = {"lt", "le", "gt", "ge", "eq", "ne", "lt_to", "le_to", "eq_to"}
_ENTRYWISE = {
    "and", "or", "xor", "not", "add", "sub", "mul", "max", "min", "neg", "sign", "abs",
    "convert_element_type", "select_n", "clamp", "eq", "ne", "lt", "le", "gt", "ge",
}  # fmt: skip
_TABLES = {"dvax_constant_table", "dvax_linear_table", "dvax_cubic_table"}
_CUSTOM = {"custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"}


def _interpret(traced: ClosedJaxpr, inputs: list[Any]) -> list[Any]:
    return evaluate(traced, inputs, is_chord, _apply)


def _apply(eqn: Any, given: list[Any]) -> list[Any]:
    name = eqn.primitive.name
    if eqn.params.get("name") == "dvax_standing":
        # A box's lower bound: whether the box is empty is seen where the law is solved.
        shape = eqn.outvars[0].aval.shape
        return [Chord(*(jnp.broadcast_to(part, shape) for part in _lift(given[0])))]
    if eqn.params.get("name") in _TABLES:
        return [_table(eqn, given)]
    if eqn.params.get("name") == "dvax_evaluate":
        # Its quotients have no bound over most of a step, and another run has looked between samples.
        raise NoEnclosure("Solution.evaluate")
    if is_search(eqn) and not is_chord(given[0]):
        return [_search(eqn, *given)]
    if name in CALLS or name in _CUSTOM:
        for key in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
            inner = eqn.params.get(key)
            if isinstance(inner, Jaxpr):
                inner = ClosedJaxpr(inner, ())
            if isinstance(inner, ClosedJaxpr) and len(inner.jaxpr.invars) == len(given):
                return _interpret(inner, given)
        raise NoEnclosure(name)
    if name == "scan":
        return _unrolled(eqn, given)
    atoms = (*eqn.invars, *eqn.outvars)
    if any(jnp.issubdtype(atom.aval.dtype, jnp.complexfloating) for atom in atoms):
        raise NoEnclosure(name)

    def bind(*values: Any) -> jax.Array:
        return eqn.primitive.bind(*values, **eqn.params)

    if name == "select_n":
        return [_select(given, bind)]
    if name in ("gather", "dynamic_slice"):
        return [_take(given, bind)]
    if name in _COMPARE:
        return [_compare(_lift(given[0]), _lift(given[1]), bind)]
    if name in ("scatter", "scatter-add") and not is_chord(given[1]):
        # Linear in the array and in what is written into it.
        whole, new = _lift(given[0]), _lift(given[2])
        return [Chord(*(bind(p, given[1], q) for p, q in zip(whole, new, strict=True)))]
    if not all(jnp.issubdtype(atom.aval.dtype, jnp.floating) for atom in atoms):
        of_floats = any(jnp.issubdtype(atom.aval.dtype, jnp.floating) for atom in eqn.invars)
        if name == "convert_element_type" and of_floats:
            return [_whole(_lift(given[0]), bind)]
        if eqn.primitive.multiple_results or (of_floats and name not in _ENTRYWISE):
            raise NoEnclosure(name)
        return [_discrete(given, bind, entrywise=name in _ENTRYWISE)]
    if (
        len(given) == 2
        and not all(map(is_chord, given))
        and name in ("add", "add_any", "sub", "mul")
    ):
        return [_with_constant(name, given, bind)]
    if name == "convert_element_type" and _eps(eqn.outvars[0]) > _eps(eqn.invars[0]):
        raise NoEnclosure("rounding to a shorter type")
    x = [_lift(value) for value in given]
    if name == "split":
        return list(map(Chord, *(eqn.primitive.bind(part, **eqn.params) for part in x[0])))
    if name in _UNARY:
        return [_UNARY[name](x[0])]
    if name in BOUNDS:
        return [_smooth(x[0], bind, *BOUNDS[name](x[0].lowest, x[0].highest))]
    if name in ("pow", "rem") and not all(map(is_chord, given)):
        return [_power_of(given, bind) if name == "pow" else _remainder(given, bind)]
    if name == "integer_pow":
        return [_power(x[0], eqn.params["y"])]
    if name in ("add", "add_any"):
        return [Chord(bind(x[0].a, x[1].a), bind(x[0].b, x[1].b), bind(x[0].dev, x[1].dev))]
    if name == "sub":
        return [Chord(x[0].a - x[1].a, x[0].b - x[1].b, x[0].dev + x[1].dev)]
    if name == "mul":
        return [times(x[0], x[1])]
    if name == "div":
        if not is_chord(given[1]):
            return [_by_constant(x[0], given[1])]
        return [times(x[0], _reciprocal(x[1]))]
    if name == "max":
        return [largest(x[0], x[1])]
    if name == "min":
        return [smallest(x[0], x[1])]
    if name == "clamp":
        return [smallest(largest(x[1], x[0]), x[2])]
    if name == "convert_element_type" or name in _KEEPING:
        return [Chord(*(bind(*(v[i] for v in x)) for i in range(3)))]
    if name == "pad":
        edge, inner = x[1], jnp.zeros_like(x[0].dev)
        dev = jnp.maximum(bind(x[0].dev, jnp.zeros_like(edge.dev)), bind(inner, edge.dev))
        return [Chord(bind(x[0].a, edge.a), bind(x[0].b, edge.b), dev)]
    if name in _FOLDS:
        return [_folded(_FOLDS[name], x[0], eqn.params["axes"])]
    if name == "pow":
        # x^y = exp(y log x), for x > 0.
        power_of = times(x[1], _smooth(x[0], jnp.log, *BOUNDS["log"](x[0].lowest, x[0].highest)))
        found = _smooth(power_of, jnp.exp, *BOUNDS["exp"](power_of.lowest, power_of.highest))
        return [Chord(bind(x[0].a, x[1].a), bind(x[0].b, x[1].b), found.dev)]
    if name == "dot_general" and all(map(is_chord, given)):
        return [_product(x[0], x[1], bind)]
    if name == "dot_general" and not all(map(is_chord, given)):
        # A fixed matrix: deviations pass through its absolute values.
        sides = [
            v if is_chord(g) else Chord(g, g, jnp.abs(g)) for v, g in zip(x, given, strict=True)
        ]
        return [Chord(*(bind(sides[0][i], sides[1][i]) for i in range(3)))]
    raise NoEnclosure(name)


_FOLDS: dict[str, Callable[[Chord, Chord], Chord]] = {
    "reduce_max": largest, "reduce_min": smallest, "reduce_prod": times,
}  # fmt: skip


def _folded(join: Callable[[Chord, Chord], Chord], x: Chord, axes: tuple[int, ...]) -> Chord:
    """The join of all entries along the axes, two halves at a time."""
    for axis in sorted(axes, reverse=True):
        rows = [jnp.moveaxis(part, axis, 0) for part in x]
        while (count := rows[0].shape[0]) > 1:
            half = count // 2
            both = join(
                Chord(*(r[:half] for r in rows)), Chord(*(r[half : 2 * half] for r in rows))
            )
            # An odd one waits for the next turn.
            rows = [
                jnp.concatenate([part, r[2 * half :]]) for part, r in zip(both, rows, strict=True)
            ]
        if count == 0:
            raise NoEnclosure("a reduction of nothing")
        x = Chord(*(r[0] for r in rows))
    return x


def _product(x: Chord, y: Chord, bind: Callable) -> Chord:
    """A product of two arrays that move: the rule of `times`, summed."""
    ends = lambda q: jnp.maximum(jnp.abs(q.a), jnp.abs(q.b))  # noqa: E731
    dev = bind(ends(x), y.dev) + bind(x.dev, ends(y)) + bind(x.dev, y.dev)
    dev = dev + 0.25 * bind(jnp.abs(x.b - x.a), jnp.abs(y.b - y.a))
    # 0 · ∞ may stand for anything.
    return Chord(bind(x.a, y.a), bind(x.b, y.b), jnp.where(jnp.isnan(dev), jnp.inf, dev))


def _unrolled(eqn: Any, given: list[Any]) -> list[Any]:
    """A loop of few turns (`lax.scan`, `fori_loop` between fixed numbers), turn by turn."""
    params = eqn.params
    length, counts = params["length"], scan_counts(params)
    if length > _TURNS or length == 0 or counts is None:
        raise NoEnclosure("a loop of many turns")
    first = counts[0]
    second = first + counts[1]
    fixed, carry, rows = given[:first], given[first:second], given[second:]
    order = range(length - 1, -1, -1) if params["reverse"] else range(length)
    found: dict[int, list[Any]] = {}
    for k in order:
        row = [Chord(*(part[k] for part in v)) if is_chord(v) else v[k] for v in rows]
        out = _interpret(params["jaxpr"], [*fixed, *carry, *row])
        carry, found[k] = out[: len(carry)], out[len(carry) :]
    stacked = []
    for leaves in zip(*(found[k] for k in range(length)), strict=True):
        chords = [_lift(leaf) for leaf in leaves]
        stacked.append(Chord(*(jnp.stack([c[i] for c in chords]) for i in range(3))))
    return [*carry, *stacked]


_TURNS = 32
"""The most turns of a loop that is read."""


def _eps(atom: Any) -> float:
    return float(jnp.finfo(atom.aval.dtype).eps)


def _with_constant(name: str, given: list[Any], bind: Callable) -> Chord:
    """A sum or product with what does not move: nothing bends, and laws are mostly made of these."""
    first = is_chord(given[0])
    chord, c = (given[0], given[1]) if first else (given[1], given[0])
    a, b = (bind(chord.a, c), bind(chord.b, c)) if first else (bind(c, chord.a), bind(c, chord.b))
    if name != "mul":
        return Chord(a, b, jnp.broadcast_to(chord.dev, a.shape))
    if _is_plain(c, chord.dev.dtype):
        return Chord(a, b, abs(float(c)) * jnp.broadcast_to(chord.dev, a.shape))
    return Chord(a, b, _safe(jnp.abs(c), chord.dev))


def _by_constant(x: Chord, c: Any) -> Chord:
    """x/c."""
    dev = x.dev / jnp.abs(c)
    if not _is_plain(c, x.dev.dtype):
        # ∞/∞ may be anything, and so may 0/0, unless c is only small.
        dev = jnp.where(jnp.isnan(dev), jnp.where((x.dev == 0) & (c != 0), 0.0, jnp.inf), dev)
    return Chord(x.a / c, x.b / c, dev)


def _is_plain(c: Any, dtype: Any) -> bool:
    """Whether it is one number that is known, and neither infinite nor one that a product may take
    for zero."""
    known = isinstance(c, (float, int, np.generic, np.ndarray)) and np.ndim(c) == 0
    return known and bool(np.isfinite(c) & (np.abs(c) >= jnp.finfo(dtype).tiny))


def _lift(value: Any) -> Chord:
    return value if is_chord(value) else constant(jnp.asarray(value))


def _known(a: jax.Array, b: jax.Array, known: jax.Array) -> Chord:
    """A value that does not change where it is known, and may be anything where it is not."""
    dev = jnp.where(known, 0.0, jnp.inf).astype(_real(a))
    return Chord(a, b, jnp.broadcast_to(dev, jnp.shape(a)))


def _table(eqn: Any, given: list[Any]) -> Chord:
    """Values of a `dvax.signals.Table`: a constant, a line or a cubic between two of its times, and
    without a bound across one."""
    times, values, *slopes, t = given
    if any(map(is_chord, (times, values, *slopes))):
        raise NoEnclosure("a table that moves")
    a, b = (bound(eqn, [*given[:-1], end])[0] for end in (t.a, t.b))
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
    return Chord(a, b, jnp.broadcast_to(dev, a.shape).astype(a.dtype))


def _search(eqn: Any, row: Any, x: Chord) -> Chord:
    """The place of x in a sorted row: known where both of its bounds have the same."""
    place = lambda v: bound(eqn, [row, v])[0]  # noqa: E731
    sorted_row = jnp.all(row[1:] >= row[:-1])
    return _known(place(x.a), place(x.b), (place(x.lowest) == place(x.highest)) & sorted_row)


def _compare(x: Chord, y: Chord, bind: Callable) -> Chord:
    """A comparison, known where the difference keeps its sign all along."""
    a, b = bind(x.a, y.a), bind(x.b, y.b)
    dev = x.dev + y.dev
    margin = jnp.minimum(_apart(x.a, y.a), _apart(x.b, y.b))
    # A line that gives the same answer at both ends gives it in between; with a deviation, only
    # where it stays clear of zero.
    same_side = ((x.a < y.a) == (x.b < y.b)) & ((x.a > y.a) == (x.b > y.b))
    known = (a == b) & ((dev == 0) | ((margin > dev) & same_side))
    return _known(a, b, known)


def _apart(p: jax.Array, q: jax.Array) -> jax.Array:
    return jnp.abs(p.astype(_real(p)) - q.astype(_real(q)))


def _whole(x: Chord, bind: Callable) -> Chord:
    """The whole part of x, or whether x is not zero: known where both bounds have the same one."""
    same = bind(x.lowest) == bind(x.highest)
    # Truth changes at zero alone, and both bounds may differ from it on different sides.
    if bind(x.a).dtype == bool:
        same = same & ((x.lowest > 0) | (x.highest < 0) | ((x.a == x.b) & (x.dev == 0)))
    # Infinite bounds have no whole part.
    return _known(bind(x.a), bind(x.b), same & jnp.isfinite(x.dev))


def _discrete(given: list[Any], bind: Callable, entrywise: bool) -> Chord:
    """Integers and truth values: known where everything that enters stays as it is."""
    x = [_lift(value) for value in given]
    a, b = bind(*(v.a for v in x)), bind(*(v.b for v in x))
    settled = [jnp.all(v.dev == 0) & jnp.all(v.a == v.b) for v in x]
    known = jnp.all(jnp.stack(settled))
    if entrywise and all(np.shape(v.a) in ((), np.shape(a)) for v in x):
        each = [(v.dev == 0) & (v.a == v.b) for v in x]
        known = each[0]
        for more in each[1:]:
            known = known & more
    return _known(a, b, known)


def _select(given: list[Any], bind: Callable) -> Chord:
    which, cases = given[0], [_lift(case) for case in given[1:]]
    if not is_chord(which):
        return Chord(*(bind(which, *(case[i] for case in cases)) for i in range(3)))
    if not all(jnp.issubdtype(case.a.dtype, jnp.floating) for case in cases):
        return _discrete(given, bind, entrywise=True)
    a = bind(which.a, *(case.a for case in cases))
    b = bind(which.b, *(case.b for case in cases))
    settled = bind(which.a, *(case.dev for case in cases))
    # Where the choice may change on the way, the value is one of the cases at every moment.
    apart = [jnp.maximum(jnp.abs(case.a - a), jnp.abs(case.b - b)) + case.dev for case in cases]
    worst = apart[0]
    for more in apart[1:]:
        worst = jnp.maximum(worst, more)
    known = (which.dev == 0) & (which.a == which.b)
    if _below_parabola.get():
        worst = jnp.full_like(worst, jnp.inf)
    return Chord(a, b, jnp.where(known, settled, worst))


def _take(given: list[Any], bind: Callable) -> Chord:
    """Entries of an array at fixed places, or of a fixed array at places that stay as they are."""
    if not any(map(is_chord, given[1:])):
        return Chord(*(bind(part, *given[1:]) for part in given[0]))
    if is_chord(given[0]):
        raise NoEnclosure("gather from a moving array at moving places")
    places = [_lift(value) for value in given[1:]]
    a = bind(given[0], *(p.a for p in places))
    b = bind(given[0], *(p.b for p in places))
    settled = [jnp.all(p.dev == 0) & jnp.all(p.a == p.b) for p in places]
    known = jnp.all(jnp.stack(settled))
    if _below_parabola.get() or not jnp.issubdtype(a.dtype, jnp.floating):
        return _known(a, b, known)
    # Wherever they lead, the value is one of the array.
    apart = jnp.max(given[0]) - jnp.min(given[0])
    return Chord(a, b, jnp.broadcast_to(jnp.where(known, 0.0, apart), jnp.shape(a)))
