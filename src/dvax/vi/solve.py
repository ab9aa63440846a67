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
from .abstract import RESULTS, AbstractSolver, FrozenVI
from .arguments import as_guess, as_number, check, check_functions
from .auto import Auto
from .certificate import certify
from .iteration import first_step, without_derivatives
from .parameters import MODULUS, TOLERANCE
from .projection_error import condition_at, rounding_of_w
from .weighted import Weighted, reject_moduli_of_product

_MISSED_TOLERANCE = RESULTS.max_steps, RESULTS.stalled, RESULTS.cycling, RESULTS.singular


class VISolution(eqx.Module):
    """The solution of a variational inequality with its certificate.

    - `y` ∈ K;
    - `residual`, ‖w‖ for a w ∈ F(y) + N_K(y), as computed;
    - `rounding`, a bound on the rounding error of that norm, from F and from w;
    - `error_bound` ≥ ‖y − y*‖, None if γ was not given: (residual + rounding)/γ, plus the distance from
      y to the certified point if that is another one;
    - `iterations`; `evaluations` of F, without those for derivatives, for rounding, and for the
      certificate of a closed form;
    - `result`, `dvax.vi.RESULTS.successful` or the reason of the failure;
    - `solver`, the name of the solver used;
    - `rounding_status`, "proved" if K is a pointwise interval and every operation of F has a rule
      (`dvax.programs.rounding`), otherwise "estimated".

    The derivatives of a failed solve are NaN, unless it reached the roundoff floor. For a
    `dvax.vi.Weighted` operator aG all fields refer to G, which has the same solution.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.Box(0.0, 1.0)
    >>> F, q = lambda y, q: y + y**3 - q, jnp.array([0.625, 5.0])
    >>> vi = dvax.solve_vi(F, K, jnp.zeros(2), q, gamma=1.0)
    >>> vi.y.round(9).tolist(), vi.solver, bool(vi.error_bound < 1e-10)
    ([0.5, 1.0], 'Bracketing', True)

    ```
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
    `gamma` is given, otherwise on the residual ‖w‖; `gamma`, the modulus of strong pseudomonotonicity,
    declared by the caller; `L_F`, a Lipschitz constant of F; `space`, Euclidean by default.
    A `dvax.vi.Weighted` operator F = aG is solved and certified as VI(K, G), with its own moduli.

    The solve is compiled at the first call and reused for the same function F, shapes and solver, for
    any values of `args`, `K`, `y0` and the moduli. Pass values that change in `args`, as for any
    function under `jax.jit`: a number that F reads from its closure is read only at compilation.

    **Raises:** `dvax.InputError` if an argument is invalid or F cannot be traced, before the solve
    starts. The values of traced numbers (`gamma`, `L_F`, `tol`) are not checked.

    **Returns:** a `VISolution`. Iterative methods stop when its `residual` meets the tolerance. A
    closed form or a bracketed root is accurate to rounding whatever `tol`; its `residual` is
    computed afterwards by a projection step.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: 2.0 * y - args, dvax.sets.Box(0.0, 1.0),
    ...                    jnp.zeros(2), args=jnp.array([1.0, 5.0]), gamma=2.0)
    >>> vi.y.tolist(), bool(vi.error_bound < 1e-10)
    ([0.5, 1.0], True)

    ```
    """
    y0 = as_guess(y0)
    check(F, K, args, solver, space)
    space = default_space(y0) if space is None else space
    K.check(y0)
    if isinstance(F, Weighted):
        reject_moduli_of_product(gamma, L_F)
    solver = Auto() if solver is None else solver
    dtype = jnp.result_type(*jtu.tree_leaves(y0))
    tol = as_number("tol", tol, TOLERANCE, dtype)
    gamma = None if gamma is None else as_number("gamma", gamma, MODULUS, dtype)
    L_F = None if L_F is None else as_number("L_F", L_F, MODULUS, dtype)
    args = jtu.tree_map(lambda v: jnp.asarray(v, dtype) if isinstance(v, float) else v, args)
    return _solve_compiled(F, K, y0, args, solver, tol, gamma, L_F, space)


@eqx.filter_jit
def _solve_compiled(
    F: Any, K: AbstractSet, y0: Tree, args: Any, solver: Any, tol: Any, gamma: Any, L_F: Any,
    space: AbstractSpace,
) -> VISolution:  # fmt: skip
    """Solve and certify; compiled once for all problems that differ in array values alone."""
    check_functions(F, y0, args, space)
    if isinstance(F, Weighted):
        solution = _solve_weighted(F, args, K, space, y0, solver, tol)
    else:
        frozen = FrozenVI(lambda y: F(y, args), K, space, gamma, L_F)
        solution = _solve_and_certify(frozen, y0, solver, tol, gamma, tol)
    # A solution at the roundoff floor keeps its derivatives.
    at_floor = (solution.result == RESULTS.stalled) & (solution.residual <= 4 * solution.rounding)
    has_derivatives = (solution.result == RESULTS.successful) | at_floor
    has_derivatives |= solution.result == RESULTS.weight_below_bound
    closure = jtu.tree_leaves(eqx.filter_closure_convert(F, y0, args))
    inputs = [closure, K, y0, args, solver, tol, gamma, L_F, space]
    return nan_derivatives_where(
        ~has_derivatives, solution, eqx.filter(inputs, eqx.is_inexact_array)
    )


