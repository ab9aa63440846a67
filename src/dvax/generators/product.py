"""Direct sums A = A₁ ⊕ A₂ ⊕ … of generators, for tuples."""

from typing import Any

import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from ..spaces import Product as ProductSpace
from .abstract import AbstractGenerator, AbstractPropagator, FlowStep, Growth
from .spectral_state import AbstractModal, expand_state


class Product(AbstractModal):
    """A (x₁, x₂, …) = (A₁x₁, A₂x₂, …); the semigroup acts on each part separately.

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

    def expand(self, v: Tree, coefficients: Tree = None) -> Tree:
        if coefficients is None:
            coefficients = (None,) * len(self.parts)
        columns = zip(self.parts, v, coefficients, strict=True)
        return tuple(expand_state(part, x, c) for part, x, c in columns)

    def propagator(self, h: Any, terms: int) -> "ProductPropagator":
        return ProductPropagator(tuple(a.propagator(h, terms) for a in self.parts))

    def check(self, space: AbstractSpace) -> None:
        _tree.fits_parts("dvax.generators.Product", len(self.parts), space.like(), "state space")
        for part, part_space in zip(self.parts, _parts(space, len(self.parts)), strict=True):
            part.check(part_space)

    def adjoint(self, space: AbstractSpace) -> "Product":
        pairs = zip(self.parts, _parts(space, len(self.parts)), strict=True)
        return Product(*(part.adjoint(part_space) for part, part_space in pairs))

    def growth(self, space: AbstractSpace) -> Growth:
        pairs = zip(self.parts, _parts(space, len(self.parts)), strict=True)
        bounds = [part.growth(part_space) for part, part_space in pairs]
        # The maximum over the parts of M e^{ωt} is at most (max M) e^{(max ω)t}.
        worst = [jnp.max(jnp.stack([jnp.asarray(b[i]) for b in bounds])) for i in (0, 1)]
        return Growth(*worst)

    def chord_deviation(self, step: FlowStep, space: AbstractSpace, growth: Growth) -> Tree:
        spaces = _parts(space, len(self.parts))
        columns = zip(self.parts, spaces, step.x0, step.x1, *step.c, strict=True)
        return tuple(
            part.chord_deviation(FlowStep(step.h, x0, x1, tuple(c)), part_space, growth)
            for part, part_space, x0, x1, *c in columns
        )


def _parts(space: AbstractSpace, count: int) -> tuple[AbstractSpace, ...]:
    return space.spaces if isinstance(space, ProductSpace) else (space,) * count


class ProductPropagator(AbstractPropagator):
    """The propagators of the parts."""

    parts: tuple[AbstractPropagator, ...]

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        columns = zip(self.parts, x0, *c, strict=True)
        return tuple(part.step(x, tuple(part_c)) for part, x, *part_c in columns)
