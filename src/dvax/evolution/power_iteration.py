"""The largest slope of what a method treats explicitly, by power iteration along the steps.

A derivative of the run is a solution of the linearised equation v' = (A + Df̃)v, by the steps that the
state has chosen. Where the state stands still, or moves along a line, its error is zero for any step
size, however fast v changes: a spring that starts at rest, differentiated in its position, would take
steps beyond the limit of stability, and v would grow without bound. So where a derivative is wanted
the step size is limited by σ, the spectral radius of B = Df̃ (of A + Df̃ for a method that is explicit
in A), whatever the state does (`Adaptive`).

Each step applies B twice to a direction d:

    σ = √(‖B²d‖/‖d‖),   d ← B²d/‖B²d‖ + p/10,   ‖p‖ = 1.

The square makes σ independent of the units of positions and velocities: for x'' = −ω²x it is ω for any
d. The pattern p, which contains all frequencies, keeps a part of d in entries that a held response
decouples now, and not later. σ is an estimate from below, within a factor of 1.1 after some steps.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace

_SHARE = 0.1
"""Share of the pattern p in the next direction."""

_ALONG = 0.7
"""Cosine from which a vector points along another one: it is 1 for an eigenvector of a real eigenvalue,
and below 0.71 for eigenvalues whose imaginary parts exceed the real ones."""


def pattern(space: AbstractSpace, like: Tree) -> Tree:
    """Return p, a state of norm 1 in which all frequencies are present."""

    def one(leaf: Any) -> Any:
        k = jnp.arange(leaf.size, dtype=leaf.dtype).reshape(leaf.shape)
        # A chirp that neighbouring entries do not repeat.
        return jnp.cos(1.0 + k * (1.0 + 0.6180339887 * k))

    return _normalised(space, jtu.tree_map(one, like))


def refine(space: AbstractSpace, push: Callable[[Tree], Tree], d: Tree) -> tuple[Any, Any, Tree]:
    """Return σ, whether v decays where it changes fastest, and the next direction, where `push` applies
    B. A B that is zero or not finite leaves the direction as it is, and σ = 0: it limits nothing.

    v decays where Bd points against d, and B²d along it: an oscillation has −ω²d there, though its
    velocities alone may point anywhere."""
    one = push(d)
    two = push(one)
    length = space.norm(two)
    size = length / space.norm(d)
    known = jnp.isfinite(size) & (size > 0.0)
    is_real = space.inner(d, two) > _ALONG * space.norm(d) * length
    is_damped = is_real & (space.inner(one, two) < -_ALONG * space.norm(one) * length)
    unit = _tree.scale(1.0 / jnp.where(known, length, 1.0), two)
    mixed = _tree.add(unit, _tree.scale(_SHARE, pattern(space, d)))
    return jnp.where(known, jnp.sqrt(size), 0.0), is_damped, _tree.where(known, mixed, d)


def _normalised(space: AbstractSpace, d: Tree) -> Tree:
    length = space.norm(d)
    return _tree.scale(1.0 / jnp.where(length > 0.0, length, 1.0), d)
