"""A = A₁ ⊕ A₂ ⊕ … on tuples."""

from typing import Any

import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from ..spaces import Product as ProductSpace
from .abstract import AbstractGenerator, AbstractPropagator, Arc, Growth
from .expanded import AbstractModal, expanded


class Product(AbstractModal):
    """A (x₁, x₂, …) = (A₁x₁, A₂x₂, …): the semigroup acts part by part.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> g = dvax.generators
    >>> A = g.Product(g.Scalar(-1.0), g.Diagonal(jnp.array([-2.0, -3.0])))
    >>> A.apply((jnp.array(1.0), jnp.array([1.0, 1.0])))[1].tolist()
    [-2.0, -3.0]

    ```
    """

    parts: tuple[AbstractGenerator, ...]

    def __init__(self, *parts: AbstractGenerator):
        example = "Product(dvax.generators.Scalar(-1.0), dvax.generators.Zero())"
        _tree.check_parts(parts, AbstractGenerator, "dvax.generators.Product", example)
        self.parts = parts

    def apply(self, v: Tree) -> Tree:
        return tuple(a.apply(p) for a, p in zip(self.parts, v, strict=True))

    def expand(self, v: Tree, known: Tree = None) -> Tree:
        parts = (None,) * len(self.parts) if known is None else known
        columns = zip(self.parts, v, parts, strict=True)
        return tuple(expanded(part, own, of_it) for part, own, of_it in columns)

    def propagator(self, h: Any, terms: int) -> "ProductPropagator":
        return ProductPropagator(tuple(a.propagator(h, terms) for a in self.parts))

    def check(self, space: AbstractSpace) -> None:
        _tree.fits_parts("dvax.generators.Product", len(self.parts), space.zeros(), "state space")
        for part, own in zip(self.parts, _parts(space, len(self.parts)), strict=True):
            part.check(own)

    def adjoint(self, space: AbstractSpace) -> "Product":
        pairs = zip(self.parts, _parts(space, len(self.parts)), strict=True)
        return Product(*(part.adjoint(own) for part, own in pairs))

    def growth(self, space: AbstractSpace) -> Growth:
        pairs = zip(self.parts, _parts(space, len(self.parts)), strict=True)
        bounds = [part.growth(own) for part, own in pairs]
        # max over parts of M e^{ωt} is at most (max M) e^{(max ω)t}.
        worst = [jnp.max(jnp.stack([jnp.asarray(b[i]) for b in bounds])) for i in (0, 1)]
        return Growth(*worst)

    def bend(self, arc: Arc, space: AbstractSpace, growth: Growth) -> Tree:
        spaces = _parts(space, len(self.parts))
        columns = zip(self.parts, spaces, arc.x0, arc.x1, *arc.c, strict=True)
        return tuple(
            part.bend(Arc(arc.h, a, b, tuple(c)), own, growth) for part, own, a, b, *c in columns
        )


def _parts(space: AbstractSpace, count: int) -> tuple[AbstractSpace, ...]:
    return space.spaces if isinstance(space, ProductSpace) else (space,) * count


class ProductPropagator(AbstractPropagator):
    """Propagators of the parts, side by side."""

    parts: tuple[AbstractPropagator, ...]

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        columns = zip(self.parts, x0, *c, strict=True)
        return tuple(part.step(start, tuple(rest)) for part, start, *rest in columns)
