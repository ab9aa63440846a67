"""Estimate of the rounding error of a computed projection onto a set."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import sets


class ProjectionError(NamedTuple):
    """The error is at most operations · ε · `condition` · (‖y‖ + `data`) + `absolute` (1 + ‖y‖).

    `data` is the magnitude of the numbers that define the set, `condition` the condition of its
    equations, and `absolute` the error of an iterative projection at its stopping tolerance.
    """

    data: Any
    condition: Any = 1.0
    absolute: Any = 0.0


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
        sum(error.absolute for error in inner),
    )
    if isinstance(K, sets.Intersection):
        total = total._replace(absolute=total.absolute + _STOPPING_FACTOR * K.tol)
    return total


def _norm_bound(tree: Any) -> jax.Array:
    """Return √n · max |entry|, a bound on the Euclidean norm that does not overflow."""
    leaves = jtu.tree_leaves(tree)
    entries = sum(leaf.size for leaf in map(jnp.asarray, leaves))
    return jnp.sqrt(1.0 * entries) * jnp.max(jnp.stack([jnp.max(jnp.abs(v)) for v in leaves]))
