"""`dvax.solve_vi`: one frozen variational inequality, usable on its own."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..sets import AbstractSet
from ..spaces import AbstractSpace, Euclidean, Product
from .abstract import RESULTS, AbstractSolver, Frozen
from .auto import Auto
from .certificate import certify
from .iteration import first_step, stopped
from .weighted import Weighted, moduli_belong_to_the_parts


class VISolution(eqx.Module):
    """The solution of a variational inequality with its certificate.

    `y` ∈ K; `residual` = ‖w‖ for a w ∈ F(y) + N_K(y); `error_bound` ≥ ‖y − y*‖ where γ was given,
    else None; `iterations`, and `evaluations` of F (those for derivatives, and for the certificate of
    a closed form, apart); `result`, which is `dvax.vi.RESULTS.successful` or says what went wrong;
    `solver`, the one that was used.
    For a `dvax.vi.Weighted` operator aG these speak of G, which has the same solution.
    """

    y: Tree
    residual: jax.Array
    error_bound: jax.Array | None
    iterations: jax.Array
    evaluations: jax.Array
    result: RESULTS
    solver: str = eqx.field(static=True)


def solve_vi(
    F: Callable[[Tree, Any], Tree] | Weighted,
    K: AbstractSet,
    y0: Tree,
    args: Any = None,
    solver: AbstractSolver | None = None,
    tol: Any = 1e-10,
    gamma: Any = None,
    L_F: Any = None,
    space: AbstractSpace | None = None,
) -> VISolution:
    """Find y ∈ K with ⟨F(y), v − y⟩ ≥ 0 for all v ∈ K (paper, eq:vi_canonical).

    **Arguments:** `F(y, args)`, traceable; `K`, a set; `y0`, a guess, whose shape is y's; `args`,
    any pytree; `solver`, `dvax.vi.Auto()` by default; `tol`, on the true error ‖y − y*‖ where
    `gamma` is given, else on the residual ‖w‖; `gamma`, the modulus of strong pseudomonotonicity,
    declared by the caller; `L_F`, a Lipschitz constant of F; `space`, Euclidean by default.
    An F = aG that is a `dvax.vi.Weighted` is solved and certified as VI(K, G), by its own moduli.

    The solve is compiled at the first call and used again for the same function F, shapes and
    solver, however `args`, `K`, `y0` and the moduli change. So what changes goes through `args`, as
    for any function under `jax.jit`: a number that F reads from outside is seen once.

    **Returns:** a `VISolution`. Iterative methods stop by its `residual`; a closed form or a bracketed
    root is right to rounding whatever `tol`, and gets its `residual` by a projection step afterwards.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: 2.0 * y - args, dvax.sets.Box(0.0, 1.0),
    ...                    jnp.zeros(2), args=jnp.array([1.0, 5.0]), gamma=2.0)
    >>> vi.y.tolist(), bool(vi.error_bound < 1e-10)
    ([0.5, 1.0], True)

    ```
    """
    y0 = _tree.as_float(y0, "y0")
    space = default_space(y0) if space is None else space
    K.check(y0)
    if isinstance(F, Weighted):
        moduli_belong_to_the_parts(gamma, L_F)
    solver = Auto() if solver is None else solver
    # Numbers as arrays: of a number written in the code the compiled program would be a program of
    # its own.
    dtype = jnp.result_type(*jtu.tree_leaves(y0))
    tol, gamma, L_F = (
        jnp.asarray(value, dtype) if isinstance(value, float | int) else value
        for value in (tol, gamma, L_F)
    )
    return _solved(F, K, y0, args, solver, tol, gamma, L_F, space)


@eqx.filter_jit
def _solved(
    F: Any, K: AbstractSet, y0: Tree, args: Any, solver: Any, tol: Any, gamma: Any, L_F: Any,
    space: AbstractSpace,
) -> VISolution:  # fmt: skip
    """One program for all problems that differ in numbers alone, compiled at the first of them."""
    if isinstance(F, Weighted):
        return _divided(F, args, K, space, y0, solver, tol)
    return _certified(Frozen(lambda y: F(y, args), K, space, gamma, L_F), y0, solver, tol, gamma)


def _divided(
    F: Weighted, args: Any, K: AbstractSet, space: AbstractSpace, y0: Tree, solver: Any, tol: Any
) -> VISolution:
    """Sol(K, aG) = Sol(K, G), so G is what is solved and certified; a is looked at afterwards."""
    known = F.modulus(y0, args, space)
    mu = None if known is None else known.value
    # A modulus that is proved not to be positive says nothing, and may be so in some lanes only.
    goal = tol if mu is None else tol * jnp.where(mu > 0, mu, 1.0)
    found = _certified(Frozen(lambda y: F.G(y, args), K, space), y0, solver, goal, mu)
    result, bound = F.judged(found.y, args, found.result, found.error_bound)
    return dataclasses.replace(found, result=result, error_bound=bound)


def _certified(
    frozen: Frozen, y0: Tree, solver: AbstractSolver, tol: Any, gamma: Any
) -> VISolution:
    space = frozen.space
    solver = solver.chosen(frozen, y0) if isinstance(solver, Auto) else solver
    answer = solver.solve(frozen, y0, tol)
    residual, away = answer.residual, jnp.zeros_like(answer.residual)
    if not solver.certifies:
        # A projection step from y, whose certificate covers y by the triangle inequality.
        still, y = stopped(frozen), jax.lax.stop_gradient(answer.y)
        checked = certify(still.F, still.K, space, y, first_step(still, y, still.F(y)))
        residual = jnp.where(answer.residual > 0, answer.residual, jnp.inf)
        nearer = checked.norm < residual
        residual = jnp.where(nearer, checked.norm, residual)
        away = jnp.where(nearer, space.norm(_tree.sub(checked.y, y)), away)
    bound = None
    if gamma is not None:
        bound = jnp.where(gamma > 0, residual / gamma + away, jnp.inf)
    return VISolution(
        y=answer.y,
        residual=residual,
        error_bound=bound,
        iterations=answer.iterations,
        evaluations=answer.evaluations,
        result=answer.result,
        solver=type(solver).__name__,
    )


def default_space(like: Tree) -> AbstractSpace:
    """The Euclidean space of elements shaped like `like`."""
    if isinstance(like, tuple):
        return Product(*(default_space(part) for part in like))
    return Euclidean(jnp.shape(like))
