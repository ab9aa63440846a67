"""Lemke's method for affine laws on small polyhedral sets."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._small_matrices import MAX_ROWS, eliminate, times
from .._tree import Tree
from ..errors import input_error
from ..programs.matrix import matrix_of
from ..programs.structure import analyse
from ..sets import AbstractSet, Polyhedron, Simplex
from ..sets.affine import normalised_conditions
from .abstract import AbstractSolver, Answer, FrozenVI
from .golden_ratio import golden_ratio
from .parameters import STEPS, check_parameters

_MAX_CONDITIONS = 2 * MAX_ROWS
"""Largest number of inequalities: a tableau of this size is updated in microseconds."""


class Lemke(AbstractSolver):
    """Lemke's method for F(y) = My + q on K = {G y ≤ d, E y = e}, a finite method.

    With the multipliers λ ≥ 0 of the inequalities and μ of the equations,

        [M Eᵀ; E 0] (y, μ) = (−q − Gᵀλ, e),   w = d − G y ≥ 0,   λ ⊥ w,

    so w = c + Nλ: a linear complementarity problem of the size of d. Complementary pivoting solves it
    if M is positive definite, symmetric or not, in about as many pivots as rows become active.

    The result is certified, and where pivoting failed it is replaced, by iterations of `GoldenRatio`
    from y (from the guess, if pivoting failed): one iteration is the certificate. They converge for
    every strongly pseudomonotone F.

    Source: Lemke 1965, Management Science 11, 681–689; Cottle, Pang and Stone, *The Linear
    Complementarity Problem*, Section 4.4.

    **Arguments:** `max_steps`, the maximum number of iterations of `GoldenRatio`.

    **Raises:** `dvax.InputError` if the code of F does not show that F is affine, or K is not a
    `Simplex` of one vector or a `Polyhedron` without equations, of at most 16 unknowns and 32 rows.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> M = jnp.array([[2.0, -1.0], [1.0, 3.0]])
    >>> vi = dvax.solve_vi(lambda y, args: M @ y - 1.0, dvax.sets.Simplex(1.0), jnp.zeros(2),
    ...                    solver=dvax.vi.Lemke())
    >>> [round(float(v), 12) for v in vi.y], int(vi.iterations)
    ([0.8, 0.2], 1)

    ```
    """

    max_steps: int = 20_000

    def __check_init__(self) -> None:
        check_parameters(self, max_steps=STEPS)

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        if not is_affine_on_polyhedron(vi, y0):
            raise input_error(
                "dvax.vi.Lemke",
                f"an F on a {type(vi.K).__name__} of {_tree.shapes(y0)}",
                "the code of F must show that F is affine, and K must be a simplex or a polyhedron "
                f"without equations, of at most {MAX_ROWS} unknowns and {_MAX_CONDITIONS} rows",
                "Use dvax.vi.SemismoothNewton()",
            )
        fixed = vi._replace(K=jax.tree_util.tree_map(lax.stop_gradient, vi.K))
        M, y = lax.stop_gradient(_pivoted(fixed, y0))
        found = jnp.all(jnp.isfinite(y))
        size = jnp.sqrt(jnp.sum(M * M))
        first_step = jnp.where(size > 0, 1.0 / jnp.where(size > 0, size, 1.0), 1.0)
        return golden_ratio(vi, jnp.where(found, y, y0), tol, self.max_steps, first_step)


def is_affine_on_polyhedron(vi: FrozenVI, like: Tree) -> bool:
    """Return whether `Lemke` solves VI(K, F) for unknowns shaped like `like`."""
    if isinstance(like, tuple) or jnp.size(like) > MAX_ROWS:
        return False
    conditions = _conditions(vi.K, like)
    if conditions is None or len(conditions[1]) > _MAX_CONDITIONS:
        return False
    return analyse(vi.F, like).affine


def _conditions(
    K: AbstractSet, like: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array] | None:
    """Return (G, d, E, e) with K = {G y ≤ d, E y = e} for the entries y of an element shaped like
    `like`, with rows of G of length one or zero and independent rows of E; None for other sets."""
    n, dtype = like.size, like.dtype
    if isinstance(K, Polyhedron) and len(K.e) == 0:
        return *normalised_conditions(K.G, K.d), jnp.zeros((0, n), dtype), jnp.zeros(0, dtype)
    if isinstance(K, Simplex) and K.blocks is None and like.ndim == 1:
        total = jnp.broadcast_to(K.total, (1,)).astype(dtype)
        return -jnp.eye(n, dtype=dtype), jnp.zeros(n, dtype), jnp.ones((1, n), dtype), total
    return None


def _pivoted(vi: FrozenVI, like: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return M, and the solution y by complementary pivoting, which is not finite if that failed."""
    conditions = _conditions(vi.K, like)
    assert conditions is not None
    G, d, E, e = conditions
    n, p, m = like.size, len(e), len(d)
    zero = jnp.zeros_like(like)
    M = matrix_of(lambda v: jax.jvp(vi.F, (zero,), (v,))[1], like)
    q = vi.F(zero).ravel()
    # ⟨F(y), v − y⟩ with weights W is the plain product with W F(y).
    (weights,) = jax.tree_util.tree_leaves(vi.space.weights())
    weights = jnp.broadcast_to(weights, like.shape).astype(like.dtype).ravel()
    system = jnp.concatenate(
        [
            jnp.concatenate([weights[:, None] * M, E.T], axis=1),
            jnp.concatenate([E, jnp.zeros((p, p), like.dtype)], axis=1),
        ]
    )
    # The columns: the solution for λ = 0, and minus its change with every λ.
    right = jnp.concatenate(
        [
            jnp.concatenate([-(weights * q), e])[:, None],
            jnp.concatenate([G.T, jnp.zeros((p, m), like.dtype)]),
        ],
        axis=1,
    )
    columns = eliminate(system, right)[0][:n]
    free, change = columns[:, 0], columns[:, 1:]
    # A row without a bound never becomes active.
    bounded = jnp.isfinite(d)
    rows = jnp.where(bounded[:, None], G, 0.0)
    N = jnp.sum(rows[:, :, None] * change[None], axis=1)
    slack = jnp.where(bounded, d, 1.0) - times(rows, free)
    multipliers = solve_complementarity(N, slack, bounded)
    return M, (free - times(change, multipliers)).reshape(like.shape)


def solve_complementarity(N: jax.Array, c: jax.Array, may_bind: jax.Array) -> jax.Array:
    """Return λ ≥ 0 with w = c + Nλ ≥ 0 and λ ⊥ w, or NaN if pivoting ended without a solution.

    `may_bind` is false for rows whose λ is zero. The tableau of w − Nλ − z₀ = c has the columns w, λ,
    z₀ and the right side; column k + m of λₖ is complementary to column k of wₖ. Pivoting starts by
    bringing z₀ into the basis in the row of the smallest c, and ends when it leaves.
    """
    m = len(c)
    dtype, index = c.dtype, jnp.arange(m)
    eps = jnp.finfo(dtype).eps
    cover = jnp.where(may_bind, -1.0, 0.0).astype(dtype)
    tableau = jnp.concatenate([jnp.eye(m, dtype=dtype), -N, cover[:, None], c[:, None]], axis=1)
    artificial, last = 2 * m, 2 * m + 1

    def pivot(state: tuple) -> tuple:
        tableau, basis, entering, count, _ = state
        column = lax.dynamic_index_in_dim(tableau, entering, axis=1, keepdims=False)
        right = tableau[:, last]
        positive = column > 100 * eps * jnp.max(jnp.abs(column))
        ratios = jnp.where(positive, right / jnp.where(positive, column, 1.0), jnp.inf)
        # The rows of a tie are those of the smallest ratio up to roundoff; z₀ leaves first.
        smallest = jnp.min(ratios)
        ties = positive & (ratios <= smallest + 8 * eps * jnp.abs(smallest))
        ratios = jnp.where(ties & (basis == artificial), -jnp.inf, ratios)
        first = count == 0
        row = jnp.where(first, jnp.argmin(right), jnp.argmin(ratios))
        is_row = index == row
        scaled = lax.dynamic_index_in_dim(tableau, row)
        scaled = scaled / lax.dynamic_index_in_dim(column, row, keepdims=False)
        tableau = jnp.where(is_row[:, None], scaled, tableau - column[:, None] * scaled)
        leaving = lax.dynamic_index_in_dim(basis, row, keepdims=False)
        basis = jnp.where(is_row, entering, basis)
        ray = ~first & ~jnp.any(positive)
        over = (leaving == artificial) | ray
        complement = jnp.where(leaving < m, leaving + m, leaving - m)
        return tableau, basis, complement, jnp.where(ray, -1, count + 1), over

    def unfinished(state: tuple) -> jax.Array:
        return ~state[4] & (state[3] < 20 + 10 * m)

    feasible = jnp.all(c >= 0)
    start = tableau, index, jnp.asarray(artificial, index.dtype), jnp.asarray(0), feasible
    tableau, basis, _, count, over = lax.while_loop(unfinished, pivot, start)
    solved = over & (count >= 0)
    # λₖ is the right side of the row in which it is basic.
    is_basic = basis[None, :] == (index + m)[:, None]
    multipliers = jnp.sum(jnp.where(is_basic, tableau[:, last], 0.0), axis=1)
    return jnp.where(solved, jnp.maximum(multipliers, 0.0), jnp.nan)
