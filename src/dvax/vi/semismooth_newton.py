"""Semismooth Newton's method for any K."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from .._small_matrices import product, solve_constant
from .._tree import Tree
from ..programs.matrix import matrix_of
from ..programs.structure import analyse
from .abstract import AbstractSolver, Answer, FrozenVI
from .matrix_free import solve_matrix_free
from .newton import Linearisation, safeguarded_newton
from .parameters import SAFETY, STEPS, UNKNOWNS, check_parameters


class SemismoothNewton(AbstractSolver):
    """Newton's method for the normal map Φ(z) = F(y) + (z − y)/τ with y = proj_K(z), whose value is
    the certificate w: [F′(y) D + (I − D)/τ] d = −Φ(z), z⁺ = z + d, D ∈ ∂proj_K(z).

    The first step starts at z = y₀, the guess. A run of Newton steps continues while it halves the best
    ‖w‖ at least every sixth step (after a failed run every eleventh, and so on, doubling). If the code
    of F shows that it is affine, the run ends at a cycle, and no point is rejected for a large ‖w‖.
    Otherwise extragradient steps are made, from their own last iterate or from the last Newton point
    that halved ‖w‖. After failed runs, 1, 2, 4, then 8 or more of them precede the next.

    An iteration is one projection and one evaluation of F: a Newton step, or the predictor or the
    corrector of an extragradient step (or a predictor whose step is then shortened). The projection of
    the guess is the first.

    If infinitely many Newton steps halve ‖w‖, then ‖w‖ → 0; if finitely many do, the tail is the
    extragradient method. So the method converges wherever the extragradient method does. Near y* the
    last steps are Newton steps: for polyhedral K, strict complementarity and F in C¹, the matrix is
    regular with an inverse of norm at most about 1/γ, and convergence is quadratic.

    Up to `dense` unknowns the matrix is formed and factorised. Beyond, Krylov methods apply it, with
    the relative tolerance min(0.01, ‖w‖/‖w₀‖): conjugate gradients if two products show that F′ is
    symmetric, and otherwise BiCGStab followed by GMRES. For boxes, `ActiveSet` is the same method with
    much smaller systems.

    **Arguments:** `step` of the safeguard, in (0, 1); `max_steps`, the maximum number of iterations;
    `dense`.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: y**3 + y - 1.0, dvax.sets.Ball(0.0, 9.0),
    ...                    jnp.ones(3), solver=dvax.vi.SemismoothNewton())
    >>> f"{float(vi.y[0]):.10f}", int(vi.iterations) < 8
    ('0.6823278038', True)

    ```
    """

    step: float = 0.7
    max_steps: int = 2000
    dense: int = 1024

    def __check_init__(self) -> None:
        check_parameters(self, step=SAFETY, max_steps=STEPS, dense=UNKNOWNS)

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        size = sum(leaf.size for leaf in jax.tree_util.tree_leaves(y0))
        solve_linear = _solve_by_lu
        if size > self.dense:
            solve_linear = partial(_solve_matrix_free, vi.space.weights())
        return safeguarded_newton(
            vi,
            y0,
            tol,
            solve_linear,
            step=self.step,
            max_steps=self.max_steps,
            is_affine=analyse(vi.F, y0).affine,
            matrix_free=size > self.dense,
        )


def _solve_by_lu(at: Linearisation, right: Tree) -> Tree:
    flat, unravel = ravel_pytree(right)
    slope, tangent = matrix_of(at.slope, right), matrix_of(at.tangent, right)
    identity = jnp.eye(flat.size, dtype=flat.dtype)
    matrix = product(at.tau * slope - identity, tangent) + identity
    return unravel(solve_constant(matrix, flat))


def _solve_matrix_free(weights: Tree, at: Linearisation, right: Tree) -> Tree:
    return solve_matrix_free(at, right, weights)
