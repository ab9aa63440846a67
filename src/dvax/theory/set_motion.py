"""Bounds on the data over time: position and speed of K(t), values and jumps of f and h."""

import itertools
import operator
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError
from ..problem import Problem
from ..programs.slope import Slope, SlopeEnclosure, TooLarge, Values, interval, is_slope
from ..programs.structure import independent
from ..sets import AbstractSet, Ball, ConstrainedBox, Intersection, L1Ball, Simplex
from ..spaces import AbstractSpace
from .set_bounds import bounds_of_fixed_set
from .system import System
from .weights import roots

_PIECES = 64
_MAX_KNOTS = 200


class SetMotion(NamedTuple):
    """K(t) for t0 ≤ t ≤ t1.

    - `speed`: ‖proj_{K(s)}z − proj_{K(t)}z‖ ≤ speed |s − t| for every z, between knots; ∞ if unknown;
    - `low`, `high`: bounds of y ∈ K(t), entry by entry, infinite where there are none;
    - `is_nonempty`: whether every K(t) is proved nonempty;
    - `empty_at`: a time at which K(t) is empty, or None.
    """

    speed: float
    low: Tree
    high: Tree
    is_nonempty: bool
    empty_at: float | None


def times(t0: float, t1: float, knots: np.ndarray, pieces: int = _PIECES) -> Iterator[Slope]:
    """Yield closed pieces of [t0, t1] that end at the knots, unless there are too many knots.

    As the pieces are closed, the two beside a jump have no finite speed.
    """
    inner = knots[(knots > t0) & (knots < t1)] if knots.size <= _MAX_KNOTS else np.zeros(0)
    ends = np.concatenate([[t0], inner, [t1]])
    subdivisions = max(1, pieces // (len(ends) - 1))
    for a, b in itertools.pairwise(ends):
        for begin, end in itertools.pairwise(np.linspace(a, b, subdivisions + 1)):
            yield interval(begin, end)


def set_motion(system: System, t0: float, t1: float, knots: Values) -> SetMotion:
    """Return bounds and speed of K(t) over [t0, t1]."""
    problem, like, args = system.problem, system.u0, system.args
    no_bounds = _infinite_bounds(like)
    first = problem.set_at(jnp.asarray(t0), args)
    is_constant = does_not_move(problem, t0, args)
    empty = _empty_at(system, np.array([t0]) if is_constant else _samples(t0, t1, knots))
    if _describe(first, like, system.control) is None:
        # The shape of the set is unknown. A constant set was checked when it was constructed.
        if not is_constant:
            pieces = times(t0, t1, knots)
            bounds = None
            if isinstance(first, ConstrainedBox | L1Ball) and not isinstance(like, tuple):
                bounds = _bounds_of_moving_set(lambda t: problem.set_at(t, args), like, pieces)
            return SetMotion(np.inf, *(bounds or no_bounds), False, empty)
        bounds = None if isinstance(like, tuple) else bounds_of_fixed_set(first, like)
        is_nonempty = empty is None and _rejects_empty(first)
        return SetMotion(0.0, *(bounds or no_bounds), is_nonempty, empty)

    def described(t: Any) -> Any:
        description = _describe(problem.set_at(t, args), like, system.control)
        assert description is not None
        return description

    # An empty box, which the union with the bounds of every piece enlarges.
    (high, low), speed, is_nonempty = no_bounds, 0.0, True
    try:
        enclosure = SlopeEnclosure(described, (jnp.zeros(()),), (0,))
        for piece in [interval(t0, t1)] if is_constant else times(t0, t1, knots):
            (lower, upper, motion, gap), _ = enclosure(piece)
            low, high = _minimum(low, lower), _maximum(high, upper)
            speed = max(speed, _speed(motion, system.control, like))
            is_nonempty &= all(bool((v.low >= 0).all()) for v in slopes(gap))
    except TooLarge:
        return SetMotion(np.inf, *no_bounds, False, empty)
    return SetMotion(speed, low, high, is_nonempty and empty is None, empty)


def does_not_move(problem: Problem, t: float, args: Any) -> bool:
    """Return whether K is a set, or a function whose code proves that it does not depend on t."""
    if isinstance(problem.K, AbstractSet):
        return True

    def numbers(t: Any) -> list[Any]:
        return jtu.tree_leaves(problem.set_at(t, args))

    # A function in a set may use t, which its code does not show.
    known = all(map(eqx.is_array_like, numbers(jnp.asarray(t))))
    return known and independent(numbers, jnp.asarray(t))


def _bounds_of_moving_set(
    K: Callable[[Any], AbstractSet], like: Tree, pieces: Iterable[Slope]
) -> tuple[Values, Values]:
    """Return bounds of all K(t), from those that K(t) has entry by entry."""

    def bounds(t: Any) -> list[Any]:
        now = K(t)
        assert isinstance(now, ConstrainedBox | L1Ball)
        ends = (now.lower, now.upper) if isinstance(now, ConstrainedBox) else (
            now.center - now.radius, now.center + now.radius
        )  # fmt: skip
        return [jnp.broadcast_to(end, jnp.shape(like)) for end in ends]

    enclosure = SlopeEnclosure(bounds, (jnp.zeros(()),), ())
    found = [enclosure(piece).out for piece in pieces]
    low = np.minimum.reduce([ends[0].low for ends in found])
    return low, np.maximum.reduce([ends[1].high for ends in found])


def _rejects_empty(K: AbstractSet) -> bool:
    """Return whether the constructor of this set raises an error for an empty set."""
    parts = [v for v in vars(K).values() if isinstance(v, AbstractSet)]
    for group in vars(K).values():
        if isinstance(group, tuple):
            parts += [v for v in group if isinstance(v, AbstractSet)]
    is_library_set = type(K).__module__.startswith("dvax.sets.")
    return is_library_set and not isinstance(K, Intersection) and all(map(_rejects_empty, parts))


def _describe(
    K: AbstractSet, like: Tree, space: AbstractSpace
) -> tuple[Tree, Tree, Tree, Tree] | None:
    """Return (low, high) of a box around K, the data that move its projection, and gaps that are ≥ 0 if
    and only if K is not empty; None for a set without a rule here."""
    bounds = K.intervals(like)
    if bounds is not None:
        low, high = bounds
        return (
            low,
            high,
            _MaximumSpeed(low, high),
            jtu.tree_map(partial(_tree.prepare, operator.sub), high, low),
        )
    if isinstance(K, Ball) and not isinstance(like, tuple):
        reach = K.radius / jnp.sqrt(jnp.broadcast_to(space.weights(), like.shape))
        center = jnp.broadcast_to(K.center, like.shape)
        return center - reach, center + reach, _SumOfSpeeds(center, (K.radius,)), K.radius
    if isinstance(K, Simplex) and not isinstance(like, tuple) and K.blocks is None:
        total = jnp.broadcast_to(K.total[..., None], like.shape)
        heaviest = jnp.sqrt(jnp.max(space.weights()))
        # One total for each simplex, where they share it.
        totals = jnp.broadcast_to(K.total, like.shape[:-1])
        motion = _SumOfSpeeds(jnp.zeros_like(like), (heaviest * totals,))
        return jnp.zeros_like(like), total, motion, K.total
    return None


class _MaximumSpeed(NamedTuple):
    """The speed of the projection is at most the larger speed of the two, entry by entry."""

    low: Tree
    high: Tree


class _SumOfSpeeds(NamedTuple):
    """The speed of the projection is at most the sum of the speeds of the element and of each array of
    numbers, in their norms."""

    element: Tree
    numbers: tuple[Any, ...]


def _speed(motion: Any, space: AbstractSpace, like: Tree) -> float:
    if isinstance(motion, _MaximumSpeed):
        pairs = zip(slopes(motion.low), slopes(motion.high), strict=True)
        entries = [np.maximum(_entry_speed(a), _entry_speed(b)) for a, b in pairs]
        number_speed = 0.0
    else:
        entries = [_entry_speed(v) for v in slopes(motion.element)]
        number_speed = sum(float(np.linalg.norm(_entry_speed(v))) for v in slopes(motion.numbers))
    scales = [r.reshape(v.shape) for r, v in zip(roots(space, like), jtu.tree_leaves(like))]
    squares = (np.sum((r * e) ** 2) for r, e in zip(scales, entries, strict=True))
    return float(np.sqrt(sum(squares))) + number_speed


def _entry_speed(x: Slope) -> Values:
    """Return a bound on the speed of each entry; a bound at infinity has speed 0."""
    part = x.parts.get(0)
    if part is None:
        return np.zeros(x.low.shape)
    speed = (np.abs(part.center) + part.radius).reshape(x.low.shape)
    return np.where((x.low == x.high) & np.isinf(x.low), 0.0, speed)


def _empty_at(system: System, samples: Values) -> float | None:
    """Return a sampled time at which K(t) rejects its data as empty, or None."""
    for t in samples:
        try:
            system.problem.set_at(jnp.asarray(t), system.args).check(system.u0)
        except InputError:
            return float(t)
    return None


def _samples(t0: float, t1: float, knots: Values) -> Values:
    return np.unique(np.concatenate([np.linspace(t0, t1, 17), knots[:_MAX_KNOTS]]))


def bounded_in_time(fn: Callable[[Any], Tree], t0: float, t1: float, knots: Values) -> bool:
    """Return whether the code of fn shows that it is bounded on [t0, t1]."""
    enclosure = SlopeEnclosure(fn, (jnp.zeros(()),), ())
    values = (x for piece in times(t0, t1, knots) for x in slopes(enclosure(piece).out))
    return all(bool(np.isfinite(x.low).all() and np.isfinite(x.high).all()) for x in values)


def jumps(
    fn: Callable[[Any], Tree], knots: np.ndarray, span: tuple[float, float]
) -> tuple[float, float] | None:
    """Return the knot with the largest jump of fn(t) and its height, or None if there is no jump.

    A difference that decreases with the distance to the knot is a slope and not a jump.
    """
    knots = knots[:_MAX_KNOTS]
    if knots.size == 0:
        return None
    near = 64 * np.finfo(float).eps * np.maximum(np.abs(knots), span[1] - span[0])
    samples = knots[:, None] + near[:, None] * np.array([-16.0, -1.0, 1.0, 16.0])
    leaves = jtu.tree_leaves(jax.jit(jax.vmap(fn))(jnp.asarray(samples.ravel())))
    # A quarter of the values: differences and sums of numbers near 1e308 overflow.
    values = [0.25 * np.asarray(leaf).reshape(knots.size, 4, -1) for leaf in leaves]
    far_left, left, right, far_right = np.moveaxis(np.concatenate(values, axis=2), 1, 0)
    gap, wide_gap = (_row_maxima(p - q) for p, q in ((right, left), (far_right, far_left)))
    scale = _row_maxima(np.abs(right) + np.abs(left))
    height = np.where((gap > 1e-9 * scale) & (gap > 0.5 * wide_gap), gap, 0.0)
    worst = int(np.argmax(height))
    return (float(knots[worst]), 4.0 * float(gap[worst])) if height[worst] > 0.0 else None


def _row_maxima(rows: Values) -> Values:
    return np.max(np.abs(rows), axis=1, initial=0.0)


def _infinite_bounds(like: Tree) -> tuple[Tree, Tree]:
    low = jtu.tree_map(lambda leaf: np.full(leaf.shape, -np.inf), like)
    return low, jtu.tree_map(np.negative, low)


def _minimum(a: Tree, b: Tree) -> Tree:
    return jtu.tree_map(lambda s, v: np.minimum(v, s.low), b, a, is_leaf=is_slope)


def _maximum(a: Tree, b: Tree) -> Tree:
    return jtu.tree_map(lambda s, v: np.maximum(v, s.high), b, a, is_leaf=is_slope)


def slopes(tree: Tree) -> list[Slope]:
    """Return the leaves of a tree of slopes."""
    return jtu.tree_leaves(tree, is_leaf=is_slope)
