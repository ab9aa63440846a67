"""Intersections K₁ ∩ K₂ ∩ … of sets, from the projections onto each set."""

from typing import Any

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


class Intersection(AbstractSet):
    """K = K₁ ∩ … ∩ Kₘ, projected by Dykstra's method (Boyle and Dykstra 1986).

    Cycle through the sets, yₖ = proj_Kₖ(x + qₖ), qₖ ← x + qₖ − yₖ, x ← yₖ. Throughout, z = x + Σ qₖ
    with qₖ normal to Kₖ at yₖ, and x → proj_K(z).

    The iteration stops when all yₖ agree with x to `tol` and the duality gap Σ ⟨qₖ, yₖ − x⟩ is at
    most tol² (both in the norm of the space, relative to ‖z − x‖ + ‖x‖). Every v ∈ K satisfies
    ⟨z − x, v − x⟩ ≤ gap, so x is the projection up to its distance from K. If the iteration has not
    converged after `max_cycles`, in particular if K is empty, the result is NaN. The method converges
    linearly for polyhedral sets and slowly for curved sets that touch; use `Polyhedron` for many
    linear conditions.

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
        """Return None: Dykstra's method does not determine which sets are active."""
        return None

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
        """Return (the qₖ, whether the iteration converged)."""
        zero = _tree.zeros_like(z)

        def cycle(state: tuple) -> tuple:
            x, q, _, count = state
            new_q, ys = [], []
            for K, qk in zip(sets, q, strict=True):
                sum_ = _tree.add(x, qk)
                x = K.project(sum_, space)
                new_q.append(_tree.sub(sum_, x))
                ys.append(x)
            differences = [_tree.sub(y, x) for y in ys]
            distances = [space.norm(difference) for difference in differences]
            gaps = [space.inner(qk, d) for qk, d in zip(new_q, differences, strict=True)]
            size = space.norm(_tree.sub(z, x)) + space.norm(x)
            tol = self._tolerance(size)
            close = jnp.max(jnp.stack(distances)) <= tol
            # The roundoff of the gap is eps times the norms of the qₖ.
            norms = jnp.stack([space.norm(qk) for qk in new_q])
            roundoff = jnp.finfo(size.dtype).eps * jnp.sum(norms) * size
            converged = close & (sum(gaps) <= tol * tol + 4.0 * roundoff)
            return x, tuple(new_q), converged, count + 1

        def unfinished(state: tuple) -> jax.Array:
            x, _, converged, count = state
            return ~converged & (count < self.max_cycles) & _tree.all_finite(x)

        start = (z, (zero,) * len(sets), jnp.asarray(False), jnp.asarray(0))
        _, q, converged, _ = lax.while_loop(unfinished, cycle, start)
        return q, converged

    def _tolerance(self, size: jax.Array) -> jax.Array:
        return jnp.maximum(self.tol, 8.0 * jnp.finfo(size.dtype).eps).astype(size.dtype) * size


def _subtract_all(z: Tree, q: tuple) -> Tree:
    """Return z − Σ qₖ."""
    for qk in q:
        z = _tree.sub(z, qk)
    return z


def _least_squares(g: Any, b: Tree) -> Tree:
    """Return a solution q of g(q) = b. The qₖ need not be unique; x does not depend on the choice."""
    flat, unflatten = jax.flatten_util.ravel_pytree(b)

    def flat_g(v: jax.Array) -> jax.Array:
        return jax.flatten_util.ravel_pytree(g(unflatten(v)))[0]

    if flat.size <= _MAX_DENSE_SIZE:
        matrix = jax.jacfwd(flat_g)(jnp.zeros_like(flat))
        rtol = jnp.sqrt(jnp.finfo(flat.dtype).eps)
        return unflatten(jnp.linalg.pinv(matrix, rtol=rtol) @ flat)
    transposed = jax.linear_transpose(flat_g, flat)

    def back(v: jax.Array) -> jax.Array:
        return transposed(v)[0]

    solution, _ = jax.scipy.sparse.linalg.cg(
        lambda v: back(flat_g(v)), back(flat), tol=1e-12, atol=0.0, maxiter=10 * flat.size
    )
    return unflatten(solution)
