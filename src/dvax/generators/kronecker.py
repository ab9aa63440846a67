"""A = F ⊗ 1 + 1 ⊗ B: every component of a field by itself, and all of them with each other."""

from typing import Any

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace, Euclidean
from .abstract import AbstractPropagator, Arc, Growth
from .bend import normwise_bend
from .dense import Dense
from .diagonal import Diagonal
from .elliptic import Elliptic
from .expanded import AbstractModal, as_given, coefficients_of, values, with_coefficients
from .phi import flow_factors, phi_matrix
from .scalar import Scalar
from .transforms import Transform

_EXACT = jax.lax.Precision.HIGHEST


class KroneckerSum(AbstractModal):
    """(A v)ᵢ = F vᵢ + Σⱼ Bᵢⱼ vⱼ for states of m components on one grid, of shape (m, *grid): two
    operators that commute, since F acts along the grid and B across the components. Species that
    diffuse and react linearly, layers that exchange heat, a wave with friction.

    A is B + λ in every mode λ of F, so e^{hA} and the φ-functions are those of an m × m matrix a
    mode, to rounding. They are made anew for every length of step, at the cost of about a hundred
    products of such matrices a mode; a step itself costs m transforms and one product of a matrix
    and a vector a mode.

    The growth bound is M = 1 and ω = max Re λ + λ_max(½(B + Bᵀ)), where all points weigh alike.

    **Arguments:** `field`: `Elliptic`, `Diagonal` or `Scalar`, on the grid; `matrix`: B, m × m, in
    1/time.

    **Raises:** `dvax.InputError` where the matrix is not square or the field is of another kind.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> g = dvax.generators
    >>> exchange = jnp.array([[-1.0, 1.0], [1.0, -1.0]])            # what one loses the other gains
    >>> A = g.KroneckerSum(g.Elliptic(32, lengths=jnp.pi, boundary="neumann"), exchange)
    >>> s = (jnp.arange(32.0) + 0.5) * jnp.pi / 32
    >>> v = A.semigroup(1.0, jnp.stack([jnp.cos(s), -jnp.cos(s)]))  # −1 along s, −2 across
    >>> print(f"{float(v[0, 0] / jnp.cos(s[0])):.6f}", f"{float(jnp.exp(-3.0)):.6f}")
    0.049787 0.049787

    ```
    """

    field: Elliptic | Diagonal | Scalar
    matrix: jax.Array

    def __init__(self, field: Elliptic | Diagonal | Scalar, matrix: Any):
        _tree.check_kind(
            field, Elliptic | Diagonal | Scalar, "dvax.generators.KroneckerSum(field)",
            "it is the generator on the grid: Elliptic, Diagonal or Scalar",
            "Give that first, such as dvax.generators.Elliptic(32), and then the matrix",
        )  # fmt: skip
        self.matrix = Dense(matrix).matrix
        self.field = field

    def apply(self, v: Tree) -> Tree:
        return jax.vmap(self.field.apply)(v) + jnp.tensordot(
            self.matrix, v, axes=1, precision=_EXACT
        )

    def expand(self, v: Tree, known: Tree = None) -> Tree:
        transform = _transform(self.field)
        return v if transform is None else with_coefficients(v, known, jax.vmap(transform.forward))

    def propagator(self, h: Any, terms: int) -> "ModalPropagator":
        rates = _rates(self.field)
        h, B = (jnp.asarray(v).astype(rates.dtype) for v in (h, self.matrix))
        eye = jnp.eye(len(B), dtype=rates.dtype)

        def factors(rate: Any) -> tuple[jax.Array, ...]:
            return flow_factors(h, phi_matrix(h * (B + rate * eye), terms))

        over_modes = jax.vmap(factors)(rates.ravel())
        shaped = tuple(f.reshape(*rates.shape, *f.shape[1:]) for f in over_modes)
        return ModalPropagator(_transform(self.field), shaped)

    def check(self, space: AbstractSpace) -> None:
        zeros, m = space.zeros(), self.matrix.shape[0]
        if isinstance(zeros, tuple) or jnp.ndim(zeros) < 1 or zeros.shape[0] != m:
            raise InputError(
                InputProblem(
                    "dvax.generators.KroneckerSum(matrix)",
                    f"shape {self.matrix.shape}",
                    f"it acts across the first axis of the state, of shape {_tree.shapes(zeros)}",
                    f"Stack {m} components on one grid: x0 of shape ({m}, *grid)",
                )
            )
        self.field.check(Euclidean(zeros.shape[1:]))

    def adjoint(self, space: AbstractSpace) -> "KroneckerSum":
        alike = _spread(space)
        _tree.require(
            lambda: float(alike) <= 1.0 + 1e-12, "dvax.generators.KroneckerSum.adjoint(space)",
            alike, "where points weigh differently A* is no such sum",
            "Use a space that weighs them alike",
        )  # fmt: skip
        return KroneckerSum(self.field.adjoint(Euclidean(space.zeros().shape[1:])), self.matrix.T)

    def growth(self, space: AbstractSpace) -> Growth:
        own = jnp.linalg.eigvalsh(0.5 * (self.matrix + self.matrix.T))[-1]
        return Growth(_spread(space), jnp.max(jnp.real(_rates(self.field))) + own)

    def bend(self, arc: Arc, space: AbstractSpace, growth: Growth) -> Tree:
        return normwise_bend(self, Arc(arc.h, *values((arc.x0, arc.x1, arc.c))), space, growth)


class ModalPropagator(AbstractPropagator):
    """One matrix a mode, of shape (*modes, m, m), between a transform of each component and back."""

    transform: Transform | None
    factors: tuple[jax.Array, ...]

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        forward = (lambda v: v) if self.transform is None else jax.vmap(self.transform.forward)
        given = [coefficients_of(v, forward) for v in (x0, *c)]
        parts = [
            jnp.einsum(
                "...ij,j...->i...",
                factor.astype(coefficients.dtype),
                coefficients,
                precision=_EXACT,
            )
            for factor, coefficients in zip(self.factors, given, strict=False)
        ]
        total = sum(parts[1:], start=parts[0])
        if self.transform is None:
            return total
        return as_given(x0, total, jax.vmap(self.transform.backward))


def _rates(field: Elliptic | Diagonal | Scalar) -> jax.Array:
    """The eigenvalues of F, one a mode."""
    if isinstance(field, Elliptic):
        return field.symbol
    if isinstance(field, Diagonal):
        return field.entries
    return field.a


def _transform(field: Elliptic | Diagonal | Scalar) -> Transform | None:
    return field.transform if isinstance(field, Elliptic) else None


def _spread(space: AbstractSpace) -> jax.Array:
    """How much the norm of a space may differ from the plain one, up to a factor."""
    w = space.weights()
    return jnp.sqrt(jnp.max(w) / jnp.min(w))
