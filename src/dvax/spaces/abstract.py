"""The abstract Hilbert space."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import input_error


class AbstractSpace(eqx.Module):
    """A real Hilbert space of arrays (or tuples of arrays) with its inner product.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> space = dvax.spaces.L2(jnp.array([0.5, 0.5]))               # two cells of length 1/2
    >>> isinstance(space, dvax.spaces.AbstractSpace)
    True
    >>> float(space.norm(jnp.ones(2))), float(space.inner(jnp.ones(2), jnp.array([1.0, 3.0])))
    (1.0, 2.0)

    ```
    """

    @abc.abstractmethod
    def inner(self, a: Tree, b: Tree) -> jax.Array:
        """Return the inner product ⟨a, b⟩, a scalar."""

    @abc.abstractmethod
    def zeros(self) -> Tree:
        """Return the zero element; every element has its structure and shapes."""

    @abc.abstractmethod
    def weights(self) -> Tree:
        """Return the weights w with ⟨a, b⟩ = Σ wᵢ aᵢ bᵢ, which broadcast to an element."""

    def norm(self, a: Tree) -> jax.Array:
        """Return ‖a‖ = √⟨a, a⟩, with the derivative 0 (not NaN) at 0."""
        square = self.inner(a, a)
        zero = square == 0  # false for NaN, which propagates
        return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square)))

    def size(self) -> jax.Array:
        """Return ‖1‖² = Σ wᵢ; a norm divided by its square root is a root mean square."""
        ones = jax.tree_util.tree_map(jnp.ones_like, self.zeros())
        return self.inner(ones, ones)

    def like(self) -> Tree:
        """Return an element as shapes and types, without values."""
        return jax.eval_shape(self.zeros)

    def check(self, a: Tree, name: str) -> None:
        """Raise an `InputError` unless `a` has the structure of this space's elements."""
        like = self.like()
        if not _tree.same_shape(a, like):
            raise input_error(
                name,
                f"shape {_tree.shapes(a)}",
                f"it must be an element of {self!r}, of shape {_tree.shapes(like)}",
                f"Give {name} that shape, or pass another state_space= or control_space= to "
                "dvax.Problem",
            )
