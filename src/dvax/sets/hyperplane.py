"""One linear equation."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from ._weights import inverse_weights
from .abstract import AbstractSet


class Hyperplane(AbstractSet):
    """K = {y : Σᵢ aᵢ yᵢ = b}, with a plain sum whatever the space's weights.

    proj_K(z) = z − (Σᵢ aᵢzᵢ − b)/(Σᵢ aᵢ²/wᵢ) · a/w in the inner product with weights w.

    **Arguments:** `normal`: a, an element (an array of any shape, or a tuple of arrays), not zero;
    `offset`: b, a number.

    **Raises:** `dvax.InputError` where the normal is zero, or something is not finite.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.Hyperplane(jnp.array([1.0, 1.0]), 1.0)
    >>> K.project(jnp.array([2.0, 1.0]), dvax.spaces.Euclidean(2)).tolist()
    [1.0, 0.0]

    ```
    """

    normal: Tree
    offset: jax.Array

    def __init__(self, normal: Any, offset: Any):
        self.normal, self.offset = one_row("dvax.sets.Hyperplane", normal, offset)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        return along_normal(z, excess(self.normal, self.offset, z), self.normal, space)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        return []

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        fits_row("dvax.sets.Hyperplane", self.normal, self.offset, like)


def one_row(name: str, normal: Any, offset: Any) -> tuple[Tree, jax.Array]:
    """(a, b) of a linear condition, looked at as far as their values are known."""
    normal = _tree.as_float(normal, f"{name}(normal)")
    several = "Use dvax.sets.Polyhedron or dvax.sets.AffineSubspace for several conditions"
    offset = _tree.as_number(offset, f"{name}(offset)", several)
    _tree.require(
        lambda: (
            _tree.all_finite(normal) & any(bool(jnp.any(a != 0)) for a in jtu.tree_leaves(normal))
        ),
        f"{name}(normal)",
        normal,
        "the normal is finite and not zero, or the condition says nothing about y",
        "Use dvax.sets.WholeSpace() where there is no constraint",
    )
    _tree.require(
        lambda: jnp.isfinite(offset),
        f"{name}(offset)",
        offset,
        "the offset is a finite number",
        "Use dvax.sets.WholeSpace() where there is no constraint",
    )
    return normal, offset


def fits_row(name: str, normal: Tree, offset: jax.Array, like: Tree) -> None:
    """Raise an `InputError` unless the normal is an element shaped like `like`, the offset a number."""
    if jnp.ndim(offset) != 0 or not _tree.same_shape(normal, like):
        raise InputError(
            InputProblem(
                f"{name}(normal, offset)",
                f"shapes {_tree.shapes(normal)} and {jnp.shape(offset)}",
                f"the normal is an element, of shape {_tree.shapes(like)}, and the offset a number",
                "Use dvax.sets.AffineSubspace or dvax.sets.Polyhedron for several conditions",
            )
        )


def excess(normal: Tree, offset: jax.Array, z: Tree) -> jax.Array:
    """Σᵢ aᵢzᵢ − b."""
    products = jtu.tree_map(lambda a, v: jnp.sum(a * v), normal, z)
    return sum(jtu.tree_leaves(products), start=-offset)


def along_normal(z: Tree, amount: jax.Array, normal: Tree, space: AbstractSpace) -> Tree:
    """z moved along the normal of the space's inner product until Σᵢ aᵢzᵢ is less by `amount`."""
    # Scaled to one first: the square of a very small normal would vanish.
    size = sum(jnp.sum(jnp.abs(a)) for a in jtu.tree_leaves(normal))
    size = jnp.where(size > 0, size, jnp.nan)  # a traced normal may turn out to be zero
    unit = jtu.tree_map(lambda a: a / size, normal)
    direction = jtu.tree_map(jnp.multiply, unit, inverse_weights(space, normal))
    square = sum(jtu.tree_leaves(jtu.tree_map(lambda a, v: jnp.sum(a * v), unit, direction)))
    return jtu.tree_map(lambda v, a: v - amount / size / square * a, z, direction)
