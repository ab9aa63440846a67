"""Products K = K₁ × K₂ × … of sets, for tuples."""

import jax

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from ..spaces import Product as ProductSpace
from .abstract import AbstractSet


class Product(AbstractSet):
    """K = {(y₁, y₂, …) : yₖ ∈ Kₖ}; the projection acts on each part separately.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.Product(dvax.sets.Box(0.0, 1.0), dvax.sets.WholeSpace())
    >>> s = dvax.spaces
    >>> y = K.project((jnp.array(2.0), jnp.array(2.0)), s.Product(s.Euclidean(), s.Euclidean()))
    >>> [float(v) for v in y]
    [1.0, 2.0]

    ```
    """

    parts: tuple[AbstractSet, ...]

    def __init__(self, *parts: AbstractSet):
        example = "Product(dvax.sets.Box(0.0, 1.0), dvax.sets.WholeSpace())"
        _tree.check_parts(parts, AbstractSet, "dvax.sets.Product", example)
        self.parts = parts

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        return tuple(k.project(p, s) for k, p, s in self._by_part(z, space))

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array] | None:
        parts = [k.switches(p, s) for k, p, s in self._by_part(z, space)]
        if any(part is None for part in parts):
            return None
        return [s for part in parts if part is not None for s in part]

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        intervals = [k.intervals(p) for k, p in zip(self.parts, like, strict=True)]
        boxes = [pair for pair in intervals if pair is not None]
        if len(boxes) < len(intervals):
            return None
        return tuple(pair[0] for pair in boxes), tuple(pair[1] for pair in boxes)

    def check(self, like: Tree) -> None:
        if not isinstance(like, tuple) or len(like) != len(self.parts):
            raise input_error(
                "dvax.sets.Product",
                f"{len(self.parts)} parts",
                "y = P u must be a tuple with as many parts",
                "Pass the control space: control_space=dvax.spaces.Product(...)",
            )
        for part, leaf in zip(self.parts, like, strict=True):
            part.check(leaf)

    def _by_part(
        self, z: Tree, space: AbstractSpace
    ) -> list[tuple[AbstractSet, Tree, AbstractSpace]]:
        spaces = space.spaces if isinstance(space, ProductSpace) else (space,) * len(self.parts)
        return list(zip(self.parts, z, spaces, strict=True))
