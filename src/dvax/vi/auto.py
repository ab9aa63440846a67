"""The default: the surest method that the structure of the problem allows."""

from typing import Any

from .._tree import Tree
from .abstract import AbstractSolver, Answer, Frozen
from .bracketing import Bracketing, affine_answer, is_pointwise
from .extragradient import Extragradient
from .structure import analyse


class Auto(AbstractSolver):
    """Chooses by what is proved about F and K.

    - F(y) = ay + c with one number a: the closed form y* = proj_K(−c/a), for any K;
    - K a pointwise interval and F pointwise: `Bracketing` (closed form where F is affine);
    - otherwise: `Extragradient`, with the proven step where L_F is known.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> type(dvax.vi.Auto().choose(lambda y: 2 * y, dvax.sets.Box(0.0, 1.0), jnp.zeros(3))).__name__
    'Bracketing'

    ```
    """

    def choose(self, F: Any, K: Any, like: Tree) -> AbstractSolver:
        """The solver that will be used for VI(K, F) with unknowns shaped like `like`."""
        applies, _ = is_pointwise(Frozen(F, K, None), like)  # pyright: ignore[reportArgumentType]
        return Bracketing() if applies else Extragradient()

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        if analyse(vi.F, y0).isotropic and not isinstance(y0, tuple):
            return affine_answer(vi, y0)
        return self.choose(vi.F, vi.K, y0).solve(vi, y0, tol)
