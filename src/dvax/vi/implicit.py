"""Derivatives of a solution through the implicit function, whatever method found it.

y solves R(y; θ) = y − proj_K(y − τF(y; θ)) = 0, so dR/dy · dy = −dR/dθ · dθ. One linear solve gives
every derivative, forward and reverse, of every order where it exists; no iteration is unrolled. At
a kink the projection's convention (`dvax.sets.AbstractSet`) picks the element of dR/dy.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from .certificate import natural_residual

_DENSE = 512  # up to this many unknowns the Jacobian is formed; beyond, GMRES applies it


def with_implicit_derivative(
    vi: Any, y0: Tree, tau: Any, iterate: Callable[[Tree], Tree], pointwise: bool
) -> Tree:
    """The y that `iterate(y0)` finds, with the derivative of the solution of `vi`."""

    def residual(y: Tree) -> Tree:
        return natural_residual(vi.F, vi.K, vi.space, y, tau)

    def solve(_: Any, guess: Tree) -> Tree:
        return jax.lax.stop_gradient(iterate(guess))

    linear_solve = _diagonal_solve if pointwise else _general_solve
    return jax.lax.custom_root(residual, jax.lax.stop_gradient(y0), solve, linear_solve)


def _diagonal_solve(g: Callable[[Tree], Tree], b: Tree) -> Tree:
    ones = jtu.tree_map(jnp.ones_like, b)
    return jtu.tree_map(lambda p, q: p / q, b, g(ones))


def _general_solve(g: Callable[[Tree], Tree], b: Tree) -> Tree:
    flat, unflatten = jax.flatten_util.ravel_pytree(b)

    def flat_g(v: jax.Array) -> jax.Array:
        return jax.flatten_util.ravel_pytree(g(unflatten(v)))[0]

    if flat.size <= _DENSE:
        matrix = jax.jacfwd(flat_g)(jnp.zeros_like(flat))
        return unflatten(jnp.linalg.solve(matrix, flat))
    solution, _ = jax.scipy.sparse.linalg.gmres(
        flat_g, flat, tol=1e-12, atol=0.0, restart=50, maxiter=20
    )
    return unflatten(solution)
