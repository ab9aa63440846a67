"""Derivatives of a solution through the implicit function, whatever method found it.

y solves R(y; θ) = y − proj_K(y − τF(y; θ)) = 0, so dR/dy · dy = −dR/dθ · dθ. One linear solve gives
every derivative, forward and reverse, of every order where it exists; no iteration is unrolled. At
a kink the projection's convention (`dvax.sets.AbstractSet`) picks the element of dR/dy. Where that is
singular to rounding, y has no derivative (the solutions of VI(K, F) may not even be isolated), and
what is returned is NaN and not some number (infinite or NaN for pointwise laws). Beyond 1024 unknowns
it is NaN where GMRES did not converge, for that reason or another.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..programs.matrix import matrix_of
from .certificate import natural_residual

_DENSE = 1024  # up to this many unknowns the Jacobian is formed; beyond, GMRES applies it


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
    # Where the slope vanishes, so does the derivative's existence: b / 0 is not finite, 0 / 0 is NaN.
    return jtu.tree_map(lambda p, q: p / q, b, g(ones))


def _general_solve(g: Callable[[Tree], Tree], b: Tree) -> Tree:
    flat, unflatten = jax.flatten_util.ravel_pytree(b)
    if flat.size > _DENSE:
        return unflatten(
            _krylov_solve(lambda d: jax.flatten_util.ravel_pytree(g(unflatten(d)))[0], flat)
        )
    matrix = matrix_of(g, b)
    pivots = jnp.abs(jnp.diagonal(jax.lax.linalg.lu(jax.lax.stop_gradient(matrix))[0]))
    eps = jnp.finfo(flat.dtype).eps
    singular = ~(jnp.min(pivots) > flat.size * eps * jnp.max(pivots))
    # A factor, so that the result stays linear in b.
    exists = jnp.where(singular, jnp.nan, jnp.ones((), flat.dtype))
    return unflatten(jnp.linalg.solve(matrix, flat) * exists)


def _krylov_solve(g: Callable[[jax.Array], jax.Array], b: jax.Array) -> jax.Array:
    gmres = jax.scipy.sparse.linalg.gmres
    eps = float(jnp.finfo(b.dtype).eps)
    # Relative residuals: what is aimed at, and what is an answer.
    asked, enough = max(1e-12, 10 * eps), eps**0.5

    def solve(apply: Callable[[jax.Array], jax.Array], right: jax.Array) -> jax.Array:
        d, _ = gmres(apply, right, tol=asked, atol=0.0, restart=50, maxiter=20)
        left = jnp.linalg.norm(right - apply(d))
        return jnp.where(left <= enough * jnp.linalg.norm(right), d, jnp.nan)

    return jax.lax.custom_linear_solve(g, b, solve, transpose_solve=solve)
