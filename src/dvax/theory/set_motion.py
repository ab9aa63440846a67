"""Bounds on the data over time: position and speed of K(t), values and jumps of f and h."""

import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._tree import Tree
from ..errors import InputError
from ..problem import Problem
from ..programs.slope import Slope, SlopeEnclosure, TooLarge, Values, interval, is_slope
from ..programs.structure import independent
from ..sets import AbstractSet
from ..sets._motion import describe, rejects_empty
from .projection_speed import is_fixed, slopes, speed_of
from .set_bounds import bounds_of_fixed_set
from .system import System

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
    bounds = None if isinstance(like, tuple) else bounds_of_fixed_set(first, like)
    if is_constant and bounds is not None:
        return SetMotion(0.0, *bounds, empty is None and rejects_empty(first), empty)
    if describe(first, first, like, system.control) is None:
        is_nonempty = is_constant and empty is None and rejects_empty(first)
        return SetMotion(0.0 if is_constant else np.inf, *no_bounds, is_nonempty, empty)

    def described(t: Any) -> Any:
        return describe(problem.set_at(t, args), first, like, system.control)

    # An empty box, which the union with the bounds of every piece enlarges.
    (high, low), fastest, is_nonempty = no_bounds, 0.0, True
    try:
        enclosure = SlopeEnclosure(described, (jnp.zeros(()),), (0,))
        for piece in [interval(t0, t1)] if is_constant else times(t0, t1, knots):
            now = enclosure(piece).out
            low, high = _minimum(low, now.low), _maximum(high, now.high)
            fastest = max(fastest, speed_of(now.motion))
            is_nonempty &= is_fixed(now.motion)
            is_nonempty &= all(bool((v.low >= 0).all()) for v in slopes(now.gaps))
    except TooLarge:
        return SetMotion(np.inf, *no_bounds, False, empty)
    return SetMotion(fastest, low, high, is_nonempty and empty is None, empty)


def does_not_move(problem: Problem, t: float, args: Any) -> bool:
    """Return whether K is a set, or a function whose code proves that it does not depend on t."""
    if isinstance(problem.K, AbstractSet):
        return True

    def numbers(t: Any) -> list[Any]:
        return jtu.tree_leaves(problem.set_at(t, args))

    # A function in a set may use t, which its code does not show.
    known = all(map(eqx.is_array_like, numbers(jnp.asarray(t))))
    return known and independent(numbers, jnp.asarray(t))


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
