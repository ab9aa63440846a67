"""Derivatives of a solution by the implicit function theorem, independent of the solver.

y solves R(y; θ) = y − proj_K(y − τF(y; θ)) = 0, so dR/dy · dy = −dR/dθ · dθ. One linear solve gives
every derivative that exists, in forward and reverse mode and of every order, without unrolling an
iteration. At a kink the projection's convention (`dvax.sets.AbstractSet`) selects the element of dR/dy.
If dR/dy is singular to rounding, y has no derivative (the solutions of VI(K, F) may not even be
isolated), and the result is NaN (infinite or NaN for pointwise laws). Beyond 1024 unknowns the result
is NaN if the Krylov method did not converge.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu

from .._small_matrices import pivots, solve
from .._tree import Tree
from ..programs.matrix import matrix_of
from .certificate import natural_residual
from .krylov import solve_general

_BICGSTAB_STEPS = 1000
_MAX_DENSE_UNKNOWNS = 1024
"""Up to this size the Jacobian is formed; beyond, a Krylov method applies it."""


def with_implicit_derivative(vi: Any, solution: Tree, tau: Any, pointwise: bool) -> Tree:
    """Return `solution` with the derivative of the solution of `vi`."""

    def residual(y: Tree) -> Tree:
        return natural_residual(vi.F, vi.K, vi.space, y, tau)

    def solve(_: Any, guess: Tree) -> Tree:
        return jax.lax.stop_gradient(guess)

    linear_solve = _diagonal_solve if pointwise else _general_solve
    return jax.lax.custom_root(residual, jax.lax.stop_gradient(solution), solve, linear_solve)


def _diagonal_solve(g: Callable[[Tree], Tree], b: Tree) -> Tree:
    ones = jtu.tree_map(jnp.ones_like, b)
    # If the slope is 0 the derivative does not exist: b / 0 is not finite, and 0 / 0 is NaN.
    return jtu.tree_map(lambda p, q: p / q, b, g(ones))


def _general_solve(g: Callable[[Tree], Tree], b: Tree) -> Tree:
    flat, unflatten = jax.flatten_util.ravel_pytree(b)
    if flat.size > _MAX_DENSE_UNKNOWNS:
        return unflatten(
            _krylov_solve(lambda d: jax.flatten_util.ravel_pytree(g(unflatten(d)))[0], flat)
        )
    matrix = matrix_of(g, b)
    sizes, eps = jnp.abs(pivots(matrix)), jnp.finfo(flat.dtype).eps
    singular = ~(jnp.min(sizes) > flat.size * eps * jnp.max(sizes))
    # A factor of NaN or 1 keeps the result linear in b, as transposition requires.
    factor = jnp.where(singular, jnp.nan, jnp.ones((), flat.dtype))
    return unflatten(solve(matrix, flat) * factor)


def _krylov_solve(g: Callable[[jax.Array], jax.Array], b: jax.Array) -> jax.Array:
    eps = float(jnp.finfo(b.dtype).eps)
    # Relative residuals: the tolerance of the method, and the largest that counts as converged.
    rtol, converged = max(1e-12, 10 * eps), eps**0.5

    def solve(apply: Callable[[jax.Array], jax.Array], right: jax.Array) -> jax.Array:
        d = solve_general(apply, right, rtol, _BICGSTAB_STEPS)
        residual = jnp.linalg.norm(right - apply(d))
        return jnp.where(residual <= converged * jnp.linalg.norm(right), d, jnp.nan)

    return jax.lax.custom_linear_solve(g, b, solve, transpose_solve=solve)
