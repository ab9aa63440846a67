"""`dvax.solve_vi`: one frozen variational inequality, usable on its own."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._failure import nan_derivatives_where
from .._tree import Tree
from ..programs.rounding import rounding_error
from ..sets import AbstractSet
from ..spaces import AbstractSpace, Euclidean, Product
from .abstract import RESULTS, AbstractSolver, Frozen
from .arguments import check, check_functions, checked_guess, checked_number
from .auto import Auto
from .certificate import certify
from .iteration import first_step, stopped
from .parameters import MODULUS, TOLERANCE
from .projection_error import projection_error
from .weighted import Weighted, moduli_belong_to_the_parts

IN_VAIN = RESULTS.max_steps, RESULTS.stalled, RESULTS.cycling, RESULTS.singular
"""Ends of an iteration that only missed its tolerance."""


class VISolution(eqx.Module):
    """The solution of a variational inequality with its certificate.

    `y` ∈ K; `residual` = ‖w‖ for a w ∈ F(y) + N_K(y), as computed; `rounding`, a bound on what the
    rounding of F and of w adds to it; `error_bound` ≥ ‖y − y*‖ where γ was given, else None: that is
    (residual + rounding)/γ, and the distance to the certified point where that is not y;
    `rounding_status`, "proved" where K is a pointwise interval and every operation of F has a rule
    (`dvax.programs.rounding`), else "estimated"; `iterations`, and `evaluations` of F (those for
    derivatives, for rounding, and for the certificate of a closed form, apart); `result`, which is
    `dvax.vi.RESULTS.successful` or says what went wrong; `solver`, the one that was used.
    Derivatives of a solve that failed are NaN, unless it reached the level of rounding.
    For a `dvax.vi.Weighted` operator aG these speak of G, which has the same solution.
    """

    y: Tree
    residual: jax.Array
    rounding: jax.Array
    error_bound: jax.Array | None
    iterations: jax.Array
    evaluations: jax.Array
    result: RESULTS
    solver: str = eqx.field(static=True)
    rounding_status: str = eqx.field(static=True)


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

    **Raises:** `dvax.InputError` where an argument breaks a rule or F cannot be traced, before anything
    is solved. The values of traced numbers (`gamma`, `L_F`, `tol`) are not checked.

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
    y0 = checked_guess(y0)
    check(F, K, args, solver, space)
    space = default_space(y0) if space is None else space
    K.check(y0)
    if isinstance(F, Weighted):
        moduli_belong_to_the_parts(gamma, L_F)
    solver = Auto() if solver is None else solver
    dtype = jnp.result_type(*jtu.tree_leaves(y0))
    tol = checked_number("tol", tol, TOLERANCE, dtype)
    gamma = None if gamma is None else checked_number("gamma", gamma, MODULUS, dtype)
    L_F = None if L_F is None else checked_number("L_F", L_F, MODULUS, dtype)
    args = jtu.tree_map(lambda v: jnp.asarray(v, dtype) if isinstance(v, float) else v, args)
    return _solved(F, K, y0, args, solver, tol, gamma, L_F, space)


@eqx.filter_jit
def _solved(
    F: Any, K: AbstractSet, y0: Tree, args: Any, solver: Any, tol: Any, gamma: Any, L_F: Any,
    space: AbstractSpace,
) -> VISolution:  # fmt: skip
    """One program for all problems that differ in numbers alone, compiled at the first of them."""
    check_functions(F, y0, args, space)
    if isinstance(F, Weighted):
        found = _divided(F, args, K, space, y0, solver, tol)
    else:
        frozen = Frozen(lambda y: F(y, args), K, space, gamma, L_F)
        found = _certified(frozen, y0, solver, tol, gamma, tol)
    # Where rounding allows no more than was reached, y is as good as its derivative.
    at_floor = (found.result == RESULTS.stalled) & (found.residual <= 4 * found.rounding)
    kept = (found.result == RESULTS.successful) | at_floor
    kept |= found.result == RESULTS.weight_below_bound
    hidden = jtu.tree_leaves(eqx.filter_closure_convert(F, y0, args))
    inputs = [hidden, K, y0, args, solver, tol, gamma, L_F, space]
    return nan_derivatives_where(~kept, found, eqx.filter(inputs, eqx.is_inexact_array))


def _divided(
    F: Weighted, args: Any, K: AbstractSet, space: AbstractSpace, y0: Tree, solver: Any, tol: Any
) -> VISolution:
    """Sol(K, aG) = Sol(K, G), so G is what is solved and certified; a is looked at afterwards."""
    known = F.modulus(y0, args, space)
    mu = None if known is None else known.value
    # A modulus that is proved not to be positive says nothing, and may be so in some lanes only.
    goal = tol if mu is None else tol * jnp.where(mu > 0, mu, 1.0)
    found = _certified(Frozen(lambda y: F.G(y, args), K, space), y0, solver, goal, mu, tol)
    result, bound = F.judged(found.y, args, found.result, found.error_bound)
    return dataclasses.replace(found, result=result, error_bound=bound)


def _certified(
    frozen: Frozen, y0: Tree, solver: AbstractSolver, goal: Any, gamma: Any, tol: Any
) -> VISolution:
    """Solve to the `goal` of the solver, and compare the error bound with `tol`."""
    space, K = frozen.space, frozen.K
    solver = solver.chosen(frozen, y0) if isinstance(solver, Auto) else solver
    # Where γ is known half of the tolerance is left to rounding.
    answer = solver.solve(frozen, y0, goal if gamma is None else 0.5 * goal)
    still, y = stopped(frozen), jax.lax.stop_gradient(answer.y)
    residual, away = answer.residual, jnp.zeros_like(answer.residual)
    rounding, proved = rounding_of(still, y, answer.length, residual)
    if not solver.certifies:
        # A projection step from y, whose certificate covers y by the triangle inequality.
        step = first_step(still, y, still.F(y))
        checked = certify(still.F, still.K, space, y, step)
        other, _ = rounding_of(still, checked.y, step, checked.norm)
        residual = jnp.where(answer.residual > 0, answer.residual, jnp.inf)
        nearer = checked.norm + other < residual + rounding
        residual = jnp.where(nearer, checked.norm, residual)
        rounding = jnp.where(nearer, other, rounding)
        away = jnp.where(nearer, space.norm(_tree.sub(checked.y, y)), away)
    bound, result = None, answer.result
    if gamma is not None:
        total = residual + rounding
        # Where the quotient underflows the bound is the smallest normal number: 0 says "exact".
        least = jnp.where(total > 0, jnp.finfo(total.dtype).tiny, 0.0)
        bound = jnp.where(gamma > 0, jnp.maximum(total / gamma, least) + away, jnp.inf)
        good, within = result == RESULTS.successful, bound <= tol
        # An iteration that went on in vain at the level of rounding is stalled; so is one that ended
        # where rounding alone is what keeps the bound above the tolerance.
        vain = functools.reduce(jnp.logical_or, [result == word for word in IN_VAIN])
        by_rounding = (residual <= gamma * tol) | (not solver.certifies)
        limited = (good & by_rounding) | (vain & (residual <= 4 * rounding))
        result = RESULTS.where((gamma > 0) & limited & ~within, RESULTS.stalled, result)
        result = RESULTS.where((gamma > 0) & vain & within, RESULTS.successful, result)
    status = "proved" if proved and K.intervals(y0) is not None else "estimated"
    return VISolution(
        y=answer.y,
        residual=residual,
        rounding=rounding,
        error_bound=bound,
        iterations=answer.iterations,
        evaluations=answer.evaluations,
        result=result,
        solver=type(solver).__name__,
        rounding_status=status,
    )


def rounding_of(vi: Frozen, y: Tree, length: Any, residual: Any) -> tuple[jax.Array, bool]:
    """A bound on ‖fl(w) − w‖ for some w ∈ F(y) + N_K(y), and whether that of F is proved.

    With z = fl(base − λF(base)) and y = proj_K(z), n = (z − y)/λ is a normal whatever the error of
    F(base). What is computed is F(y) + [(base − y)/λ − F(base)]: it differs from F(y) + n by the error
    of F(y), by that of z divided by λ, and by roundings of the terms. The projection onto an interval
    is exact; that onto another set is taken to be right to (8 + n)ε of the sizes in play
    (`projection_error`). A norm that underflows is less than that of n numbers of √tiny.
    """
    norm, value = vi.space.norm, vi.F(y)
    error, proved = rounding_error(vi.F, y)
    kind = jnp.finfo(jnp.result_type(*jtu.tree_leaves(y)))
    eps, entries = kind.eps, sum(leaf.size for leaf in jtu.tree_leaves(y))
    size, force = norm(y), norm(value) + residual
    if vi.K.intervals(y) is not None:
        blur = eps * (2 * size / length + 8 * force)
    else:
        of_K, places = projection_error(vi.K), 2 * (8 + entries)
        off = places * of_K.condition * eps * (size + of_K.data) + of_K.absolute * (1.0 + size)
        blur = off / length + (8 + places) * eps * force
    # Of the norms themselves, and of this sum.
    found = 1.01 * (norm(error) + blur) + jnp.sqrt(entries * jnp.asarray(kind.tiny, size.dtype))
    return jnp.where(jnp.isfinite(residual), found, jnp.inf), proved


def default_space(like: Tree) -> AbstractSpace:
    """The Euclidean space of elements shaped like `like`."""
    if isinstance(like, tuple):
        return Product(*(default_space(part) for part in like))
    return Euclidean(jnp.shape(like))
