"""The whole space: no constraint, so that the law is an equation."""

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractSet


class WholeSpace(AbstractSet):
    """K = H. The normal cone is {0}, so the law reads u = h(t, x, u).

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> float(dvax.sets.WholeSpace().project(jnp.array(7.0), dvax.spaces.Euclidean()))
    7.0

    ```
    """

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        return z

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        return []

    def intervals(self, like: Tree) -> tuple[Tree, Tree]:
        return (
            jtu.tree_map(lambda leaf: jnp.full_like(leaf, -jnp.inf), like),
            jtu.tree_map(lambda leaf: jnp.full_like(leaf, jnp.inf), like),
        )

    def check(self, like: Tree) -> None:
        """Accept every shape."""
