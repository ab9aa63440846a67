"""Semismooth Newton's method for any K."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from .. import _tree
from .._tree import Tree
from ..programs.matrix import matrix_of
from .abstract import AbstractSolver, Answer, Frozen
from .newton import Linearised, safeguarded_newton
from .parameters import SAFETY, STEPS, UNKNOWNS, check_parameters


class SemismoothNewton(AbstractSolver):
    """Newton's method for the normal map Φ(z) = F(y) + (z − y)/τ with y = proj_K(z), whose value is
    the certificate w itself: [F′(y) D + (I − D)/τ] d = −Φ(z), z⁺ = z + d, D ∈ ∂proj_K(z).

    The first step is that of the natural map y − proj_K(y − τF(y)) at the guess. A run of Newton
    steps is gone on with while it halves the best ‖w‖ at least every sixth step (after a run that
    failed, every eleventh, and so on, doubling); otherwise extragradient steps are made from where
    those stand: their own last iterate, or the last Newton point that halved it. If infinitely many
    do, ‖w‖ → 0 by construction; if finitely many, the tail is the extragradient method.
    So it converges wherever that does, and where it converges to y* the last steps are Newton's: for
    polyhedral K, strict complementarity and F in C¹, the matrix is regular with an inverse of norm at
    most about 1/γ, and the rate quadratic.
    After a run that failed, the next one waits for 1, 2, 4, 8 extragradient steps.

    Up to `dense` unknowns the matrix is formed and factorised; beyond, GMRES applies it, to
    min(0.1, ‖w‖/‖w₀‖) at first and tighter as ‖w‖ falls. For boxes `ActiveSet` is the same method
    with much smaller systems.

    **Arguments:** `step` of the safeguard, in (0, 1); `max_steps`; `dense`.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: y**3 + y - 1.0, dvax.sets.Ball(0.0, 9.0),
    ...                    jnp.ones(3), solver=dvax.vi.SemismoothNewton())
    >>> f"{float(vi.y[0]):.10f}", int(vi.iterations) < 8
    ('0.6823278038', True)

    ```
    """

    step: float = 0.7
    max_steps: int = 1000
    dense: int = 1024

    def __check_init__(self) -> None:
        check_parameters(self, step=SAFETY, max_steps=STEPS, dense=UNKNOWNS)

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        size = sum(leaf.size for leaf in jax.tree_util.tree_leaves(y0))
        linear = _factorised if size <= self.dense else _by_gmres
        return safeguarded_newton(vi, y0, tol, linear, step=self.step, max_steps=self.max_steps)


def _factorised(at: Linearised, right: Tree) -> Tree:
    flat, unravel = ravel_pytree(right)
    slope, tangent = matrix_of(at.slope, right), matrix_of(at.tangent, right)
    matrix = (at.tau * slope - jnp.eye(flat.size, dtype=flat.dtype)) @ tangent
    matrix = matrix + jnp.eye(flat.size, dtype=flat.dtype)
    return unravel(jnp.linalg.solve(matrix, flat))


def _by_gmres(at: Linearised, right: Tree) -> Tree:
    def apply(d: Tree) -> Tree:
        dy = at.tangent(d)
        return _tree.add(_tree.scale(at.tau, at.slope(dy)), _tree.sub(d, dy))

    rtol: Any = jnp.clip(at.shrunk, 1e-8, 0.1)
    move, _ = jax.scipy.sparse.linalg.gmres(apply, right, tol=rtol, atol=0.0, restart=40, maxiter=5)
    return move
