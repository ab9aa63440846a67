"""Intersections K₁ ∩ K₂ ∩ … of sets, from the projections onto each set."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from .abstract import AbstractSet

_MAX_DENSE_SIZE = 512
"""Number of unknowns up to which the derivative uses a dense pseudoinverse; beyond, CG."""
_FIRST_ROUND, _ROUND = 64, 8
"""Number of cycles in the first round, which ends with the solution near K, and in every other."""
_STRAIGHT = 0.9
"""Cosine of the angle between the changes of two rounds from which the next one starts ahead."""
_AHEAD, _SHORTER, _SHORTEST = 2.0, 16.0, 0.2
"""By how many changes a round starts ahead: the first number, divided by the second where a round is
discarded, and 0 from the last one down."""
_NOISE = 8.0
"""Multiple of the roundoff of D that counts as no growth."""
_MOST_ROUNDOFF = 16.0
"""Multiple of the tolerance up to which the roundoff of the yₖ leaves a solution credible."""
_NEARER = 1.0 + 1e-6
"""Ratio of two distances that counts as no growth."""


class _Cycle(NamedTuple):
    """x, the qₖ, the duality gap, the largest distance of a yₖ from x, the roundoff of the gap, whether
    x is the projection, and the number of cycles."""

    x: Tree
    q: tuple
    gap: jax.Array
    apart: jax.Array
    roundoff: jax.Array
    converged: jax.Array
    count: jax.Array


class _Round(NamedTuple):
    """The last cycle, the change of the qₖ in the last round, D(q), and by how many such changes the
    next round starts ahead."""

    at: _Cycle
    change: tuple
    value: jax.Array
    ahead: jax.Array


class Intersection(AbstractSet):
    """K = K₁ ∩ … ∩ Kₘ, projected by Dykstra's method (Boyle and Dykstra 1986).

    Cycle through the sets, yₖ = proj_Kₖ(x + qₖ), qₖ ← x + qₖ − yₖ, x ← yₖ. Throughout, z = x + Σ qₖ
    with qₖ normal to Kₖ at yₖ, and x → proj_K(z).

    The iteration stops when all yₖ agree with x to `tol` and the duality gap Σ ⟨qₖ, yₖ − x⟩ is at
    most tol² (both in the norm of the space, relative to ‖z − x‖ + ‖x‖). Every v ∈ K satisfies
    ⟨z − x, v − x⟩ ≤ gap, so x is the projection up to its distance from K. If the iteration has not
    converged after `max_cycles`, in particular if K is empty, the result is NaN. The method converges
    linearly for polyhedral sets and slowly for curved sets that touch; use `Polyhedron` for many
    linear conditions. Far from K, where z is many times the size of K away, the changes of q are
    extrapolated. The result has the digits that `tol` leaves of ‖z − x‖: at a distance of 10⁵ sizes
    of K, six of x; farther away it may be NaN.

    The derivative follows from these conditions by the implicit function theorem.

    **Arguments:** `sets`, two or more; `tol`; `max_cycles`.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.Intersection(dvax.sets.Box(0.0, jnp.inf), dvax.sets.Ball(0.0, 1.0))
    >>> K.project(jnp.array([-3.0, 2.0]), dvax.spaces.Euclidean(2)).tolist()
    [0.0, 1.0]

    ```
    """

    sets: tuple[AbstractSet, ...]
    tol: float = eqx.field(static=True)
    max_cycles: int = eqx.field(static=True)

    def __init__(self, *sets: AbstractSet, tol: float = 1e-11, max_cycles: int = 10_000):
        name = "dvax.sets.Intersection"
        _tree.check_tolerance(tol, f"{name}(tol)")
        if not isinstance(max_cycles, int | np.integer) or max_cycles < 1:
            rule, fix = "it must be a whole number > 0", "Omit it for the default"
            given = _tree.line(max_cycles)
            raise input_error(f"{name}(max_cycles)", given, rule, fix)
        self.sets, self.tol, self.max_cycles = sets, tol, max_cycles
        if not sets:
            raise input_error(
                "dvax.sets.Intersection",
                "no sets",
                "an intersection needs at least one set",
                "Use dvax.sets.WholeSpace() where there is no constraint",
            )
        example = "Intersection(dvax.sets.Box(0.0, 1.0), dvax.sets.Ball(0.0, 1.0))"
        _tree.check_parts(sets, AbstractSet, name, example)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        fixed = jtu.tree_map(lax.stop_gradient, (self.sets, z, space))

        def conditions(q: tuple) -> tuple:
            x = _subtract_all(z, q)
            pairs = zip(self.sets, q, strict=True)
            return tuple(_tree.sub(x, K.project(_tree.add(x, qk), space)) for K, qk in pairs)

        def find(_: Any, start: tuple) -> tuple:
            return start

        start, converged = self._dykstra(*fixed)
        q = lax.custom_root(conditions, start, find, _least_squares)
        x = _subtract_all(z, q)
        failed = jtu.tree_map(lambda leaf: jnp.full_like(leaf, jnp.nan), x)
        return _tree.where(converged, x, failed)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array] | None:
        """Return the distances from the bounds if K is a box, else None: Dykstra's method does not
        determine which sets are active."""
        bounds = self.intervals(z)
        if bounds is None:
            return None
        lower, upper = bounds
        gaps = _tree.sub(z, lower), _tree.sub(upper, z)
        return [gap for side in gaps for gap in jtu.tree_leaves(side)]

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        intervals = [K.intervals(like) for K in self.sets]
        boxes = [pair for pair in intervals if pair is not None]
        if len(boxes) < len(intervals):
            return None
        lower, upper = boxes[0]
        for low, up in boxes[1:]:
            lower = jtu.tree_map(jnp.maximum, lower, low)
            upper = jtu.tree_map(jnp.minimum, upper, up)
        # Disjoint intervals: an infinite lower bound stops a solve.
        empty = jtu.tree_map(jnp.greater, lower, upper)
        lower = jtu.tree_map(lambda is_empty, low: jnp.where(is_empty, jnp.inf, low), empty, lower)
        return lower, upper

    def check(self, like: Tree) -> None:
        for K in self.sets:
            K.check(like)
        ends = self.intervals(like)
        lower = () if ends is None else ends[0]
        _tree.require(
            lambda: all(bool(jnp.all(low < jnp.inf)) for low in jtu.tree_leaves(lower)),
            "dvax.sets.Intersection",
            lower,
            "the intervals of these sets must meet, or the intersection is empty",
            "Widen one of the intervals",
        )

    def _dykstra(self, sets: tuple, z: Tree, space: AbstractSpace) -> tuple[tuple, jax.Array]:
        """Return (the qₖ, whether the iteration converged).

        A cycle maximises the dual function D(q) = −½‖z − Σqₖ‖² − Σ⟨qₖ, yₖ⟩ in one qₖ after the other,
        and may start from any q. Far from K, many cycles in a row change q by the same. The cycles are
        therefore done by rounds, and a round starts ahead of q by twice the change of the last one for
        as long as D grows. Where D does not, the round is discarded, and the next one starts nearer to
        q.
        """

        def cycle(last: _Cycle) -> _Cycle:
            x, new_q, ys = last.x, [], []
            for K, qk in zip(sets, last.q, strict=True):
                sum_ = _tree.add(x, qk)
                x = K.project(sum_, space)
                new_q.append(_tree.sub(sum_, x))
                ys.append(x)
            differences = [_tree.sub(y, x) for y in ys]
            distances = [space.norm(difference) for difference in differences]
            gap = _inner(space, tuple(new_q), tuple(differences))
            size = space.norm(_tree.sub(z, x)) + space.norm(x)
            tol = self._tolerance(size)
            apart = jnp.max(jnp.stack(distances))
            # The roundoff of the yₖ is that of the qₖ. If K is empty, the qₖ grow until it hides how
            # far the yₖ are apart.
            norms = jnp.stack([space.norm(qk) for qk in new_q])
            roundoff = jnp.finfo(size.dtype).eps * jnp.sum(norms)
            converged = (apart <= tol) & (gap <= tol * tol + 4.0 * roundoff * size)
            converged &= roundoff <= _MOST_ROUNDOFF * tol
            return _Cycle(x, tuple(new_q), gap, apart, roundoff * size, converged, last.count + 1)

        def advance(state: _Round) -> _Round:
            start_q = jtu.tree_map(lambda a, b: a + state.ahead * b, state.at.q, state.change)
            start = state.at._replace(x=_subtract_all(z, start_q), q=start_q)
            most = jnp.where(state.at.count == 0, _FIRST_ROUND, state.at.count + _ROUND)
            most = jnp.minimum(most, self.max_cycles)
            end = lax.while_loop(
                lambda at: ~at.converged & (at.count < most) & _tree.all_finite(at.x), cycle, start
            )
            # Σ⟨qₖ, yₖ⟩ is the gap and ⟨z − x, x⟩.
            value = -0.5 * space.inner(end.x, end.x) - end.gap
            value -= space.inner(_tree.sub(z, end.x), end.x)
            gain, noise = value - state.value, _NOISE * end.roundoff
            # Where rounding hides whether D grows, the yₖ must not go away from each other.
            is_nearer = end.apart <= _NEARER * state.at.apart
            taken = (state.ahead == 0) | (gain > noise) | ((gain >= -noise) & is_nearer)
            change = _tree.sub(end.q, state.at.q)
            is_straight = _inner(space, change, state.change) > _STRAIGHT * jnp.sqrt(
                _inner(space, change, change) * _inner(space, state.change, state.change)
            )
            result = _Round(end, change, value, jnp.where(is_straight, _AHEAD, 0.0))
            nearer = jnp.where(state.ahead > _SHORTEST, state.ahead / _SHORTER, 0.0)
            kept = state._replace(at=state.at._replace(count=end.count), ahead=nearer)
            return _tree.where(taken | end.converged, result, kept)

        def unfinished(state: _Round) -> jax.Array:
            at = state.at
            return ~at.converged & (at.count < self.max_cycles) & _tree.all_finite(at.x)

        q = (_tree.zeros_like(z),) * len(sets)
        zero = jnp.zeros_like(space.inner(z, z))
        start = _Cycle(z, q, zero, zero, zero, jnp.asarray(False), jnp.asarray(0))
        end = lax.while_loop(unfinished, advance, _Round(start, q, zero, zero)).at
        return end.q, end.converged

    def _tolerance(self, size: jax.Array) -> jax.Array:
        return jnp.maximum(self.tol, 8.0 * jnp.finfo(size.dtype).eps).astype(size.dtype) * size


def _subtract_all(z: Tree, q: tuple) -> Tree:
    """Return z − Σ qₖ."""
    for qk in q:
        z = _tree.sub(z, qk)
    return z


def _inner(space: AbstractSpace, a: tuple, b: tuple) -> Any:
    """Return Σ⟨aₖ, bₖ⟩."""
    return sum(space.inner(ak, bk) for ak, bk in zip(a, b, strict=True))


def _least_squares(g: Any, b: Tree) -> Tree:
    """Return a solution q of g(q) = b. The qₖ need not be unique; x does not depend on the choice."""
    flat, unflatten = jax.flatten_util.ravel_pytree(b)

    def flat_g(v: jax.Array) -> jax.Array:
        return jax.flatten_util.ravel_pytree(g(unflatten(v)))[0]

    if flat.size <= _MAX_DENSE_SIZE:
        matrix = jax.jacfwd(flat_g)(jnp.zeros_like(flat))
        rtol = float(jnp.finfo(flat.dtype).eps) ** 0.5  # no array: `pinv` keeps what it is given
        return unflatten(jnp.linalg.pinv(matrix, rtol=rtol) @ flat)
    transposed = jax.linear_transpose(flat_g, flat)

    def back(v: jax.Array) -> jax.Array:
        return transposed(v)[0]

    solution, _ = jax.scipy.sparse.linalg.cg(
        lambda v: back(flat_g(v)), back(flat), tol=1e-12, atol=0.0, maxiter=10 * flat.size
    )
    return unflatten(solution)
