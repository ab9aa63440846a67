"""How far an arc lies from its chord, from the growth bound alone."""

import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractGenerator, Arc, Growth


def normwise_bend(A: AbstractGenerator, arc: Arc, space: AbstractSpace, growth: Growth) -> Tree:
    """h²/8 max ‖x''‖ ≤ h²/8 M e^{max(ω, 0)h} ‖x''(t₀)‖, since x'' = e^{A(t−t₀)} x''(t₀) where p is a
    line; and one entry is at most the norm over the root of its weight."""
    h, x0, _, (first, *rest) = arc
    curvature = A.apply(_tree.add(A.apply(x0), first))
    if rest:
        curvature = _tree.add(curvature, _tree.scale(1.0 / h, rest[0]))
    rise = growth.M * jnp.exp(jnp.maximum(growth.omega, 0.0) * h)
    largest = h**2 / 8 * rise * space.norm(curvature)
    return jtu.tree_map(
        lambda leaf, w: jnp.broadcast_to(largest / jnp.sqrt(w), leaf.shape), x0, space.weights()
    )
