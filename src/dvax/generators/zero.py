"""A = 0."""

from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractGenerator, AbstractPropagator, Arc, Growth
from .scalar import elementwise_bend


class Zero(AbstractGenerator):
    """A = 0 on any space: e^{At} = I, so M = 1 and ω = 0, and the mild solution is that of x' = f̃.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> float(dvax.generators.Zero().semigroup(1.0, jnp.array(2.0)))
    2.0

    ```
    """

    def apply(self, v: Tree) -> Tree:
        return jtu.tree_map(jnp.zeros_like, v)

    def propagator(self, h: Any, terms: int) -> "Sum":
        return Sum(jnp.asarray(h))

    def check(self, space: AbstractSpace) -> None:
        """It acts on everything."""

    def adjoint(self, space: AbstractSpace) -> "Zero":
        return self

    def growth(self, space: AbstractSpace) -> Growth:
        return Growth(jnp.ones(()), jnp.zeros(()))

    def bend(self, arc: Arc, space: AbstractSpace, growth: Growth) -> Tree:
        zero = lambda leaf: jnp.zeros((), leaf.dtype)  # noqa: E731
        h, *ends, c = arc
        return jtu.tree_map(lambda *v: elementwise_bend(zero(v[0]), h, *v), *ends, *c)


class Sum(AbstractPropagator):
    """x₀ + h Σⱼ cⱼ/(j + 1), since φ_{j+1}(0) = 1/(j + 1)!."""

    h: Any

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        def one(start: Any, *leaves: Any) -> Any:
            shares = (leaf / (j + 1) for j, leaf in enumerate(leaves))
            return start + self.h * sum(shares) if leaves else start

        return jtu.tree_map(one, x0, *c)
