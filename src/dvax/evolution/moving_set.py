"""How K(t) moves over a step, by its data: bounds, totals, centers.

Let the data be lines between their values at the ends, up to a deviation, and let K'(θ) be the set of
the lines. For every z, the projection of z onto K'(θ) moves by at most `change` over the step, and it
is within `deviation` of that onto K(t) (`dvax.sets._motion`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..problem import Problem
from ..programs.enclosure import LinearEnclosure, NoEnclosure, enclose
from ..programs.structure import between_knots, independent
from ..sets._library import is_of_library
from ..sets._motion import Entries, Fixed, Independent, Sum, Unbounded, describe
from ..spaces import AbstractSpace


class Motion(NamedTuple):
    """The `change` and the `deviation` of projections over a step."""

    change: jax.Array
    deviation: jax.Array


def motion(
    problem: Problem, args: Any, t: LinearEnclosure, like: Tree, space: AbstractSpace
) -> Motion:
    """Return how K(t) moves over a step, with elements shaped like `like`.

    **Raises:** `NoEnclosure` if K is a set without a rule, or its data use an operation without one.
    """
    zero = jnp.zeros((), _tree.dtype(like))
    K = problem.set_at(t.a, args)
    # The bounds of another box are traced, but another set may hold a function that uses t.
    if K.intervals(like) is None:
        if not is_of_library(K):
            raise NoEnclosure("a set of your own")
        if _is_fixed(problem, args, t.a):
            return Motion(zero, zero)
        if describe(K, None, like, space) is None:
            raise NoEnclosure("a set that moves")

    def data(t: Any) -> Any:
        found = describe(problem.set_at(t, args), None, like, space)
        assert found is not None
        return found.motion

    found = enclose(data, t)
    change, deviation = (_distance(found, part, zero) for part in (_change, _deviation))
    return Motion(change.astype(zero.dtype), deviation.astype(zero.dtype))


def has_bounded_motion(
    problem: Problem, args: Any, t: Any, like: Tree, space: AbstractSpace
) -> bool:
    """Return whether the code of K proves that `motion` is finite where the data of K are smooth.

    A matrix, a normal or a factor must not move, and tables must have the argument t, or their knots
    are not known. Rows that share unknowns have a bound only if their limits are lines between
    knots."""
    K = problem.set_at(t, args)
    if K.intervals(like) is not None:
        return True
    if not is_of_library(K):
        return False
    if _is_fixed(problem, args, t):
        return True
    if describe(K, None, like, space) is None:
        return False

    def arrays(kind: Any) -> Callable[[Any], list[Any]]:
        def of(t: Any) -> list[Any]:
            found = describe(problem.set_at(t, args), None, like, space)
            assert found is not None
            return _arrays(found.motion, kind)

        return of

    return (
        independent(arrays(Fixed), t)
        and between_knots(arrays(Entries), t).knows_knots
        and all(between_knots(arrays(Unbounded), t))
    )


def _is_fixed(problem: Problem, args: Any, t: Any) -> bool:
    return independent(lambda t: jtu.tree_leaves(problem.set_at(t, args)), t)


def _arrays(motion: Any, kind: Any) -> list[Any]:
    """Return the data of this kind."""
    if isinstance(motion, Sum | Independent):
        return [v for part in motion.parts for v in _arrays(part, kind)]
    return list(motion.arrays) if isinstance(motion, kind) else []


def _distance(motion: Any, part: Any, zero: jax.Array) -> jax.Array:
    """Return a bound on the distance of two projections, for one `part` of the enclosures of data."""
    if isinstance(motion, Entries):
        moved = jnp.max(jnp.stack([part(q) for q in motion.arrays]), axis=0)
        gain = motion.gain.largest
        if gain.ndim == 2:
            moved = moved[None]
        of_entries = jnp.where(moved > 0.0, gain * moved, 0.0)
        if gain.ndim == 2:
            of_entries = jnp.sum(of_entries, axis=1)
        return jnp.sqrt(jnp.sum(jnp.square(of_entries)))
    if isinstance(motion, Sum):
        return sum((_distance(v, part, zero) for v in motion.parts), zero)
    if isinstance(motion, Independent):
        return jnp.sqrt(sum((_distance(v, part, zero) ** 2 for v in motion.parts), zero))
    # What must not move does not. What has no bound may move along lines, by an unknown distance.
    both = (part,) if isinstance(motion, Unbounded) else (_change, _deviation)
    moves = [jnp.any(size(q) > 0.0) for q in motion.arrays for size in both]
    return jnp.where(jnp.any(jnp.stack(moves)), jnp.inf, zero) if moves else zero


def _change(q: LinearEnclosure) -> jax.Array:
    return _where_finite(q, jnp.abs(q.b - q.a))


def _deviation(q: LinearEnclosure) -> jax.Array:
    return _where_finite(q, q.dev)


def _where_finite(q: LinearEnclosure, value: jax.Array) -> jax.Array:
    """Return the value, 0 for a bound that is infinite all the time."""
    return jnp.where((q.a == q.b) & jnp.isinf(q.a), 0.0, value)
