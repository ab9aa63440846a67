"""L² with quadrature weights, or equivalently a lumped mass matrix."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSpace


class L2(AbstractSpace):
    """The space of values at quadrature points with ⟨a, b⟩ = Σ wᵢ aᵢ bᵢ ≈ ∫ a b.

    **Arguments:** `weights`: positive, one a point; their sum is the measure of the domain.

    **Raises:** `dvax.InputError` if a weight is not positive and finite.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> space = dvax.spaces.L2(jnp.full(4, 0.25))      # the unit interval, midpoint rule
    >>> float(space.norm(jnp.full(4, 3.0)))
    3.0

    ```
    """

    w: jax.Array

    def __init__(self, weights: Any):
        self.w = _tree.as_array(weights, "dvax.spaces.L2(weights)")
        _tree.require(
            lambda: np.all((np.asarray(self.w) > 0) & np.isfinite(self.w)),
            "dvax.spaces.L2(weights)",
            self.w,
            "quadrature weights must be positive and finite, or ⟨·,·⟩ is no inner product",
            "Remove the points with weight 0",
        )

    def inner(self, a: Tree, b: Tree) -> jax.Array:
        return jnp.sum(self.w * a * b)

    def zeros(self) -> Tree:
        return jnp.zeros_like(self.w)

    def weights(self) -> Tree:
        return self.w
