"""The default solver, which selects a method from the structure and size of the problem."""

from typing import Any, ClassVar

import jax.tree_util as jtu

from .._tree import Tree
from ..errors import input_error
from ..programs.structure import analyse
from .abstract import AbstractSolver, Answer, FrozenVI
from .active_set import ActiveSet
from .bracketing import Bracketing, affine_answer, is_pointwise
from .lemke import Lemke, is_affine_on_polyhedron
from .semismooth_newton import SemismoothNewton

_LARGE_MAX_STEPS = 20_000
"""Maximum number of iterations without a matrix: each costs little, and if Newton's method cannot find
the active set among thousands of unknowns, the extragradient steps of the safeguard take thousands."""


class Auto(AbstractSolver):
    """Select a solver from the proved structure of F and K, and from the number of unknowns.

    - F(y) = ay + c with one number a: the closed form y* = proj_K(−c/a), for any K (`ClosedForm`);
    - K a pointwise interval and F pointwise: `Bracketing` (closed form where F is affine);
    - F affine, K a simplex or a polyhedron of at most 16 unknowns: `Lemke`;
    - otherwise `ActiveSet` on a box, `SemismoothNewton` on other sets. Beyond 1024 unknowns both form
      no matrix.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: y + y**3 - 1.0, dvax.sets.Box(0.0, 1.0), jnp.zeros(3))
    >>> vi.solver
    'Bracketing'

    ```
    """

    def choose(self, F: Any, K: Any, like: Tree) -> AbstractSolver:
        """Return the solver for VI(K, F) with unknowns shaped like `like`."""
        return self.choose_for(FrozenVI(F, K, None), like)  # pyright: ignore[reportArgumentType]

    def choose_for(self, vi: FrozenVI, like: Tree) -> AbstractSolver:
        """Return the solver for `vi`, as `choose` does."""
        if analyse(vi.F, like).isotropic and not isinstance(like, tuple):
            return ClosedForm()
        if is_pointwise(vi, like):
            return Bracketing()
        is_large = sum(leaf.size for leaf in jtu.tree_leaves(like)) > ActiveSet.dense
        max_steps = _LARGE_MAX_STEPS if is_large else ActiveSet.max_steps
        if vi.K.intervals(like) is not None:
            return ActiveSet(max_steps=max_steps)
        if is_affine_on_polyhedron(vi, like):
            return Lemke()
        return SemismoothNewton(max_steps=max_steps)

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        return self.choose_for(vi, y0).solve(vi, y0, tol)


class ClosedForm(AbstractSolver):
    """y* = proj_K(−c/a) for F(y) = ay + c with one number a > 0 and any K.

    The projection satisfies ⟨−c/a − y*, v − y*⟩ ≤ 0 for all v ∈ K, that is ⟨F(y*)/a, v − y*⟩ ≥ 0.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: 2.0 * y - 8.0, dvax.sets.Ball(0.0, 1.0), jnp.zeros(2))
    >>> vi.solver, f"{float(vi.y[0]):.6f}"
    ('ClosedForm', '0.707107')

    ```
    """

    certifies: ClassVar[bool] = False

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        if isinstance(y0, tuple) or not analyse(vi.F, y0).isotropic:
            raise input_error(
                "dvax.vi.ClosedForm",
                "an F that its code does not show to be ay + c with one number a",
                "only for such an F is proj_K(−c/a) the solution for every K",
                "Use dvax.vi.Auto()",
            )
        return affine_answer(vi, y0)
