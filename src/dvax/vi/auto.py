"""The default: the surest method that the structure of the problem allows."""

from typing import Any

from .._tree import Tree
from .abstract import AbstractSolver, Answer, Frozen
from .bracketing import Bracketing, is_pointwise
from .extragradient import Extragradient


class Auto(AbstractSolver):
    """Chooses by what is proved about F and K.

    - K a pointwise interval and F pointwise: `Bracketing` (closed form where F is affine);
    - otherwise: `Extragradient`, with the proven step where L_F is known.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> dvax.vi.Auto().choose(lambda y: 2 * y, dvax.sets.Box(0.0, 1.0), jnp.zeros(3))
    Bracketing(max_steps=200)

    ```
    """

    def choose(self, F: Any, K: Any, like: Tree) -> AbstractSolver:
        """The solver that will be used for VI(K, F) with unknowns shaped like `like`."""
        applies, _ = is_pointwise(Frozen(F, K, None), like)  # pyright: ignore[reportArgumentType]
        return Bracketing() if applies else Extragradient()

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        return self.choose(vi.F, vi.K, y0).solve(vi, y0, tol)
