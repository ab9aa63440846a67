"""One linear equation."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from ._weights import inverse_weights
from .abstract import AbstractSet


class Hyperplane(AbstractSet):
    """K = {y : Σᵢ aᵢ yᵢ = b}, with a plain sum whatever the space's weights.

    proj_K(z) = z − (Σᵢ aᵢzᵢ − b)/(Σᵢ aᵢ²/wᵢ) · a/w in the inner product with weights w.

    **Arguments:** `normal`: a, an element (an array of any shape, or a tuple of arrays), not zero;
    `offset`: b, a number.

    **Raises:** `dvax.InputError` if the normal is zero, or an entry is not finite.

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
        self.normal, self.offset = checked_row("dvax.sets.Hyperplane", normal, offset)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        return subtract_along_normal(z, excess(self.normal, self.offset, z), self.normal, space)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        return []

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        check_row_shape("dvax.sets.Hyperplane", self.normal, self.offset, like)


def checked_row(name: str, normal: Any, offset: Any) -> tuple[Tree, jax.Array]:
    """Return (a, b) as arrays; raise an `InputError` if their concrete values are wrong."""
    normal = _tree.as_float(normal, f"{name}(normal)")
    several = "Use dvax.sets.Polyhedron or dvax.sets.AffineSubspace for several conditions"
    offset = _tree.as_number(offset, f"{name}(offset)", several)
    _tree.require(
        lambda: (
            _tree.has_only_finite(normal) and any(map(np.any, jtu.tree_leaves(_tree.host(normal))))
        ),
        f"{name}(normal)",
        normal,
        "the normal must be finite and not zero, or the condition does not restrict y",
        "Use dvax.sets.WholeSpace() where there is no constraint",
    )
    _tree.require(
        lambda: np.isfinite(np.asarray(offset)),
        f"{name}(offset)",
        offset,
        "the offset must be a finite number",
        "Use dvax.sets.WholeSpace() where there is no constraint",
    )
    return normal, offset


def check_row_shape(name: str, normal: Tree, offset: jax.Array, like: Tree) -> None:
    """Raise an `InputError` unless the normal is shaped like `like` and the offset is a number."""
    if jnp.ndim(offset) != 0 or not _tree.same_shape(normal, like):
        raise input_error(
            f"{name}(normal, offset)",
            f"shapes {_tree.shapes(normal)} and {jnp.shape(offset)}",
            f"the normal must have the shape {_tree.shapes(like)}, and the offset be a number",
            "Use dvax.sets.AffineSubspace or dvax.sets.Polyhedron for several conditions",
        )


def excess(normal: Tree, offset: jax.Array, z: Tree) -> jax.Array:
    """Return Σᵢ aᵢzᵢ − b."""
    products = jtu.tree_map(lambda a, v: jnp.sum(a * v), normal, z)
    return sum(jtu.tree_leaves(products), start=-offset)


def subtract_along_normal(z: Tree, amount: jax.Array, normal: Tree, space: AbstractSpace) -> Tree:
    """Return z minus the multiple of a/w that reduces Σᵢ aᵢzᵢ by `amount`."""
    # Normalise first: the square of a very small normal would underflow.
    size = sum(jnp.sum(jnp.abs(a)) for a in jtu.tree_leaves(normal))
    size = jnp.where(size > 0, size, jnp.nan)  # a traced normal may be zero
    unit = jtu.tree_map(lambda a: a / size, normal)
    direction = jtu.tree_map(jnp.multiply, unit, inverse_weights(space, normal))
    square = sum(jtu.tree_leaves(jtu.tree_map(lambda a, v: jnp.sum(a * v), unit, direction)))
    return jtu.tree_map(lambda v, a: v - amount / size / square * a, z, direction)
