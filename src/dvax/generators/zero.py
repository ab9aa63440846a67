"""The zero generator A = 0."""

from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractGenerator, AbstractPropagator, FlowStep, Growth
from .scalar import elementwise_chord_deviation


class Zero(AbstractGenerator):
    """A = 0 on any space: e^{At} = I, M = 1 and ω = 0. The mild solution solves x' = f̃.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> float(dvax.generators.Zero().semigroup(1.0, jnp.array(2.0)))
    2.0

    ```
    """

    def apply(self, v: Tree) -> Tree:
        return jtu.tree_map(jnp.zeros_like, v)

    def propagator(self, h: Any, terms: int) -> "PolynomialIntegral":
        return PolynomialIntegral(jnp.asarray(h))

    def check(self, space: AbstractSpace) -> None:
        """Accept every space."""

    def adjoint(self, space: AbstractSpace) -> "Zero":
        return self

    def growth(self, space: AbstractSpace) -> Growth:
        return Growth(jnp.ones(()), jnp.zeros(()))

    def chord_deviation(self, step: FlowStep, space: AbstractSpace, growth: Growth) -> Tree:
        h, *ends, c = step

        def bound(*leaves: Any) -> Any:
            return elementwise_chord_deviation(jnp.zeros((), leaves[0].dtype), h, *leaves)

        return jtu.tree_map(bound, *ends, *c)


class PolynomialIntegral(AbstractPropagator):
    """x₀ + h Σⱼ cⱼ/(j + 1), since φ_{j+1}(0) = 1/(j + 1)!."""

    h: Any

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        def integrate(start: Any, *leaves: Any) -> Any:
            integrals = (leaf / (j + 1) for j, leaf in enumerate(leaves))
            return start + self.h * sum(integrals) if leaves else start

        return jtu.tree_map(integrate, x0, *c)
