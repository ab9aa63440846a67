"""Estimates of the rounding errors of a computed projection onto a set, and of a computed w."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import sets
from ..sets._dual_active_set import SLACK
from ..sets._face import face, iterates
from ..spaces import AbstractSpace


class ProjectionError(NamedTuple):
    """The error of y = proj_K(z) is at most operations · ε · `condition` · (‖y‖ + `data`)
    + `relative` (‖y‖ + ‖z − y‖).

    `data` is the magnitude of the numbers that define the set, `condition` the condition of its
    equations, and `relative` the error of an iterative projection at its stopping tolerance.
    """

    data: Any
    condition: Any = 1.0
    relative: Any = 0.0


def rounding_of_w(
    K: sets.AbstractSet, like: Any, size: Any, norm_F: Any, step: Any, condition: Any = 1.0
) -> jax.Array:
    """Return the rounding error of w = F(y) − F(b) + (b − y)/λ, without that of F, for y = proj_K(z).

    `size` = ‖y‖, `norm_F` is the magnitude of the values of F, and `step` is λ. The projection onto an
    interval is exact; that onto another set is assumed accurate to (8 + n)ε relative to the magnitudes
    in `projection_error`, times the condition of the active rows.
    """
    eps = jnp.finfo(jnp.result_type(*jtu.tree_leaves(like))).eps
    if K.intervals(like) is not None:
        return eps * (2 * size / step + 8 * norm_F)
    K_error, entries = projection_error(K), sum(leaf.size for leaf in jtu.tree_leaves(like))
    operations = 2 * (8 + entries)
    error_y = operations * condition * K_error.condition * eps * (size + K_error.data)
    error_y += condition * K_error.relative * (size + step * norm_F)
    return error_y / step + (8 + operations) * eps * norm_F


def condition_at(K: sets.AbstractSet, y: Any, space: AbstractSpace) -> Any:
    """Return the factor by which roundoff in the rows that hold with equality at y moves a projection
    onto K, as far as it is known."""
    found = face(K, y, space) if iterates(K) else None
    return 1.0 if found is None else found.condition


_STOPPING_FACTOR = 16.0
"""Error of an iterative projection relative to its last increment."""


def projection_error(K: sets.AbstractSet) -> ProjectionError:
    """Return the magnitudes from which the rounding error of proj_K is estimated."""
    if isinstance(K, sets.Ball | sets.L1Ball):
        return ProjectionError(_norm_bound(K.center) + jnp.max(jnp.abs(K.radius)))
    if isinstance(K, sets.Ellipsoid):
        return ProjectionError(_norm_bound(K.center))
    if isinstance(K, sets.HalfSpace | sets.Hyperplane):
        normal = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jtu.tree_leaves(K.normal)))
        return ProjectionError(jnp.abs(K.offset) / normal)
    if isinstance(K, sets.AffineSubspace):
        # The rows of E have norm 1.
        rows = jnp.sqrt(1.0 * K.e.size)
        return ProjectionError(0.0, jnp.maximum(1.0, rows * jnp.linalg.norm(K.pseudoinverse)))
    if isinstance(K, sets.ConstrainedBox):
        return ProjectionError(0.0, relative=jnp.finfo(K.R.dtype).eps ** SLACK)
    if isinstance(K, sets.Translated):
        inner = projection_error(K.set)
        return inner._replace(data=inner.data + _norm_bound(K.offset))
    if isinstance(K, sets.Scaled):
        inner = projection_error(K.set)
        return inner._replace(data=inner.data * jnp.abs(K.factor))
    parts = ()
    if isinstance(K, sets.Product):
        parts = K.parts
    if isinstance(K, sets.Intersection):
        parts = K.sets
    if not parts:
        return ProjectionError(0.0)
    inner = [projection_error(part) for part in parts]
    total = ProjectionError(
        sum(error.data for error in inner),
        jnp.max(jnp.stack([jnp.asarray(error.condition) for error in inner])),
        sum(error.relative for error in inner),
    )
    if isinstance(K, sets.Intersection):
        total = total._replace(relative=total.relative + _STOPPING_FACTOR * K.tol)
    return total


def _norm_bound(tree: Any) -> jax.Array:
    """Return √n · max |entry|, a bound on the Euclidean norm that does not overflow."""
    leaves = jtu.tree_leaves(tree)
    entries = sum(leaf.size for leaf in map(jnp.asarray, leaves))
    return jnp.sqrt(1.0 * entries) * jnp.max(jnp.stack([jnp.max(jnp.abs(v)) for v in leaves]))
