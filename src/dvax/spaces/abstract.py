"""What a Hilbert space owes."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem


class AbstractSpace(eqx.Module):
    """A real Hilbert space of arrays (or tuples of arrays) with its inner product."""

    @abc.abstractmethod
    def inner(self, a: Tree, b: Tree) -> jax.Array:
        """The inner product ⟨a, b⟩, a scalar."""

    @abc.abstractmethod
    def zeros(self) -> Tree:
        """The zero element; its structure is the structure of every element."""

    @abc.abstractmethod
    def weights(self) -> Tree:
        """The diagonal weights w with ⟨a, b⟩ = Σ wᵢ aᵢ bᵢ, broadcastable to an element."""

    def norm(self, a: Tree) -> jax.Array:
        """‖a‖ = √⟨a, a⟩. Its derivative at 0 is taken as 0, not NaN."""
        square = self.inner(a, a)
        zero = square == 0  # not "positive": NaN is neither, and must come out as NaN
        return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, square)))

    def size(self) -> jax.Array:
        """‖1‖² = Σ wᵢ: what turns a norm into a root mean square."""
        ones = jax.tree_util.tree_map(jnp.ones_like, self.zeros())
        return self.inner(ones, ones)

    def check(self, a: Tree, name: str) -> None:
        """Raise an `InputError` unless `a` has the structure of this space's elements."""
        if not _tree.same_shape(a, self.zeros()):
            raise InputError(
                InputProblem(
                    name,
                    f"shape {_tree.shapes(a)}",
                    f"it must be an element of {self!r}, of shape {_tree.shapes(self.zeros())}",
                    f"Give {name} that shape, or name the space that you mean "
                    "(state_space= or control_space= of dvax.Problem)",
                )
            )
