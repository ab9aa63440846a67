"""How far the computed projection onto a set may be from the exact one."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import sets


class ProjectionError(NamedTuple):
    """The error is at most places · ε · `condition` · (‖y‖ + `data`) + `absolute` (1 + ‖y‖).

    `data` is the size of the numbers that make the set and enter the projection, `condition` that of
    its equations, `absolute` what an iterated projection stops at.
    """

    data: Any
    condition: Any = 1.0
    absolute: Any = 0.0


_STOPPED = 16.0
"""Distance from the projection, in units of the last move of an iterated one."""


def projection_error(K: sets.AbstractSet) -> ProjectionError:
    """Return the sizes by which the rounding of proj_K is estimated."""
    if isinstance(K, sets.Ball | sets.L1Ball):
        return ProjectionError(_largest(K.center) + jnp.max(jnp.abs(K.radius)))
    if isinstance(K, sets.Ellipsoid):
        return ProjectionError(_largest(K.center))
    if isinstance(K, sets.HalfSpace | sets.Hyperplane):
        normal = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jtu.tree_leaves(K.normal)))
        return ProjectionError(jnp.abs(K.offset) / normal)
    if isinstance(K, sets.AffineSubspace):
        # The rows have length 1.
        rows = jnp.sqrt(1.0 * K.e.size)
        return ProjectionError(0.0, jnp.maximum(1.0, rows * jnp.linalg.norm(K.pseudoinverse)))
    if isinstance(K, sets.Translated):
        inner = projection_error(K.set)
        return inner._replace(data=inner.data + _largest(K.offset))
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
    found = ProjectionError(
        sum(one.data for one in inner),
        jnp.max(jnp.stack([jnp.asarray(one.condition) for one in inner])),
        sum(one.absolute for one in inner),
    )
    if isinstance(K, sets.Intersection):
        found = found._replace(absolute=found.absolute + _STOPPED * K.tol)
    return found


def _largest(tree: Any) -> jax.Array:
    leaves = jtu.tree_leaves(tree)
    entries = sum(leaf.size for leaf in map(jnp.asarray, leaves))
    return jnp.sqrt(1.0 * entries) * jnp.max(jnp.stack([jnp.max(jnp.abs(v)) for v in leaves]))
