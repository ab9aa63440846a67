"""The primal-dual active-set method for boxes."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..programs.matrix import matrix_of
from ..programs.structure import analyse
from .abstract import AbstractSolver, Answer, FrozenVI, HasInverse
from .block import solve_block
from .matrix_free import is_self_adjoint, solve_matrix_free
from .newton import Linearisation, safeguarded_newton
from .parameters import SAFETY, STEPS, UNKNOWNS, check_parameters, describe


class ActiveSet(AbstractSolver):
    """Newton's method for K = {lower ≤ y ≤ upper}: each step predicts the active set and solves a
    linear system for the free unknowns alone.

    With y = proj_K(z), the unknowns with z ≤ lower or z ≥ upper are fixed at their bounds, and the
    others solve F′_II d_I = −F_I − F′_IA d_A. This is `SemismoothNewton` with the projection's
    derivative D = diag(0 or 1) eliminated: it has the same iterates, safeguard and convergence, whether
    F′ is symmetric or not. A factorisation costs |I|³ instead of n³. (A compiled program has arrays of
    fixed size, so the block is extracted in one of eight sizes.) If the code of F shows that it is
    affine, its matrix is formed once.

    Up to `dense` unknowns the matrix is formed. Beyond, the block is applied matrix-free, with one
    derivative of F per product: in conjugate gradients if F′ is symmetric (declared by
    `symmetric=True`, and otherwise decided by two products), and in BiCGStab followed by GMRES if not.
    Their relative tolerance is min(0.01, ‖w‖/‖w₀‖). If F′ is ill-conditioned, as a discretised
    differential operator is, a `preconditioner` saves products. The law of a `dvax.Problem` has one if
    the code of h shows that ∂h/∂u is one number: then F′ = aP⁻¹, and the block P_II is close to the
    inverse of F′_II up to a factor, which conjugate gradients do not notice.

    Source: Hintermüller, Ito and Kunisch 2002, SIAM J. Optim. 13, 865–888 (the method and its
    equivalence to a semismooth Newton method). The safeguard is not from that paper.

    **Arguments:** `step` of the safeguard, in (0, 1); `max_steps`, the maximum number of iterations (as
    in `SemismoothNewton`); `dense`; `symmetric`, declared by the caller; `preconditioner(free, r)`,
    which returns an approximate solution d of F′_II d_I = r_I: `free` is a tree of booleans, and r and
    d are 0 where it is false.

    **Raises:** `dvax.InputError` if K is not a pointwise interval.

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
    max_steps: int = 2000
    dense: int = 1024
    symmetric: bool = False
    preconditioner: Callable[[Tree, Tree], Tree] | None = None

    def __check_init__(self) -> None:
        check_parameters(self, step=SAFETY, max_steps=STEPS, dense=UNKNOWNS)
        for name, is_valid, rule in (
            ("symmetric", isinstance(self.symmetric, bool), "it must be True or False"),
            (
                "preconditioner",
                self.preconditioner is None or callable(self.preconditioner),
                "it must be callable as (free, r), or None",
            ),
        ):
            if not is_valid:
                value_text = describe(getattr(self, name))
                place = f"dvax.vi.ActiveSet({name})"
                raise input_error(place, value_text, rule, "Omit it")

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        if vi.K.intervals(y0) is None:
            raise input_error(
                "dvax.vi.ActiveSet",
                f"a {type(vi.K).__name__}, which is not a pointwise interval",
                "only a box fixes or frees each unknown separately",
                "Use dvax.vi.SemismoothNewton()",
            )
        size, affine = sum(leaf.size for leaf in jtu.tree_leaves(y0)), analyse(vi.F, y0).affine
        matrix, symmetric = None, self.symmetric
        if size <= self.dense:
            if affine:
                matrix = _constant_slope(vi, y0)
                symmetric = _is_symmetric(matrix, vi.space.weights(), y0)
            solve_linear = self._lu_solver(matrix)
        else:
            solve_linear, symmetric = self._matrix_free_solver(vi, y0)
        return safeguarded_newton(
            vi, y0, tol, solve_linear, step=self.step, max_steps=self.max_steps,
            is_affine=affine,
            is_quadratic=False if symmetric is None else jnp.asarray(symmetric) & affine,
            matrix_free=size > self.dense, is_box=True,
        )  # fmt: skip

    def _lu_solver(self, constant: Any) -> Callable[[Linearisation, Tree], Tree]:
        def solve(at: Linearisation, right: Tree) -> Tree:
            flat, unravel = ravel_pytree(right)
            matrix = matrix_of(at.slope, right) if constant is None else constant
            free = ravel_pytree(_free(at, right))[0]
            # Fixed unknowns: d = right. Free unknowns: τF′_II d_I = right_I, where d_A acts through z
            # only.
            scaled = jnp.where(free, flat / at.tau, 0.0)
            d = jnp.where(free, solve_block(matrix, free, scaled), 0.0)
            return unravel(jnp.where(free, d, flat - at.tau * (matrix @ d)))

        return solve

    def _matrix_free_solver(
        self, vi: FrozenVI, like: Tree
    ) -> tuple[Callable[[Linearisation, Tree], Tree], Any]:
        """Return the solver, and whether F′ is symmetric (None: it may change with y)."""
        weights, given = vi.space.weights(), self.preconditioner
        inverse = None if self.symmetric or given is not None else inverse_of(vi, like)
        symmetric: Any = self.symmetric or inverse is not None or None
        if symmetric is None and analyse(vi.F, like).affine:
            symmetric = is_self_adjoint(_derivative_at_zero(vi, like), like, weights)
        if self.symmetric:
            # Declared for the plain product of two vectors.
            weights = jtu.tree_map(jnp.ones_like, weights)

        def solve(at: Linearisation, right: Tree) -> Tree:
            preconditioner = None
            if inverse is not None:
                preconditioner = partial(_block_of, inverse, weights, _free(at, right))
            elif given is not None:
                preconditioner = partial(given, _free(at, right))
            return solve_matrix_free(at, right, weights, symmetric, preconditioner)

        return solve, symmetric


