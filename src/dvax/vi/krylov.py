"""Krylov methods for linear systems without a matrix and without symmetry."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree

_RESTART, _RESTARTS = 50, 20


def solve_general(
    apply: Callable[[Tree], Tree], b: Tree, rtol: Any, steps: int,
    preconditioner: Callable[[Tree], Tree] | None = None,
) -> Tree:  # fmt: skip
    """Return d with ‖apply(d) − b‖ ≤ rtol ‖b‖, or the last iterate of GMRES.

    BiCGStab, with at most `steps` steps, takes a fraction of the time of GMRES, but fails if the
    operator is nearly skew. Then GMRES continues; otherwise it finds the residual within the tolerance,
    and ends at once.
    """
    d, _ = jax.scipy.sparse.linalg.bicgstab(apply, b, tol=rtol, maxiter=steps, M=preconditioner)
    residual = _tree.sub(b, apply(d))
    is_better = _tree.dot(residual, residual) < _tree.dot(b, b)
    d = jtu.tree_map(lambda v: jnp.where(is_better, v, 0.0), d)
    d, _ = jax.scipy.sparse.linalg.gmres(
        apply, b, x0=d, tol=rtol, atol=0.0, restart=_RESTART, maxiter=_RESTARTS, M=preconditioner
    )
    return d
