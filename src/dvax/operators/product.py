"""Direct sums P = P₁ ⊕ P₂ ⊕ … of operators, for tuples."""

import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from ..spaces import Product as ProductSpace
from .abstract import AbstractOperator, Spectrum


class Product(AbstractOperator):
    """P (u₁, u₂, …) = (P₁u₁, P₂u₂, …).

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> P = dvax.operators.Product(dvax.operators.Scaling(2.0), dvax.operators.Scaling(3.0))
    >>> [float(v) for v in P.apply((jnp.array(1.0), jnp.array(1.0)))]
    [2.0, 3.0]

    ```
    """

    parts: tuple[AbstractOperator, ...]

    def __init__(self, *parts: AbstractOperator):
        example = "Product(dvax.operators.Scaling(1.0), dvax.operators.Scaling(2.0))"
        _tree.check_parts(parts, AbstractOperator, "dvax.operators.Product", example)
        self.parts = parts

    def apply(self, v: Tree) -> Tree:
        return tuple(p.apply(q) for p, q in zip(self.parts, v, strict=True))

    def inverse(self, v: Tree) -> Tree:
        return tuple(p.inverse(q) for p, q in zip(self.parts, v, strict=True))

    def check(self, space: AbstractSpace) -> None:
        _tree.fits_parts("dvax.operators.Product", len(self.parts), space.like(), "control space")
        for part, part_space in zip(self.parts, _parts(space, len(self.parts)), strict=True):
            part.check(part_space)

    def spectrum(self, space: AbstractSpace) -> Spectrum:
        pairs = zip(self.parts, _parts(space, len(self.parts)), strict=True)
        spectra = [part.spectrum(part_space) for part, part_space in pairs]
        return Spectrum(
            jnp.min(jnp.stack([jnp.asarray(s.m) for s in spectra])),
            jnp.max(jnp.stack([jnp.asarray(s.norm) for s in spectra])),
            exact=all(s.exact for s in spectra),
            declared=any(s.declared for s in spectra),
        )


def _parts(space: AbstractSpace, count: int) -> tuple[AbstractSpace, ...]:
    return space.spaces if isinstance(space, ProductSpace) else (space,) * count
