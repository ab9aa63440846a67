"""K = K₁ × K₂ × … on tuples."""

from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from ..spaces import Product as ProductSpace
from .abstract import AbstractSet


class Product(AbstractSet):
    """K = {(y₁, y₂, …) : yₖ ∈ Kₖ}: projected part by part.

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
        self.parts = parts

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        spaces = space.spaces if isinstance(space, ProductSpace) else (space,) * len(self.parts)
        return tuple(k.project(p, s) for k, p, s in zip(self.parts, z, spaces, strict=True))

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        pairs = [k.intervals(p) for k, p in zip(self.parts, like, strict=True)]
        known = [pair for pair in pairs if pair is not None]
        if len(known) < len(pairs):
            return None
        return tuple(pair[0] for pair in known), tuple(pair[1] for pair in known)

    def check(self, like: Tree) -> None:
        if not isinstance(like, tuple) or len(like) != len(self.parts):
            raise InputError(
                InputProblem(
                    "dvax.sets.Product",
                    f"{len(self.parts)} parts",
                    "y = P u must be a tuple with as many parts",
                    "Name the control space: control_space=dvax.spaces.Product(...)",
                )
            )
        for part, leaf in zip(self.parts, like, strict=True):
            part.check(leaf)
