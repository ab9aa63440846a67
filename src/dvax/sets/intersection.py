"""K₁ ∩ K₂ ∩ …, where only the projection onto each is known."""

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
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from .abstract import AbstractSet

_DENSE = 512


class Intersection(AbstractSet):
    """K = K₁ ∩ … ∩ Kₘ, projected by Dykstra's method (Boyle and Dykstra 1986).

    Cycle through the sets, yₖ = proj_Kₖ(x + qₖ), qₖ ← x + qₖ − yₖ, x ← yₖ: always z = x + Σ qₖ with
    qₖ normal to Kₖ at yₖ, and x → proj_K(z).

    It stops when all yₖ agree with x to `tol`, and the angle that this leaves open,
    Σ ⟨qₖ, yₖ − x⟩, is at most tol² (both in the norm of the space, relative to ‖z − x‖ + ‖x‖); a point
    v ∈ K has ⟨z − x, v − x⟩ at most that angle, so x is the projection as far as it lies in K. What
    has not stopped after `max_cycles`, above all where K is empty, is NaN: never a point. The method
    is linear for flat sets and slow for round ones that touch; use `Polyhedron` for many flat ones.

    The derivative is that of the conditions above at the end, by their implicit function.

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
            rule, fix = "it must be a whole number > 0", "Leave it out for the default"
            given = _tree.line(max_cycles)
            raise InputError(InputProblem(f"{name}(max_cycles)", given, rule, fix))
        self.sets, self.tol, self.max_cycles = sets, tol, max_cycles
        if not sets:
            raise InputError(
                InputProblem(
                    "dvax.sets.Intersection",
                    "no sets",
                    "it needs sets to intersect",
                    "Use dvax.sets.WholeSpace() where there is no constraint",
                )
            )
        example = "Intersection(dvax.sets.Box(0.0, 1.0), dvax.sets.Ball(0.0, 1.0))"
        _tree.check_parts(sets, AbstractSet, name, example)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        fixed = jtu.tree_map(lax.stop_gradient, (self.sets, z, space))

        def conditions(q: tuple) -> tuple:
            x = _less(z, q)
            pairs = zip(self.sets, q, strict=True)
            return tuple(_tree.sub(x, K.project(_tree.add(x, own), space)) for K, own in pairs)

        def find(_: Any, start: tuple) -> tuple:
            return start

        start, good = self._dykstra(*fixed)
        q = lax.custom_root(conditions, start, find, _least_squares)
        x = _less(z, q)
        return _tree.where(good, x, jtu.tree_map(lambda leaf: jnp.full_like(leaf, jnp.nan), x))

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array] | None:
        """Dykstra's method ends without saying which sets hold the point."""
        return None

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        pairs = [K.intervals(like) for K in self.sets]
        known = [pair for pair in pairs if pair is not None]
        if len(known) < len(pairs):
            return None
        lower, upper = known[0]
        for low, up in known[1:]:
            lower = jtu.tree_map(jnp.maximum, lower, low)
            upper = jtu.tree_map(jnp.minimum, upper, up)
        # Intervals that do not meet hold no point: infinite, so that they stop a solve.
        empty = jtu.tree_map(jnp.greater, lower, upper)
        lower = jtu.tree_map(lambda no, low: jnp.where(no, jnp.inf, low), empty, lower)
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
            "Widen one of them",
        )

    def _dykstra(self, sets: tuple, z: Tree, space: AbstractSpace) -> tuple[tuple, jax.Array]:
        """(the qₖ, whether the stopping rule was met)."""
        nothing = _tree.zeros_like(z)

        def cycle(state: tuple) -> tuple:
            x, q, _, count = state
            after, ys = [], []
            for K, own in zip(sets, q, strict=True):
                raised = _tree.add(x, own)
                x = K.project(raised, space)
                after.append(_tree.sub(raised, x))
                ys.append(x)
            gaps = [_tree.sub(y, x) for y in ys]
            apart = [space.norm(gap) for gap in gaps]
            angle = [space.inner(own, gap) for own, gap in zip(after, gaps, strict=True)]
            size = space.norm(_tree.sub(z, x)) + space.norm(x)
            tol = self._tolerance(size)
            close = jnp.max(jnp.stack(apart)) <= tol
            # Rounding alone leaves an angle of eps times the normals.
            push = jnp.stack([space.norm(own) for own in after])
            floor = jnp.finfo(size.dtype).eps * jnp.sum(push) * size
            met = close & (sum(angle) <= tol * tol + 4.0 * floor)
            return x, tuple(after), met, count + 1

        def unfinished(state: tuple) -> jax.Array:
            x, _, met, count = state
            return ~met & (count < self.max_cycles) & _tree.all_finite(x)

        start = (z, (nothing,) * len(sets), jnp.asarray(False), jnp.asarray(0))
        _, q, met, _ = lax.while_loop(unfinished, cycle, start)
        return q, met

    def _tolerance(self, size: jax.Array) -> jax.Array:
        return jnp.maximum(self.tol, 8.0 * jnp.finfo(size.dtype).eps).astype(size.dtype) * size


def _less(z: Tree, q: tuple) -> Tree:
    for own in q:
        z = _tree.sub(z, own)
    return z


def _least_squares(g: Any, b: Tree) -> Tree:
    """A q with g(q) = b: the qₖ need not be unique, and x does not depend on which are taken."""
    flat, unflatten = jax.flatten_util.ravel_pytree(b)

    def flat_g(v: jax.Array) -> jax.Array:
        return jax.flatten_util.ravel_pytree(g(unflatten(v)))[0]

    if flat.size <= _DENSE:
        matrix = jax.jacfwd(flat_g)(jnp.zeros_like(flat))
        cut = jnp.sqrt(jnp.finfo(flat.dtype).eps)
        return unflatten(jnp.linalg.pinv(matrix, rtol=cut) @ flat)
    transposed = jax.linear_transpose(flat_g, flat)

    def back(v: jax.Array) -> jax.Array:
        return transposed(v)[0]

    found, _ = jax.scipy.sparse.linalg.cg(
        lambda v: back(flat_g(v)), back(flat), tol=1e-12, atol=0.0, maxiter=10 * flat.size
    )
    return unflatten(found)
