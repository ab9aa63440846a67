"""L² on points with quadrature weights (a lumped mass matrix is the same thing)."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSpace


class L2(AbstractSpace):
    """Arrays of values at quadrature points with ⟨a, b⟩ = Σ wᵢ aᵢ bᵢ, the rule for ∫ a b.

    **Arguments:** `weights`: positive, one a point; their sum is the measure of the domain.

    **Raises:** `dvax.InputError` where a weight is not positive and finite.

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
            "Drop the points that carry no weight",
        )

    def inner(self, a: Tree, b: Tree) -> jax.Array:
        return jnp.sum(self.w * a * b)

    def zeros(self) -> Tree:
        return jnp.zeros_like(self.w)

    def weights(self) -> Tree:
        return self.w
