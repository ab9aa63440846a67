"""ℝⁿ, or any array shape, with the dot product."""

from collections.abc import Sequence
from typing import SupportsIndex

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSpace


class Euclidean(AbstractSpace):
    """Arrays of one shape with ⟨a, b⟩ = Σ aᵢ bᵢ.

    **Arguments:** `shape`: the arrays' shape; an integer n means `(n,)`, nothing means a scalar.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> float(dvax.spaces.Euclidean(2).norm(jnp.array([3.0, 4.0])))
    5.0

    ```
    """

    shape: tuple[int, ...]

    def __init__(self, shape: SupportsIndex | Sequence[SupportsIndex] = ()):
        self.shape = _tree.as_shape(
            shape, "dvax.spaces.Euclidean(shape)",
            "Write dvax.spaces.Euclidean(3) for vectors of 3, Euclidean() for a number",
        )  # fmt: skip

    def inner(self, a: Tree, b: Tree) -> jax.Array:
        return jnp.sum(a * b)

    def zeros(self) -> Tree:
        return jnp.zeros(self.shape)

    def weights(self) -> Tree:
        return jnp.ones(())
