"""Finite elements with a consistent mass matrix."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from .faber import Range
from .matrix_free import AbstractMatrixFree
from .sparse import Sparse, Triplets, triplets


class FiniteElements(AbstractMatrixFree):
    """A = −M⁻¹S: M x' = −Sx + … for a mass matrix M and a stiffness matrix S, as they are assembled.

    M is symmetric and nearly its own diagonal D: the eigenvalues of D⁻¹M lie in the least interval
    [l, h] that has those of every element (Wathen 1987), for simplices the same on any mesh. So M⁻¹
    is a Chebyshev polynomial of fixed degree in D⁻¹M, exact to rounding: linear, differentiable,
    self-adjoint with M, and no factorisation. With S ≥ 0 symmetric the semigroup contracts in the norm
    of M, and in that of the space L2(D), where the sets of a response live, its bound is M = √(h/l).

    A product costs one with S and about 18√(h/l) with M: where a lumped mass will do,
    `dvax.generators.Sparse` is that much cheaper.

    **Arguments:**

    - `mass`, `stiffness`: of SciPy, or `jax.experimental.sparse.BCOO` whose `data` may be traced;
    - `mass_range`: (l, h). Gershgorin's circles by default, which suffice in one dimension. Where
      they do not, declare it: (1/2, 2) for linear triangles, (1/2, 5/2) for linear tetrahedra,
      (1/4, 9/4) for bilinear parallelograms, (1/8, 27/8) for trilinear parallelepipeds;
    - `within`: a `dvax.generators.Range` that contains the numerical range of A in the inner product
      of M, better than the circles do;
    - `dissipative`: declares that vᵀSv ≥ 0 for all v, as for any stiffness matrix that was
      assembled from elements. Circles see it on a rod, not where triangles are obtuse; the growth
      bound is then far too large, and a long step too costly to be computed.

    **Raises:** `dvax.InputError` where the matrices do not fit each other, M is not symmetric, or its
    interval is not known to be positive.

    Source: A. J. Wathen, Realistic eigenvalue bounds for the Galerkin mass matrix, IMA J. Numer. Anal.
    7 (1987), Table 1; Chebyshev's iteration: Saad, Iterative Methods for Sparse Linear Systems (2003),
    Algorithm 12.1.

    ```python
    >>> import dvax, jax.numpy as jnp, scipy.sparse
    >>> n = 40                                 # linear elements on (0, 1), zero at the ends
    >>> bands = lambda *v: scipy.sparse.diags(v, [-1, 0, 1], shape=(n, n))
    >>> A = dvax.generators.FiniteElements(
    ...     mass=bands(1.0, 4.0, 1.0) / (6 * (n + 1)), stiffness=bands(-1.0, 2.0, -1.0) * (n + 1.0)
    ... )
    >>> s = jnp.arange(1, n + 1) / (n + 1)
    >>> warm = A.semigroup(0.1, jnp.sin(jnp.pi * s))      # decays as e^{−π²t}, nearly
    >>> print(f"{float(warm.max()):.3f}")
    0.372

    ```
    """

    mass: Sparse
    stiffness: Sparse
    diagonal: jax.Array
    middle: jax.Array
    range: Range
    recursion: tuple[tuple[float, float], ...] = eqx.field(static=True)

    def __init__(
        self,
        mass: Any,
        stiffness: Any,
        mass_range: tuple[float, float] | None = None,
        within: Range | None = None,
        dissipative: bool = False,
    ):
        name = "dvax.generators.FiniteElements"
        M, S = triplets(mass, f"{name}(mass)"), triplets(stiffness, f"{name}(stiffness)")
        _check(M, S)
        rows, cols, values, n = M
        D = jnp.zeros(n, values.dtype).at[rows].add(jnp.where(rows == cols, values, 0.0))
        _tree.require(
            lambda: bool(np.all(np.asarray(D) > 0)), f"{name}(mass)", D,
            "a mass matrix has a positive diagonal", "Mend the assembly, or drop unused nodes",
        )  # fmt: skip
        # Both divided by D row by row: self-adjoint in L2(D), where M⁻¹S is (D⁻¹M)⁻¹ D⁻¹S.
        self.mass = Sparse(_scaled(M, D), D)
        self.stiffness = Sparse(_scaled(S, -D), D)
        self.diagonal = D
        low, high = _interval(self.mass, mass_range)
        self.middle = jnp.asarray((low + high) / 2, values.dtype)
        self.recursion = _chebyshev(low, high, float(jnp.finfo(values.dtype).eps))
        proved = mass_range is None
        found = _divided(self.stiffness.range, low, high)._replace(proved=proved)
        if dissipative:
            found = found._replace(high=jnp.minimum(found.high, 0.0), proved=False)
        if within is not None:
            found = within._replace(proved=False)
        self.range = found._replace(weights=D, spread=high / low)

    def apply(self, v: Tree) -> Tree:
        return self._undo(self.stiffness.apply(v))

    def load(self, b: Any) -> jax.Array:
        """M⁻¹b: the element of the state space for a load vector bᵢ = ∫ f φᵢ, as f of a problem needs
        it."""
        return self._undo(b / self.diagonal)

    def numerical_range(self) -> Range:
        """What the circles, or `within`, enclose."""
        return self.range

    def _undo(self, b: jax.Array) -> jax.Array:
        """(D⁻¹M)⁻¹b."""
        step = b / self.middle
        if not self.recursion:
            return step
        keep, add = jnp.asarray(np.transpose(self.recursion), step.dtype)

        def one(k: Any, carry: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
            x, rest, step = carry
            x, rest = x + step, rest - self.mass.apply(step)
            return x, rest, keep[k] * step + add[k] * rest

        x, _, step = jax.lax.fori_loop(0, len(self.recursion), one, (jnp.zeros_like(b), b, step))
        return x + step


def _scaled(matrix: Triplets, by: jax.Array) -> Triplets:
    """The matrix with row i divided by `by`ᵢ."""
    return matrix._replace(values=jnp.asarray(matrix.values) / by[matrix.rows])


def _interval(scaled: Sparse, declared: tuple[float, float] | None) -> tuple[float, float]:
    """[l, h], wide enough for what rounding did to the matrix."""
    name = "dvax.generators.FiniteElements(mass_range)"
    if declared is not None:
        low, high = map(float, declared)
        given = f"({low:g}, {high:g})"
    else:
        if not _tree.is_concrete(scaled.range.low):
            raise InputError(
                InputProblem(
                    name, "none, with a mass matrix that is traced",
                    "how often M is applied must be known before its values are",
                    "Declare the interval: (1/2, 2) for linear triangles, say",
                )
            )  # fmt: skip
        slack = 64 * float(jnp.finfo(scaled.range.low.dtype).eps)
        low = float(scaled.range.low) * (1 - slack)
        high = float(scaled.range.high) * (1 + slack)
        given = f"none, and Gershgorin's circles give ({low:.3g}, {high:.3g})"
    if not 0.0 < low <= high < math.inf:
        raise InputError(
            InputProblem(
                name, given,
                "M is inverted by a polynomial that is small on an interval 0 < l ≤ h with the "
                "eigenvalues of D⁻¹M",
                "Declare what the element has: (1/2, 2) for linear triangles, (1/2, 5/2) for linear "
                "tetrahedra, (1/4, 9/4) for bilinear parallelograms, (1/8, 27/8) for trilinear boxes",
            )
        )  # fmt: skip
    return low, high


def _chebyshev(low: float, high: float, eps: float) -> tuple[tuple[float, float], ...]:
    """The factors of a step's last one and of the residual, in every turn of the iteration."""
    theta, delta = (high + low) / 2, (high - low) / 2
    if delta <= 4 * eps * theta:
        return ()
    root = math.sqrt(high / low)
    # The error falls below 2ρᵏ in the norm of M.
    turns = math.ceil(math.log(2 * root / eps) / math.log((root + 1) / (root - 1)))
    sigma, factors = theta / delta, []
    before = 1 / sigma
    for _ in range(turns):
        now = 1 / (2 * sigma - before)
        factors.append((now * before, 2 * now / delta))
        before = now
    return tuple(factors)


