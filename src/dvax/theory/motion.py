"""How the data moves in time: K(t) with its hull and speed, and the values of f and h."""

import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._tree import Tree
from ..errors import InputError
from ..programs.slope import Slope, SlopeEnclosure, TooLarge, Values, interval, is_slope
from ..sets import AbstractSet, Ball, Intersection, Simplex
from ..spaces import AbstractSpace
from .system import System
from .weights import roots

_PIECES = 64
MOST_KNOTS = 200


class Motion(NamedTuple):
    """K(t) for t0 ≤ t ≤ t1.

    `speed`: ‖proj_{K(s)}z − proj_{K(t)}z‖ ≤ speed |s − t| for every z, between knots; ∞ where that is
    not known. `low`, `high`: bounds of y ∈ K(t), entry by entry, infinite where there are none.
    `standing`: that no K(t) is empty is proved. `empty_at`: a time at which it is, or None.
    """

    speed: float
    low: Tree
    high: Tree
    standing: bool
    empty_at: float | None


def times(t0: float, t1: float, knots: np.ndarray, pieces: int = _PIECES) -> Iterator[Slope]:
    """[t0, t1] in pieces that begin and end where data bends, as far as there are not too many. They
    are closed, so that data which jumps at a knot has no speed in the pieces beside it."""
    inner = knots[(knots > t0) & (knots < t1)] if knots.size <= MOST_KNOTS else np.zeros(0)
    ends = np.concatenate([[t0], inner, [t1]])
    each = max(1, pieces // (len(ends) - 1))
    for a, b in itertools.pairwise(ends):
        for begin, end in itertools.pairwise(np.linspace(a, b, each + 1)):
            yield interval(begin, end)


def motion(system: System, t0: float, t1: float, knots: Values) -> Motion:
    """What is known of K(t) over [t0, t1]."""
    problem, like, args = system.problem, system.u0, system.args
    free = _free(like)
    first = problem.set_at(jnp.asarray(t0), args)
    still = isinstance(problem.K, AbstractSet)
    empty = _empty_at(system, np.array([t0]) if still else _samples(t0, t1, knots))
    if _describe(first, like, system.control) is None:
        # Nothing is known of its shape; of one that stands still, that it was made as a set.
        sure = still and empty is None and _checked(first)
        return Motion(0.0 if still else np.inf, *free, sure, empty)

    def described(t: Any) -> Any:
        found = _describe(problem.set_at(t, args), like, system.control)
        assert found is not None
        return found

    low, high, speed, standing = free[1], free[0], 0.0, True
    try:
        enclosure = SlopeEnclosure(described, (jnp.zeros(()),), (0,))
        for piece in [interval(t0, t1)] if still else times(t0, t1, knots):
            (down, up, moves, gap), _ = enclosure(piece)
            low, high = _least(low, down), _most(high, up)
            speed = max(speed, _speed(moves, system.control, like))
            standing &= all(bool((v.low >= 0).all()) for v in slopes(gap))
    except TooLarge:
        return Motion(np.inf, *free, False, empty)
    return Motion(speed, low, high, standing and empty is None, empty)


def _checked(K: AbstractSet) -> bool:
    """Whether a set of this kind refuses to be made where it is empty."""
    held = [v for v in vars(K).values() if isinstance(v, AbstractSet)]
    for group in vars(K).values():
        held += [v for v in group if isinstance(v, AbstractSet)] if isinstance(group, tuple) else []
    ours = type(K).__module__.startswith("dvax.sets.")
    return ours and not isinstance(K, Intersection) and all(map(_checked, held))


def _describe(
    K: AbstractSet, like: Tree, space: AbstractSpace
) -> tuple[Tree, Tree, Tree, Tree] | None:
    """(low, high) of a box around K, what its projection moves by, and gaps that are ≥ 0 where K is not
    empty; None for a set whose shape is not known here."""
    bounds = K.intervals(like)
    if bounds is not None:
        low, high = bounds
        return low, high, _Either(low, high), jtu.tree_map(jnp.subtract, high, low)
    if isinstance(K, Ball) and not isinstance(like, tuple):
        reach = K.radius / jnp.sqrt(jnp.broadcast_to(space.weights(), like.shape))
        center = jnp.broadcast_to(K.center, like.shape)
        return center - reach, center + reach, _Sum(center, (K.radius,)), K.radius
    if isinstance(K, Simplex) and not isinstance(like, tuple) and K.blocks is None:
        total = jnp.broadcast_to(K.total[..., None], like.shape)
        heaviest = jnp.sqrt(jnp.max(space.weights()))
        moves = _Sum(jnp.zeros_like(like), (heaviest * K.total,))
        return jnp.zeros_like(like), total, moves, K.total
    return None


class _Either(NamedTuple):
    """The projection moves no faster than the faster of the two, entry by entry."""

    low: Tree
    high: Tree


class _Sum(NamedTuple):
    """The projection moves no faster than the element and the numbers together."""

    element: Tree
    numbers: tuple[Any, ...]


def _speed(moves: Any, space: AbstractSpace, like: Tree) -> float:
    if isinstance(moves, _Either):
        pairs = zip(slopes(moves.low), slopes(moves.high), strict=True)
        entries, further = [np.maximum(_fastest(a), _fastest(b)) for a, b in pairs], 0.0
    else:
        entries = [_fastest(v) for v in slopes(moves.element)]
        further = sum(float(np.sum(_fastest(v))) for v in slopes(moves.numbers))
    scales = [r.reshape(v.shape) for r, v in zip(roots(space, like), jtu.tree_leaves(like))]
    squares = (np.sum((r * e) ** 2) for r, e in zip(scales, entries, strict=True))
    return float(np.sqrt(sum(squares))) + further


def _fastest(x: Slope) -> Values:
    """How fast it moves at most, entry by entry; a bound at infinity does not move."""
    part = x.parts.get(0)
    if part is None:
        return np.zeros(x.low.shape)
    speed = (np.abs(part.center) + part.radius).reshape(x.low.shape)
    return np.where((x.low == x.high) & np.isinf(x.low), 0.0, speed)


def _empty_at(system: System, samples: Values) -> float | None:
    """A time at which K says of itself that it is empty."""
    for t in samples:
        try:
            system.problem.set_at(jnp.asarray(t), system.args).check(system.u0)
        except InputError:
            return float(t)
    return None


def _samples(t0: float, t1: float, knots: Values) -> Values:
    return np.unique(np.concatenate([np.linspace(t0, t1, 17), knots[:MOST_KNOTS]]))


def bounded_in_time(fn: Callable[[Any], Tree], t0: float, t1: float, knots: Values) -> bool:
    """Whether fn's code shows that it is bounded on [t0, t1]."""
    enclosure = SlopeEnclosure(fn, (jnp.zeros(()),), ())
    values = (x for piece in times(t0, t1, knots) for x in slopes(enclosure(piece).out))
    return all(bool(np.isfinite(x.low).all() and np.isfinite(x.high).all()) for x in values)


def jumps(
    fn: Callable[[Any], Tree], knots: np.ndarray, span: tuple[float, float]
) -> tuple[float, float] | None:
    """The knot at which fn(t) jumps most, and by how much; None where it does not. What shrinks with
    the distance to the knot is a slope."""
    knots = knots[:MOST_KNOTS]
    if knots.size == 0:
        return None
    near = 64 * np.finfo(float).eps * np.maximum(np.abs(knots), span[1] - span[0])
    beside = knots[:, None] + near[:, None] * np.array([-16.0, -1.0, 1.0, 16.0])
    leaves = jtu.tree_leaves(jax.vmap(fn)(jnp.asarray(beside.ravel())))
    rows = [np.asarray(leaf).reshape(knots.size, 4, -1) for leaf in leaves]
    outer, before, after, further = np.moveaxis(np.concatenate(rows, axis=2), 1, 0)
    gap, wide = (_largest(p - q) for p, q in ((after, before), (further, outer)))
    scale = _largest(np.abs(after) + np.abs(before))
    height = np.where((gap > 1e-9 * scale) & (gap > 0.5 * wide), gap, 0.0)
    worst = int(np.argmax(height))
    return (float(knots[worst]), float(gap[worst])) if height[worst] > 0.0 else None


def _largest(rows: Values) -> Values:
    return np.max(np.abs(rows), axis=1, initial=0.0)


def _free(like: Tree) -> tuple[Tree, Tree]:
    end = lambda v: jtu.tree_map(lambda leaf: np.full(leaf.shape, v), like)  # noqa: E731
    return end(-np.inf), end(np.inf)


def _least(a: Tree, b: Tree) -> Tree:
    return jtu.tree_map(lambda s, v: np.minimum(v, s.low), b, a, is_leaf=is_slope)


def _most(a: Tree, b: Tree) -> Tree:
    return jtu.tree_map(lambda s, v: np.maximum(v, s.high), b, a, is_leaf=is_slope)


def slopes(tree: Tree) -> list[Slope]:
    return jtu.tree_leaves(tree, is_leaf=is_slope)
