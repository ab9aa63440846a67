"""One linear inequality."""

from typing import Any

import jax
import jax.numpy as jnp

from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractSet
from .hyperplane import along_normal, excess, fits_row, one_row


class HalfSpace(AbstractSet):
    """K = {y : Σᵢ aᵢ yᵢ ≤ b}, with a plain sum whatever the space's weights.

    proj_K(z) = z − (Σᵢ aᵢzᵢ − b)₊/(Σᵢ aᵢ²/wᵢ) · a/w in the inner product with weights w.

    **Arguments:** `normal`: a, an element (an array of any shape, or a tuple of arrays), not zero;
    `offset`: b, a number.

    **Raises:** `dvax.InputError` where the normal is zero, or something is not finite.

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
        self.normal, self.offset = one_row("dvax.sets.HalfSpace", normal, offset)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        above = excess(self.normal, self.offset, z)
        # Strictly below the plane nothing is held; on it, and where there is no number, all is.
        return along_normal(z, jnp.where(above < 0, 0.0, above), self.normal, space)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        return [-excess(self.normal, self.offset, z)]

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        fits_row("dvax.sets.HalfSpace", self.normal, self.offset, like)
