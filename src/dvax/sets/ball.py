"""Balls of the space's norm."""

from typing import Any

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from .abstract import AbstractSet


class Ball(AbstractSet):
    """K = {y : ‖y − center‖ ≤ radius} in the norm of the space.

    **Arguments:** `center`: an element, or a number that stands for a constant one; `radius` ≥ 0.

    **Raises:** `dvax.InputError` where the radius is negative or not finite.

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
        inside = length < self.radius  # NaN in z, center or radius is not inside: it comes out
        shrink = jnp.where(inside, 1.0, self.radius / jnp.where(length > 0, length, 1.0))
        moved = _tree.scale(shrink, offset)
        # Inside, z itself: center + (z − center) would lose digits for a far-away center.
        pulled = (
            _tree.add(self.center, moved)
            if _tree.same_shape(self.center, z)
            else jax.tree_util.tree_map(lambda leaf: self.center + leaf, moved)
        )
        return _tree.where(inside, z, pulled)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        return [self.radius - space.norm(self._minus_center(z))]

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        if jnp.ndim(self.radius) != 0 or not (
            _tree.same_shape(self.center, like)
            or (_tree.shapes(self.center) == () and not isinstance(self.center, tuple))
        ):
            raise InputError(
                InputProblem(
                    "dvax.sets.Ball(center, radius)",
                    f"shapes {_tree.shapes(self.center)} and {jnp.shape(self.radius)}",
                    f"the center is an element of shape {_tree.shapes(like)} or a number, "
                    "the radius a number",
                    "Use dvax.sets.Product for one ball a part",
                )
            )

    def _minus_center(self, z: Tree) -> Tree:
        if _tree.same_shape(self.center, z):
            return _tree.sub(z, self.center)
        return jax.tree_util.tree_map(lambda leaf: leaf - self.center, z)


def center_and_radius(name: str, center: Any, radius: Any) -> tuple[Tree, jax.Array]:
    """Those of a ball of any norm, looked at as far as their values are known."""
    center = _tree.as_float(center, f"{name}(center)")
    radius = _tree.as_array(radius, f"{name}(radius)")
    _tree.require(
        lambda: jnp.all((radius >= 0) & jnp.isfinite(radius)),
        f"{name}(radius)",
        radius,
        "a ball has a finite radius ≥ 0, or it is empty or the whole space",
        "Use dvax.sets.WholeSpace() where there is no constraint",
    )
    _tree.require(
        lambda: _tree.all_finite(center),
        f"{name}(center)",
        center,
        "a center is a point, with finite entries",
        "Mend the entries that are not",
    )
    if not _tree.is_concrete(radius):
        # Not known yet: a negative one is made NaN, so that an empty ball stops a solve.
        radius = jnp.where(radius >= 0, radius, jnp.nan)
    return center, radius
