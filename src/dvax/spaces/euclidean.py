"""Euclidean spaces of arrays of any shape."""

from collections.abc import Sequence
from typing import SupportsIndex

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSpace


class Euclidean(AbstractSpace):
    """The space of arrays of a given shape with ⟨a, b⟩ = Σ aᵢ bᵢ.

    **Arguments:** `shape`: the shape; an integer n means `(n,)`, and the default is a scalar.

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