def _constant_slope(vi: FrozenVI, like: Tree) -> jax.Array:
    """Return the matrix of an affine F."""
    return jax.lax.stop_gradient(matrix_of(_derivative_at_zero(vi, like), like))


def _derivative_at_zero(vi: FrozenVI, like: Tree) -> Callable[[Tree], Tree]:
    return lambda d: jax.jvp(vi.F, (_tree.zeros_like(like),), (d,))[1]


def _is_symmetric(matrix: jax.Array, weights: Any, like: Tree) -> jax.Array:
    """Return whether a matrix is self-adjoint in the space with these weights, up to roundoff."""
    parts = jtu.tree_map(lambda w, v: jnp.broadcast_to(w, v.shape).astype(v.dtype), weights, like)
    # XLA takes seconds to evaluate the maximum of a large constant while it compiles.
    weighted = ravel_pytree(parts)[0][:, None] * jax.lax.optimization_barrier(matrix)
    eps = jnp.finfo(matrix.dtype).eps
    return jnp.all(jnp.abs(weighted - weighted.T) <= 64 * eps * jnp.max(jnp.abs(weighted)))


def inverse_of(vi: FrozenVI, like: Tree) -> Callable[[Tree], Tree] | None:
    """Return the inverse of F′ up to a factor, if F has one (`HasInverse`)."""
    return vi.F.inverse_up_to_a_factor(like) if isinstance(vi.F, HasInverse) else None


def _block_of(P: Callable[[Tree], Tree], weights: Any, free: Any, r: Any) -> Tree:
    """Return P_II W⁻¹ r, for r that is 0 at the fixed unknowns."""
    return jnp.where(free, P(r / weights), 0.0)


def _free(at: Linearisation, like: Tree) -> Tree:
    """Return which unknowns are free, as a tree of booleans."""
    derivative = at.tangent(jtu.tree_map(jnp.ones_like, like))
    return jtu.tree_map(lambda leaf: leaf > 0, derivative)
