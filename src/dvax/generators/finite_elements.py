"""Finite-element generators with a consistent mass matrix."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from .faber import Range
from .matrix_free import AbstractMatrixFree
from .sparse import Sparse, Triplets, triplets


class FiniteElements(AbstractMatrixFree):
    """A = −M⁻¹S, for M x' = −Sx + … with the assembled mass matrix M and stiffness matrix S.

    M is symmetric with diagonal D. The eigenvalues of D⁻¹M lie in the smallest interval [l, h] that
    contains those of every element matrix (Wathen 1987); for simplices it is the same on every mesh.
    M⁻¹ is therefore applied as a Chebyshev polynomial of fixed degree in D⁻¹M, exact to roundoff. This
    is linear, differentiable and self-adjoint, and needs no factorisation. For symmetric S ≥ 0 the
    semigroup is a contraction in the norm of M. In the norm of the space L2(D), in which the sets of a
    response are defined, its growth bound has M = √(h/l).

    A product with A costs one product with S and about 18√(h/l) with M. If a lumped mass matrix is
    accurate enough, `dvax.generators.Sparse` is cheaper by this factor.

    **Arguments:**

    - `mass`, `stiffness`: sparse matrices of SciPy, or `jax.experimental.sparse.BCOO` whose `data`
      may be traced;
    - `mass_range`: (l, h). The default is computed from Gershgorin's circles, which suffice in one
      dimension. Otherwise declare it: (1/2, 2) for linear triangles, (1/2, 5/2) for linear
      tetrahedra, (1/4, 9/4) for bilinear parallelograms, (1/8, 27/8) for trilinear parallelepipeds;
    - `within`: a `dvax.generators.Range` that contains the numerical range of A in the inner product
      of M, if you know a tighter one than Gershgorin's circles;
    - `dissipative`: declares that vᵀSv ≥ 0 for all v, as for any stiffness matrix assembled from
      elements. Gershgorin's circles prove this in one dimension, but not for obtuse triangles. The
      growth bound is then much too large, and a large step too expensive.

    **Raises:** `dvax.InputError` if the sizes of the matrices differ, M is not symmetric, or its
    interval is not proved to be positive.

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
            "the diagonal of a mass matrix must be positive",
            "Correct the assembly, or remove unused nodes",
        )  # fmt: skip
        # M⁻¹S = (D⁻¹M)⁻¹ (D⁻¹S), and both factors are self-adjoint in L2(D).
        self.mass = Sparse(_divide_rows(M, D), D)
        self.stiffness = Sparse(_divide_rows(S, -D), D)
        self.diagonal = D
        low, high = _interval(self.mass, mass_range)
        self.middle = jnp.asarray((low + high) / 2, values.dtype)
        self.recursion = _chebyshev(low, high, float(jnp.finfo(values.dtype).eps))
        proved = mass_range is None
        enclosure = _quotient_range(self.stiffness.range, low, high)._replace(proved=proved)
        if dissipative:
            enclosure = enclosure._replace(high=jnp.minimum(enclosure.high, 0.0), proved=False)
        if within is not None:
            enclosure = within._replace(proved=False)
        self.range = enclosure._replace(weights=D, spread=high / low)

    def apply(self, v: Tree) -> Tree:
        return self._solve_mass(self.stiffness.apply(v))

    def load(self, b: Any) -> jax.Array:
        """Return M⁻¹b, the element of the state space for a load vector bᵢ = ∫ f φᵢ.

        Use it in the f of a problem."""
        return self._solve_mass(b / self.diagonal)

    def numerical_range(self) -> Range:
        """Return the enclosure from Gershgorin's circles, or `within`."""
        return self.range

    def _solve_mass(self, b: jax.Array) -> jax.Array:
        """Return (D⁻¹M)⁻¹b."""
        step = b / self.middle
        if not self.recursion:
            return step
        step_factors, residual_factors = jnp.asarray(np.transpose(self.recursion), step.dtype)

        def iteration(k: Any, carry: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
            x, residual, step = carry
            x, residual = x + step, residual - self.mass.apply(step)
            return x, residual, step_factors[k] * step + residual_factors[k] * residual

        start = (jnp.zeros_like(b), b, step)
        x, _, step = jax.lax.fori_loop(0, len(self.recursion), iteration, start)
        return x + step


def _divide_rows(matrix: Triplets, divisors: jax.Array) -> Triplets:
    """Return the matrix with row i divided by `divisors`ᵢ."""
    return matrix._replace(values=jnp.asarray(matrix.values) / divisors[matrix.rows])


def _interval(scaled: Sparse, declared: tuple[float, float] | None) -> tuple[float, float]:
    """Return [l, h], enlarged by the roundoff of the matrix; raise an `InputError` unless l > 0."""
    name = "dvax.generators.FiniteElements(mass_range)"
    if declared is not None:
        low, high = map(float, declared)
        given = f"({low:g}, {high:g})"
    else:
        if not _tree.is_concrete(scaled.range.low):
            raise input_error(
                name, "None, with a traced mass matrix",
                "the number of products with M must not depend on traced values",
                "Declare the interval, such as (1/2, 2) for linear triangles",
            )  # fmt: skip
        slack = 64 * float(jnp.finfo(scaled.range.low.dtype).eps)
        low = float(scaled.range.low) * (1 - slack)
        high = float(scaled.range.high) * (1 + slack)
        given = f"None, and Gershgorin's circles give ({low:.3g}, {high:.3g})"
    if not 0.0 < low <= high < math.inf:
        raise input_error(
            name, given,
            "the eigenvalues of D⁻¹M must lie in a finite interval [l, h] with 0 < l ≤ h, on "
            "which a polynomial approximates M⁻¹",
            "Declare that of the element: (1/2, 2) for linear triangles, (1/2, 5/2) for linear "
            "tetrahedra, (1/4, 9/4) for bilinear parallelograms, (1/8, 27/8) for trilinear boxes",
        )  # fmt: skip
    return low, high


def _chebyshev(low: float, high: float, eps: float) -> tuple[tuple[float, float], ...]:
    """Return the factors of the previous step and of the residual in each Chebyshev iteration."""
    theta, delta = (high + low) / 2, (high - low) / 2
    if delta <= 4 * eps * theta:
        return ()
    root = math.sqrt(high / low)
    # The error after k iterations is at most 2ρᵏ in the norm of M.
    iterations = math.ceil(math.log(2 * root / eps) / math.log((root + 1) / (root - 1)))
    sigma, factors = theta / delta, []
    previous = 1 / sigma
    for _ in range(iterations):
        rho = 1 / (2 * sigma - previous)
        factors.append((rho * previous, 2 * rho / delta))
        previous = rho
    return tuple(factors)


def _quotient_range(enclosure: Range, low: float, high: float) -> Range:
    """Return an enclosure of {z/μ : z in the rectangle, l ≤ μ ≤ h}.

    μ is the quotient of the squared norms of v in M and in D.
    """
    return Range(
        jnp.minimum(enclosure.low / low, enclosure.low / high),
        jnp.maximum(enclosure.high / low, enclosure.high / high),
        enclosure.height / low,
    )


def _check(M: Triplets, S: Triplets) -> None:
    name = "dvax.generators.FiniteElements"
    if M.size != S.size:
        raise input_error(
            f"{name}(stiffness)", f"{S.size} rows, with a mass matrix of {M.size} rows",
            "both must act on the same unknowns",
            "Assemble both with the same mesh and boundary conditions",
        )  # fmt: skip

    eps = float(jnp.finfo(M.values.dtype).eps)

    def symmetric() -> bool:
        from scipy.sparse import coo_array

        whole = coo_array((np.asarray(M.values), (M.rows, M.cols)), shape=(M.size, M.size)).tocsr()
        off = abs(whole - whole.T)
        return bool(off.nnz == 0 or off.max() <= 64 * eps * abs(whole).max())

    _tree.require(
        symmetric, f"{name}(mass)", M.values,
        "a mass matrix must be symmetric", "Correct its assembly",
    )  # fmt: skip
