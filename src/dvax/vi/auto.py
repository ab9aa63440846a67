"""The default: the surest method that the structure of the problem allows."""

from typing import Any, ClassVar

import jax.tree_util as jtu

from .._tree import Tree
from ..errors import InputError, InputProblem
from ..programs.structure import analyse
from .abstract import AbstractSolver, Answer, Frozen
from .active_set import ActiveSet
from .bracketing import Bracketing, affine_answer, is_pointwise
from .golden_ratio import GoldenRatio
from .semismooth_newton import SemismoothNewton

_NEWTON = 1024
"""Up to so many unknowns a Jacobian is formed and factorised at each step without a thought."""


class Auto(AbstractSolver):
    """Chooses by what is proved about F and K, and by size.

    - F(y) = ay + c with one number a: the closed form y* = proj_K(−c/a), for any K (`Closed`);
    - K a pointwise interval and F pointwise: `Bracketing` (closed form where F is affine);
    - up to 1024 unknowns: `ActiveSet` on a box, `SemismoothNewton` on other sets;
    - beyond: `GoldenRatio`, which needs neither moduli nor memory.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: y + y**3 - 1.0, dvax.sets.Box(0.0, 1.0), jnp.zeros(3))
    >>> vi.solver
    'Bracketing'

    ```
    """

    def choose(self, F: Any, K: Any, like: Tree) -> AbstractSolver:
        """The solver that will be used for VI(K, F) with unknowns shaped like `like`."""
        return self.chosen(Frozen(F, K, None), like)  # pyright: ignore[reportArgumentType]

    def chosen(self, vi: Frozen, like: Tree) -> AbstractSolver:
        if analyse(vi.F, like).isotropic and not isinstance(like, tuple):
            return Closed()
        applies, _ = is_pointwise(vi, like)
        if applies:
            return Bracketing()
        size = sum(leaf.size for leaf in jtu.tree_leaves(like))
        if size > _NEWTON:
            return GoldenRatio()
        return SemismoothNewton() if vi.K.intervals(like) is None else ActiveSet()

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        return self.chosen(vi, y0).solve(vi, y0, tol)


class Closed(AbstractSolver):
    """y* = proj_K(−c/a) for F(y) = ay + c with one number a > 0 and any K: proj_K(−c/a) is the
    point with ⟨−c/a − y*, v − y*⟩ ≤ 0 for all v ∈ K, which is a ⟨F(y*)/a, v − y*⟩ ≥ 0.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: 2.0 * y - 8.0, dvax.sets.Ball(0.0, 1.0), jnp.zeros(2))
    >>> vi.solver, f"{float(vi.y[0]):.6f}"
    ('Closed', '0.707107')

    ```
    """

    certifies: ClassVar[bool] = False

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        if isinstance(y0, tuple) or not analyse(vi.F, y0).isotropic:
            raise InputError(
                InputProblem(
                    "dvax.vi.Closed",
                    "an F that is not seen to be ay + c with one number a",
                    "only then is proj_K(−c/a) the solution for every K",
                    "Use dvax.vi.Auto()",
                )
            )
        return affine_answer(vi, y0)
