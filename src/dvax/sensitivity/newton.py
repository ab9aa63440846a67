"""The solver of the law of a variation for sets K that are not boxes."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from .._tree import Tree
from ..vi import RESULTS, AbstractSolver, Answer, FrozenVI

_MAX_ITERATIONS = 50


class _State(NamedTuple):
    v: jax.Array
    residual: jax.Array
    count: jax.Array


class OneSided(AbstractSolver):
    """Newton's method for v = Π'(v − F(v)) with affine F.

    Π' is `CriticalCone.project`, the directional derivative of a projection. It is piecewise linear, so
    the method terminates after finitely many steps, usually two. The general solvers of variational
    inequalities use steps v − τF(v) with other τ, for which Π' of a curved boundary is not valid. The
    method forms a dense matrix of the size of the response.
    """

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        start, unravel = ravel_pytree(y0)

        def F(v: jax.Array) -> jax.Array:
            return ravel_pytree(vi.F(unravel(v)))[0]

        def project(v: jax.Array) -> jax.Array:
            return ravel_pytree(vi.K.project(unravel(v), vi.space))[0]

        def natural_residual(v: jax.Array) -> jax.Array:
            return vi.space.norm(unravel(v - project(v - F(v))))

        J, identity = jax.jacfwd(F)(start), jnp.eye(start.size, dtype=start.dtype)

        def unfinished(s: _State) -> jax.Array:
            return (s.residual > tol) & (s.count < _MAX_ITERATIONS)

        def advance(s: _State) -> _State:
            z = s.v - F(s.v)
            D = jax.jacfwd(project)(z)
            v = s.v - jnp.linalg.solve(identity - D @ (identity - J), s.v - project(z))
            return _State(v, natural_residual(v), s.count + 1)

        first = _State(start, natural_residual(start), jnp.asarray(0))
        end = lax.while_loop(unfinished, advance, first)
        z = end.v - F(end.v)
        y = project(z)
        w = F(y) + z - y
        residual = vi.space.norm(unravel(w))
        result = RESULTS.where(residual <= 10.0 * tol, RESULTS.successful, RESULTS.max_steps)
        return Answer(unravel(y), unravel(z), residual, end.count, result, end.count + 2)
