"""The response of a variation where K has a curved boundary, or one that no interval describes."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from .._tree import Tree
from ..vi import RESULTS, AbstractSolver, Answer, FrozenVI

_MOST = 50


class _State(NamedTuple):
    v: jax.Array
    residual: jax.Array
    count: jax.Array


class OneSided(AbstractSolver):
    """Newton's method for v = Π'(v − F(v)), with Π' = `Ahead.project`, the directional derivative of a
    projection, and F affine.

    Π' is piecewise linear, so that it ends after finitely many steps, as a rule two. Solvers of
    variational inequalities take steps of another length τ, and a curved boundary looks different
    from there: Π' belongs to τ = 1. A matrix as large as the response is formed.
    """

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        start, back = ravel_pytree(y0)
        F = lambda v: ravel_pytree(vi.F(back(v)))[0]  # noqa: E731
        project = lambda v: ravel_pytree(vi.K.project(back(v), vi.space))[0]  # noqa: E731
        J, same = jax.jacfwd(F)(start), jnp.eye(start.size, dtype=start.dtype)

        def off(v: jax.Array) -> jax.Array:
            return vi.space.norm(back(v - project(v - F(v))))

        def advance(s: _State) -> _State:
            ahead = s.v - F(s.v)
            D = jax.jacfwd(project)(ahead)
            v = s.v - jnp.linalg.solve(same - D @ (same - J), s.v - project(ahead))
            return _State(v, off(v), s.count + 1)

        first = _State(start, off(start), jnp.asarray(0))
        end = lax.while_loop(lambda s: (s.residual > tol) & (s.count < _MOST), advance, first)
        z = end.v - F(end.v)
        y = project(z)
        w = F(y) + z - y
        residual = vi.space.norm(back(w))
        result = RESULTS.where(residual <= 10.0 * tol, RESULTS.successful, RESULTS.max_steps)
        return Answer(back(y), back(z), residual, end.count, result, end.count + 2)
