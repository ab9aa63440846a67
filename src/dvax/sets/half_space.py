"""One linear inequality."""

from typing import Any

import jax
import jax.numpy as jnp

from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractSet
from .hyperplane import check_row_shape, checked_row, excess, subtract_along_normal


class HalfSpace(AbstractSet):
    """K = {y : Σᵢ aᵢ yᵢ ≤ b}, with a plain sum whatever the space's weights.

    proj_K(z) = z − (Σᵢ aᵢzᵢ − b)₊/(Σᵢ aᵢ²/wᵢ) · a/w in the inner product with weights w.

    **Arguments:** `normal`: a, an element (an array of any shape, or a tuple of arrays), not zero;
    `offset`: b, a number.

    **Raises:** `dvax.InputError` if the normal is zero, or an entry is not finite.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.HalfSpace(jnp.array([1.0, 1.0]), 1.0)
    >>> K.project(jnp.array([2.0, 1.0]), dvax.spaces.Euclidean(2)).tolist()
    [1.0, 0.0]

    ```
    """

    normal: Tree
    offset: jax.Array

    def __init__(self, normal: Any, offset: Any):
        self.normal, self.offset = checked_row("dvax.sets.HalfSpace", normal, offset)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        above = excess(self.normal, self.offset, z)
        # Inactive strictly below the plane; active on it. The comparison is false for NaN, which
        # therefore propagates.
        return subtract_along_normal(z, jnp.where(above < 0, 0.0, above), self.normal, space)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        return [-excess(self.normal, self.offset, z)]

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        check_row_shape("dvax.sets.HalfSpace", self.normal, self.offset, like)
