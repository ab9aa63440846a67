"""Balls of the space's norm."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from .abstract import AbstractSet


class Ball(AbstractSet):
    """K = {y : ‖y − center‖ ≤ radius} in the norm of the space.

    **Arguments:** `center`: an element, or a number for all entries; `radius` ≥ 0.

    **Raises:** `dvax.InputError` if the radius is negative or not finite.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.Ball(0.0, 1.0)
    >>> K.project(jnp.array([0.0, 4.0]), dvax.spaces.Euclidean(2)).tolist()
    [0.0, 1.0]

    ```
    """

    center: Tree
    radius: jax.Array

    def __init__(self, center: Any, radius: Any):
        self.center, self.radius = center_and_radius("dvax.sets.Ball", center, radius)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        offset = self._minus_center(z)
        length = space.norm(offset)
        inside = length < self.radius  # false for NaN in z, center or radius, so NaN propagates
        shrink = jnp.where(inside, 1.0, self.radius / jnp.where(length > 0, length, 1.0))
        scaled = _tree.scale(shrink, offset)
        # Inside, return z itself: center + (z − center) has roundoff for a distant center.
        on_sphere = (
            _tree.add(self.center, scaled)
            if _tree.same_shape(self.center, z)
            else jax.tree_util.tree_map(lambda leaf: self.center + leaf, scaled)
        )
        return _tree.where(inside, z, on_sphere)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        return [self.radius - space.norm(self._minus_center(z))]

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        if jnp.ndim(self.radius) != 0 or not (
            _tree.same_shape(self.center, like)
            or (_tree.shapes(self.center) == () and not isinstance(self.center, tuple))
        ):
            raise input_error(
                "dvax.sets.Ball(center, radius)",
                f"shapes {_tree.shapes(self.center)} and {jnp.shape(self.radius)}",
                f"the center must be an element of shape {_tree.shapes(like)} or a number, "
                "the radius a number",
                "Use dvax.sets.Product for one ball a part",
            )

    def _minus_center(self, z: Tree) -> Tree:
        if _tree.same_shape(self.center, z):
            return _tree.sub(z, self.center)
        return jax.tree_util.tree_map(lambda leaf: leaf - self.center, z)


def center_and_radius(name: str, center: Any, radius: Any) -> tuple[Tree, jax.Array]:
    """Return (center, radius) as arrays; raise an `InputError` if their concrete values are wrong."""
    center = _tree.as_float(center, f"{name}(center)")
    radius = _tree.as_array(radius, f"{name}(radius)")
    _tree.require(
        lambda: np.all((np.asarray(radius) >= 0) & np.isfinite(radius)),
        f"{name}(radius)",
        radius,
        "the radius must be finite and ≥ 0, or the ball is empty or the whole space",
        "Use dvax.sets.WholeSpace() where there is no constraint",
    )
    _tree.require(
        lambda: _tree.has_only_finite(center),
        f"{name}(center)",
        center,
        "the entries of the center must be finite",
        "Correct the entries that are not",
    )
    if not _tree.is_concrete(radius):
        # A traced radius: replace a negative one by NaN, so that an empty ball stops a solve.
        radius = jnp.where(radius >= 0, radius, jnp.nan)
    return center, radius