def _divided(found: Range, low: float, high: float) -> Range:
    """{z/μ : z in the rectangle, l ≤ μ ≤ h}: ⟨Av, v⟩ over the two norms of v."""
    return Range(
        jnp.minimum(found.low / low, found.low / high),
        jnp.maximum(found.high / low, found.high / high),
        found.height / low,
    )


def _check(M: Triplets, S: Triplets) -> None:
    name = "dvax.generators.FiniteElements"
    if M.size != S.size:
        raise InputError(
            InputProblem(
                f"{name}(stiffness)", f"{S.size} rows, beside a mass matrix of {M.size}",
                "both act on the same unknowns", "Assemble them over the same mesh and conditions",
            )
        )  # fmt: skip

    eps = float(jnp.finfo(M.values.dtype).eps)

    def symmetric() -> bool:
        from scipy.sparse import coo_array

        whole = coo_array((np.asarray(M.values), (M.rows, M.cols)), shape=(M.size, M.size)).tocsr()
        off = abs(whole - whole.T)
        return bool(off.nnz == 0 or off.max() <= 64 * eps * abs(whole).max())

    _tree.require(
        symmetric, f"{name}(mass)", M.values,
        "a mass matrix is that of an inner product: symmetric", "Mend its assembly",
    )  # fmt: skip
