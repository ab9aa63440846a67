"""A = a I."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractGenerator, AbstractPropagator, Growth
from .phi import flow_factors, phi_scalar


class Scalar(AbstractGenerator):
    """A = a I on any space: e^{At} = e^{at} I, so M = 1 and ω = a.

    **Arguments:** `a`: a real number, in 1/time.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> print(f"{float(dvax.generators.Scalar(-1.0).semigroup(1.0, jnp.array(1.0))):.6f}")
    0.367879

    ```
    """

    a: jax.Array

    def __init__(self, a: Any):
        self.a = _tree.as_float(a, "dvax.generators.Scalar(a)")

    def apply(self, v: Tree) -> Tree:
        return _tree.scale(self.a, v)

    def propagator(self, h: Any, terms: int) -> "ElementwisePropagator":
        return ElementwisePropagator(flow_factors(h, phi_scalar(h * self.a, terms)))

    def growth(self, space: AbstractSpace) -> Growth:
        return Growth(jnp.ones(()), self.a)


class ElementwisePropagator(AbstractPropagator):
    """Factors that multiply elementwise: A is a number or a diagonal."""

    factors: tuple[jax.Array, ...]

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        def one(*leaves: jax.Array) -> jax.Array:
            products = [f * leaf for f, leaf in zip(self.factors, leaves, strict=False)]
            return sum(products[1:], start=products[0])

        return jtu.tree_map(one, x0, *c)
