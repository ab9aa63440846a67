"""Diagonal generators A = diag(a₁, …, aₙ)."""

from typing import Any

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractGenerator, FlowStep, Growth
from .phi import flow_factors, phi_scalar
from .scalar import ElementwisePropagator, elementwise_chord_deviation


class Diagonal(AbstractGenerator):
    """A v = a ⊙ v, elementwise, with M = 1 and ω = max aᵢ in every norm with diagonal weights.

    **Arguments:** `entries`: an array of the state's shape, in 1/time.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> A = dvax.generators.Diagonal(jnp.array([-1.0, -2.0]))
    >>> float(A.growth(dvax.spaces.Euclidean(2)).omega)
    -1.0

    ```
    """

    entries: jax.Array

    def __init__(self, entries: Any):
        self.entries = _tree.as_array(entries, "dvax.generators.Diagonal(entries)")

    def apply(self, v: Tree) -> Tree:
        return self.entries * v

    def propagator(self, h: Any, terms: int) -> ElementwisePropagator:
        return ElementwisePropagator(flow_factors(h, phi_scalar(h * self.entries, terms)))

    def check(self, space: AbstractSpace) -> None:
        name = "dvax.generators.Diagonal(entries)"
        _tree.fits(name, self.entries, space.like(), "state space")

    def adjoint(self, space: AbstractSpace) -> "Diagonal":
        return self

    def growth(self, space: AbstractSpace) -> Growth:
        return Growth(jnp.ones(()), jnp.max(jnp.real(self.entries)))

    def chord_deviation(self, step: FlowStep, space: AbstractSpace, growth: Growth) -> Tree:
        return elementwise_chord_deviation(self.entries, step.h, step.x0, step.x1, *step.c)