def _solve_weighted(
    F: Weighted, args: Any, K: AbstractSet, space: AbstractSpace, y0: Tree, solver: Any, tol: Any
) -> VISolution:
    """Solve and certify VI(K, G), which has the solutions of VI(K, aG), and then check a at y."""
    modulus = F.modulus(y0, args, space)
    mu = None if modulus is None else modulus.value
    # A modulus may be proved not to be positive, possibly in some lanes of a batch only. It then gives
    # no error bound, and the tolerance applies to the residual.
    residual_tol = tol if mu is None else tol * jnp.where(mu > 0, mu, 1.0)
    solution = _solve_and_certify(
        FrozenVI(lambda y: F.G(y, args), K, space), y0, solver, residual_tol, mu, tol
    )
    result, bound = F.check_weight(solution.y, args, solution.result, solution.error_bound)
    return dataclasses.replace(solution, result=result, error_bound=bound)


def _solve_and_certify(
    frozen: FrozenVI, y0: Tree, solver: AbstractSolver, solver_tol: Any, gamma: Any, tol: Any
) -> VISolution:
    """Solve to the tolerance `solver_tol`, and compare the error bound with `tol`."""
    space, K = frozen.space, frozen.K
    solver = solver.choose_for(frozen, y0) if isinstance(solver, Auto) else solver
    # If γ is known, half of the tolerance is reserved for rounding.
    answer = solver.solve(frozen, y0, solver_tol if gamma is None else 0.5 * solver_tol)
    vi, y = without_derivatives(frozen), jax.lax.stop_gradient(answer.y)
    residual, distance = answer.residual, jnp.zeros_like(answer.residual)
    condition = condition_at(K, y, space)
    rounding, proved = rounding_of(vi, y, answer.residual_step, residual, condition)
    if not solver.certifies:
        # A projection step from y has a certificate, which bounds the error of y by the triangle
        # inequality.
        step = first_step(vi, y, vi.F(y))
        projected = certify(vi.F, vi.K, space, y, step)
        projected_rounding, _ = rounding_of(vi, projected.y, step, projected.norm, condition)
        residual = jnp.where(answer.residual > 0, answer.residual, jnp.inf)
        # A formula has no step of its own, and so no rounding of a certificate.
        rounding = jnp.where(jnp.isfinite(residual), rounding, jnp.inf)
        smaller = projected.norm + projected_rounding < residual + rounding
        residual = jnp.where(smaller, projected.norm, residual)
        rounding = jnp.where(smaller, projected_rounding, rounding)
        distance = jnp.where(smaller, space.norm(_tree.sub(projected.y, y)), distance)
    bound, result = None, answer.result
    if gamma is not None:
        total = residual + rounding
        # If the quotient underflows, the bound is the smallest normal number, since 0 means "exact".
        least = jnp.where(total > 0, jnp.finfo(total.dtype).tiny, 0.0)
        bound = jnp.where(gamma > 0, jnp.maximum(total / gamma, least) + distance, jnp.inf)
        successful, within = result == RESULTS.successful, bound <= tol
        # The result is "stalled" if rounding alone keeps the bound above the tolerance, whether the
        # iteration met its own tolerance or missed it at the roundoff floor.
        missed = missed_tolerance(result)
        by_rounding = (residual <= gamma * tol) | (not solver.certifies)
        at_floor = (successful & by_rounding) | (missed & (residual <= 4 * rounding))
        result = RESULTS.where((gamma > 0) & at_floor & ~within, RESULTS.stalled, result)
        result = RESULTS.where((gamma > 0) & missed & within, RESULTS.successful, result)
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


def missed_tolerance(result: RESULTS) -> Any:
    """Return whether an iteration ended without an error, but above its tolerance."""
    return functools.reduce(jnp.logical_or, [result == code for code in _MISSED_TOLERANCE])


def rounding_of(
    vi: FrozenVI, y: Tree, step: Any, residual: Any, condition: Any = 1.0
) -> tuple[jax.Array, bool]:
    """Return a bound on ‖fl(w) − w‖ for some w ∈ F(y) + N_K(y), and whether the error of F is proved.

    With z = fl(b − λF(b)) and y = proj_K(z), n = (z − y)/λ is in N_K(y), whatever the error of
    F(b). The computed w is F(y) + [(b − y)/λ − F(b)] with λ = `step`. It differs from F(y) + n by
    the error of F(y), the error of z divided by λ, and the rounding of the terms (`rounding_of_w`). A
    norm that underflows is less than that of n numbers of √tiny. `condition`: of the active rows of K.
    """
    norm, value = vi.space.norm, vi.F(y)
    error, proved = rounding_error(vi.F, y)
    kind = jnp.finfo(jnp.result_type(*jtu.tree_leaves(y)))
    entries = sum(leaf.size for leaf in jtu.tree_leaves(y))
    error_w = rounding_of_w(vi.K, y, norm(y), norm(value) + residual, step, condition)
    # The factor 1.01 covers the rounding of the norms and of this sum.
    underflow = jnp.sqrt(entries * jnp.asarray(kind.tiny, error_w.dtype))
    bound = 1.01 * (norm(error) + error_w) + underflow
    return jnp.where(jnp.isfinite(residual), bound, jnp.inf), proved


def default_space(like: Tree) -> AbstractSpace:
    """Return the Euclidean space of elements shaped like `like`.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> space = dvax.vi.default_space(jnp.zeros(3))
    >>> float(space.norm(jnp.array([2.0, 3.0, 6.0])))
    7.0

    ```
    """
    if isinstance(like, tuple):
        return Product(*(default_space(part) for part in like))
    return Euclidean(jnp.shape(like))
