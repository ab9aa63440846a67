"""Direct sums of spaces, whose elements are tuples."""

import jax

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSpace


class Product(AbstractSpace):
    """The direct sum of spaces: tuples (a₁, a₂, …) with ⟨a, b⟩ = Σₖ ⟨aₖ, bₖ⟩ₖ.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> space = dvax.spaces.Product(dvax.spaces.Euclidean(2), dvax.spaces.Euclidean())
    >>> float(space.norm((jnp.array([2.0, 3.0]), jnp.array(6.0))))
    7.0

    ```
    """

    spaces: tuple[AbstractSpace, ...]

    def __init__(self, *spaces: AbstractSpace):
        example = "Product(dvax.spaces.Euclidean(2), dvax.spaces.Euclidean())"
        _tree.check_parts(spaces, AbstractSpace, "dvax.spaces.Product", example)
        self.spaces = spaces

    def inner(self, a: Tree, b: Tree) -> jax.Array:
        parts = [s.inner(p, q) for s, p, q in zip(self.spaces, a, b, strict=True)]
        return sum(parts[1:], start=parts[0])

    def zeros(self) -> Tree:
        return tuple(s.zeros() for s in self.spaces)

    def weights(self) -> Tree:
        return tuple(s.weights() for s in self.spaces)
