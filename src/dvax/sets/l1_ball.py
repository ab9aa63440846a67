"""Balls of the sum of absolute values."""

from typing import Any

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from ._threshold import above, cut, thresholds
from ._weights import even, inverse_weights
from .abstract import AbstractSet
from .ball import center_and_radius


class L1Ball(AbstractSet):
    """K = {y : Σᵢ |yᵢ − cᵢ| ≤ radius}, with a plain sum whatever the space's weights.

    proj_K(z) = c + sign(z − c) max(|z − c| − τ/w, 0): outside, |z − c| is projected onto the simplex
    of that total. Entries that τ cuts off are held at c.

    **Arguments:** `center`: an array of the shape of y, or a number that stands for a constant one;
    `radius` ≥ 0, a number.

    **Raises:** `dvax.InputError` where the radius is negative or not finite, or the center is not.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.L1Ball(0.0, 1.0)
    >>> K.project(jnp.array([-3.0, 1.0, 0.0]), dvax.spaces.Euclidean(3)).tolist()
    [-1.0, 0.0, 0.0]

    ```
    """

    center: jax.Array
    radius: jax.Array

    def __init__(self, center: Any, radius: Any):
        self.center, self.radius = center_and_radius("dvax.sets.L1Ball", center, radius)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        center = jnp.broadcast_to(self.center, jnp.shape(z))
        offset = z - center
        length = jnp.abs(offset)
        inside = jnp.sum(length) < self.radius  # NaN is not inside: it comes out
        kept = cut(*self._cuts(length, space)).reshape(jnp.shape(z))
        return jnp.where(inside, z, center + jnp.sign(offset) * kept)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        length = jnp.abs(z - jnp.broadcast_to(self.center, jnp.shape(z)))
        return [self.radius - jnp.sum(length), above(*self._cuts(length, space))]

    def _cuts(self, length: jax.Array, space: AbstractSpace) -> tuple:
        """Where |z − c| is cut off, as `cut` takes it: nowhere inside, where it is all positive."""
        flat = length.reshape(-1)
        inverse_w = None if even(space) else inverse_weights(space, length).reshape(-1)
        return flat, *thresholds(flat, self.radius, inverse_w), inverse_w

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        shapes = _tree.shapes(self.center), jnp.shape(self.radius)
        if isinstance(like, tuple) or shapes not in ((jnp.shape(like), ()), ((), ())):
            raise InputError(
                InputProblem(
                    "dvax.sets.L1Ball(center, radius)",
                    f"shapes {shapes[0]} and {shapes[1]}",
                    f"the center is an array of the shape {_tree.shapes(like)} of y = P u, or a "
                    "number, and the radius a number",
                    "Use dvax.sets.Product for one ball a part",
                )
            )
