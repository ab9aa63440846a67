"""A bound on the deviation of a step from its chord, from the growth bound alone."""

import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractGenerator, FlowStep, Growth


def normwise_chord_deviation(
    A: AbstractGenerator, step: FlowStep, space: AbstractSpace, growth: Growth
) -> Tree:
    """Return h²/8 M e^{max(ω, 0)h} ‖x''(t₀)‖/√w, a bound on the chord deviation of every entry.

    The deviation is at most h²/8 max ‖x''‖, and x'' = e^{A(t−t₀)} x''(t₀) for a linear p. The absolute
    value of an entry is at most the norm divided by the square root of its weight.
    """
    h, x0, _, (constant, *linear) = step
    second_derivative = A.apply(_tree.add(A.apply(x0), constant))
    if linear:
        second_derivative = _tree.add(second_derivative, _tree.scale(1.0 / h, linear[0]))
    amplification = growth.M * jnp.exp(jnp.maximum(growth.omega, 0.0) * h)
    bound = h**2 / 8 * amplification * space.norm(second_derivative)
    return jtu.tree_map(
        lambda leaf, w: jnp.broadcast_to(bound / jnp.sqrt(w), leaf.shape), x0, space.weights()
    )
