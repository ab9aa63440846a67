"""The primal-dual active-set method for boxes."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..programs.matrix import matrix_of
from ..programs.structure import analyse
from .abstract import AbstractSolver, Answer, Frozen
from .block import solve_block
from .newton import Linearised, safeguarded_newton
from .parameters import SAFETY, STEPS, UNKNOWNS, check_parameters, shown


class ActiveSet(AbstractSolver):
    """Newton's method for K = {lower ≤ y ≤ upper}, where each step is a guess of the active set and a
    linear system for the free unknowns alone.

    With z = y − τF(y), the unknowns with z ≤ lower or z ≥ upper are held at their bounds and the
    others solve F′_II d_I = −F_I − F′_IA d_A. It is `SemismoothNewton` with the projection's
    derivative D = diag(0 or 1) eliminated by hand: the same iterates, the same safeguard, the same
    convergence, F symmetric or not; and a factorisation costs |I|³ instead of n³ (a compiled program
    has arrays of fixed size, so the block is cut out in one of eight sizes). Where F is affine,
    which is read off its code, its matrix is formed once.

    Up to `dense` unknowns the matrix is formed; beyond, the block is only applied (by one derivative of
    F a time), and conjugate gradients (`symmetric=True`: F′ is symmetric) or GMRES solve with it, to
    min(0.1, ‖w‖/‖w₀‖) at first and tighter as ‖w‖ falls. They need a `preconditioner` where F′ is
    ill-conditioned, as a differential operator is.

    Source: Hintermüller, Ito and Kunisch 2002, SIAM J. Optim. 13, 865–888 (the method, and that it
    is a semismooth Newton method); the safeguard is ours.

    **Arguments:** `step` of the safeguard, in (0, 1); `max_steps`; `dense`; `symmetric`, declared by
    the caller; `preconditioner(free, r)`, which returns an approximate solution of F′_II d_I = r_I,
    given where the unknowns are free (a tree of booleans) and an r that is 0 elsewhere, as d shall be.

    **Raises:** `dvax.InputError` where K is not a pointwise interval.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> M = jnp.array([[2.0, -1.0], [1.0, 3.0]])
    >>> vi = dvax.solve_vi(lambda y, args: M @ y - jnp.array([4.0, 3.0]), dvax.sets.Box(0.0, 1.0),
    ...                    jnp.zeros(2), solver=dvax.vi.ActiveSet())
    >>> [round(float(v), 12) for v in vi.y], int(vi.evaluations) <= 4
    ([1.0, 0.666666666667], True)

    ```
    """

    step: float = 0.7
    max_steps: int = 1000
    dense: int = 1024
    symmetric: bool = False
    preconditioner: Callable[[Tree, Tree], Tree] | None = None

    def __check_init__(self) -> None:
        check_parameters(self, step=SAFETY, max_steps=STEPS, dense=UNKNOWNS)
        for name, right, words in (
            ("symmetric", isinstance(self.symmetric, bool), "it must be True or False"),
            (
                "preconditioner",
                self.preconditioner is None or callable(self.preconditioner),
                "it must be callable as (free, r), or None",
            ),
        ):
            if not right:
                given = shown(getattr(self, name))
                place = f"dvax.vi.ActiveSet({name})"
                raise InputError(InputProblem(place, given, words, "Leave it out"))

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        if vi.K.intervals(y0) is None:
            raise InputError(
                InputProblem(
                    "dvax.vi.ActiveSet",
                    f"a {type(vi.K).__name__}, which is not a pointwise interval",
                    "only a box has unknowns that are held at a bound or free, one by one",
                    "Use dvax.vi.SemismoothNewton()",
                )
            )
        size = sum(leaf.size for leaf in jtu.tree_leaves(y0))
        linear = self._by_lu(vi, y0) if size <= self.dense else self._by_krylov
        return safeguarded_newton(vi, y0, tol, linear, step=self.step, max_steps=self.max_steps)

    def _by_lu(self, vi: Frozen, y0: Tree) -> Callable[[Linearised, Tree], Tree]:
        constant = None
        if analyse(vi.F, y0).affine:
            zero = _tree.zeros_like(y0)
            apply = lambda d: jax.jvp(vi.F, (zero,), (d,))[1]  # noqa: E731
            constant = jax.lax.stop_gradient(matrix_of(apply, y0))

        def solve(at: Linearised, right: Tree) -> Tree:
            flat, unravel = ravel_pytree(right)
            matrix = matrix_of(at.slope, right) if constant is None else constant
            free = ravel_pytree(_free(at, right))[0]
            # The held ones: d = right. The free ones: τF′_II d_I = right_I, d_A acting through z only.
            scaled = jnp.where(free, flat / at.tau, 0.0)
            d = jnp.where(free, solve_block(matrix, free, scaled), 0.0)
            return unravel(jnp.where(free, d, flat - at.tau * (matrix @ d)))

        return solve

    def _by_krylov(self, at: Linearised, right: Tree) -> Tree:
        free = _free(at, right)
        inside = lambda d: jtu.tree_map(lambda f, v: jnp.where(f, v, 0.0), free, d)  # noqa: E731
        apply = lambda d: inside(at.slope(d))  # noqa: E731  (d is 0 where held, and stays so)
        given = self.preconditioner
        M = None if given is None else lambda r: given(free, r)
        aim = inside(_tree.scale(1.0 / at.tau, right))
        rtol: Any = jnp.clip(at.shrunk, 1e-10, 0.1)
        if self.symmetric:
            d, _ = jax.scipy.sparse.linalg.cg(apply, aim, tol=rtol, maxiter=1000, M=M)
        else:
            d, _ = jax.scipy.sparse.linalg.gmres(
                apply, aim, tol=rtol, atol=0.0, restart=40, maxiter=10, M=M
            )
        held = _tree.sub(right, _tree.scale(at.tau, at.slope(d)))
        return jtu.tree_map(jnp.where, free, d, held)


def _free(at: Linearised, like: Tree) -> Tree:
    moved = at.tangent(jtu.tree_map(jnp.ones_like, like))
    return jtu.tree_map(lambda leaf: leaf > 0, moved)
