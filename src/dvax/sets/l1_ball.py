"""Balls in the ℓ¹ norm."""

from typing import Any

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from ._threshold import entry_thresholds, subtract, subtract_and_clip
from ._weights import has_uniform_weight, inverse_weights
from .abstract import AbstractSet
from .ball import center_and_radius


class L1Ball(AbstractSet):
    """K = {y : Σᵢ |yᵢ − cᵢ| ≤ radius}, with a plain sum whatever the space's weights.

    proj_K(z) = c + sign(z − c) max(|z − c| − τ/w, 0): outside, |z − c| is projected onto the simplex
    of total `radius`. Entries that the threshold τ clips are active at c.

    **Arguments:** `center`: an array of the shape of y, or a number for all entries; `radius` ≥ 0, a
    number.

    **Raises:** `dvax.InputError` if the radius is negative or not finite, or the center is not finite.

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
        inside = jnp.sum(length) < self.radius  # false for NaN, which propagates
        clipped = subtract_and_clip(*self._thresholds(length, space)).reshape(jnp.shape(z))
        return jnp.where(inside, z, center + jnp.sign(offset) * clipped)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        length = jnp.abs(z - jnp.broadcast_to(self.center, jnp.shape(z)))
        return [self.radius - jnp.sum(length), subtract(*self._thresholds(length, space))]

    def _thresholds(self, length: jax.Array, space: AbstractSpace) -> tuple:
        """Return the arguments of `subtract` and `subtract_and_clip` for |z − c|."""
        flat = length.reshape(-1)
        uniform = has_uniform_weight(space)
        inverse_w = None if uniform else inverse_weights(space, length).reshape(-1)
        return flat, *entry_thresholds(flat, self.radius, inverse_w), inverse_w

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        shapes = _tree.shapes(self.center), jnp.shape(self.radius)
        if isinstance(like, tuple) or shapes not in ((jnp.shape(like), ()), ((), ())):
            raise input_error(
                "dvax.sets.L1Ball(center, radius)",
                f"shapes {shapes[0]} and {shapes[1]}",
                f"the center must be an array of the shape {_tree.shapes(like)} of y = P u, or "
                "a number, and the radius a number",
                "Use dvax.sets.Product for one ball a part",
            )
