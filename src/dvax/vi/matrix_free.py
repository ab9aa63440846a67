"""Matrix-free linear systems of Newton's method for the normal map."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._batch import any_lane
from .._tree import Tree
from .krylov import solve_general
from .newton import Linearisation
from .scattered import scattered

_CG_STEPS, _BICGSTAB_STEPS = 1000, 100

_LARGEST_TOLERANCE = 0.01
"""Relative. With 0.1, errors of the slow modes remain that end every run of Newton steps on a ball."""


def solve_matrix_free(
    at: Linearisation, right: Tree, weights: Tree, symmetric: Any = None,
    preconditioner: Callable[[Tree], Tree] | None = None,
) -> Tree:  # fmt: skip
    """Return d with (τF′D + I − D) d = right, by one product with F′ and two with D an iteration.

    Dd is unique, and solves D(τF′D + I − D) d = D right; then d = right + Dd − τF′Dd. The derivative D
    of a projection is self-adjoint in the space, whose `weights` W define its inner product. If F′ is
    as well (`symmetric`; None: decide by `is_self_adjoint`), conjugate gradients solve the system, and
    otherwise `solve_general`. The `preconditioner` approximates the inverse of F′ in the range of D.
    """
    parts = _broadcast(weights, right)
    rtol: Any = jnp.clip(at.reduction, 1e-10, _LARGEST_TOLERANCE)

    def apply(d: Tree) -> Tree:
        moved = at.tangent(d)
        image = _tree.add(_tree.scale(at.tau, at.slope(moved)), _tree.sub(d, moved))
        return at.tangent(image)

    def weighted(d: Tree) -> Tree:
        return jtu.tree_map(jnp.multiply, parts, d)

    def by_conjugate_gradients() -> Tree:
        d, _ = jax.scipy.sparse.linalg.cg(
            lambda d: weighted(apply(d)), weighted(at.tangent(right)), tol=rtol,
            maxiter=_CG_STEPS, M=preconditioner,
        )  # fmt: skip
        return d

    def by_residuals() -> Tree:
        return solve_general(apply, at.tangent(right), rtol, _BICGSTAB_STEPS, preconditioner)

    if symmetric is None:
        symmetric = is_self_adjoint(at.slope, right, weights)
    if symmetric is True:
        d = by_conjugate_gradients()
    else:
        d = lax.cond(any_lane(~symmetric), by_residuals, by_conjugate_gradients)
    moved = at.tangent(d)
    return _tree.sub(_tree.add(right, moved), _tree.scale(at.tau, at.slope(moved)))


def is_self_adjoint(slope: Callable[[Tree], Tree], like: Tree, weights: Tree) -> jax.Array:
    """Return whether ⟨a, F′b⟩ = ⟨F′a, b⟩ up to roundoff, for two vectors of scattered entries.

    For other F′ this holds with probability zero; then conjugate gradients may fail, but a result that
    is wrong does not pass the test of ‖w‖.
    """
    parts = _broadcast(weights, like)
    a, b = scattered(parts, 1), scattered(parts, 2)
    weighted_a, weighted_b = (jtu.tree_map(jnp.multiply, parts, v) for v in (a, b))
    slope_a, slope_b = slope(a), slope(b)
    difference = _tree.dot(weighted_a, slope_b) - _tree.dot(weighted_b, slope_a)
    size = _tree.dot(weighted_a, weighted_a) * _tree.dot(slope_b, slope_b)
    return jnp.abs(difference) <= 8 * jnp.finfo(size.dtype).eps * jnp.sqrt(size)


def _broadcast(weights: Tree, like: Tree) -> Tree:
    return jtu.tree_map(lambda w, v: jnp.broadcast_to(w, v.shape).astype(v.dtype), weights, like)
