"""Kronecker sums A = F ⊗ 1 + 1 ⊗ B: an operator on the grid plus a coupling of components."""

from typing import Any

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace, Euclidean
from .abstract import AbstractPropagator, FlowStep, Growth
from .chord_deviation import normwise_chord_deviation
from .dense import Dense
from .diagonal import Diagonal
from .elliptic import Elliptic
from .phi import flow_factors, phi_matrix
from .scalar import Scalar
from .spectral_state import AbstractModal, coefficients_of, in_form_of, values, with_coefficients
from .transforms import Transform

_EXACT = jax.lax.Precision.HIGHEST


class KroneckerSum(AbstractModal):
    """(A v)ᵢ = F vᵢ + Σⱼ Bᵢⱼ vⱼ for states of m components on a grid, of shape (m, *grid).

    The two operators commute, since F acts along the grid and B across the components. Examples are
    species that diffuse and react linearly, layers that exchange heat, and a wave with friction.

    For every eigenvalue λ of F, A acts as the m × m matrix B + λ. The φ-functions of these matrices
    are computed to roundoff, for every new step size, at the cost of about a hundred products of such
    matrices a mode. A step costs m transforms and one product of a matrix and a vector a mode.

    The growth bound is M = 1 and ω = max Re λ + λ_max(½(B + Bᵀ)), if all points have the same weight.

    **Arguments:** `field`: `Elliptic`, `Diagonal` or `Scalar`, on the grid; `matrix`: B, m × m, in
    1/time.

    **Raises:** `dvax.InputError` if the matrix is not square or the field is of another type.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> g = dvax.generators
    >>> exchange = jnp.array([[-1.0, 1.0], [1.0, -1.0]])            # exchange that conserves the sum
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
            "it must be a generator on the grid: Elliptic, Diagonal or Scalar",
            "Pass the generator first, such as dvax.generators.Elliptic(32), then the matrix",
        )  # fmt: skip
        self.matrix = Dense(matrix).matrix
        self.field = field

    def apply(self, v: Tree) -> Tree:
        return jax.vmap(self.field.apply)(v) + jnp.tensordot(
            self.matrix, v, axes=1, precision=_EXACT
        )

    def expand(self, v: Tree, coefficients: Tree = None) -> Tree:
        transform = _transform(self.field)
        if transform is None:
            return v
        return with_coefficients(v, coefficients, jax.vmap(transform.forward))

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
        zeros, m = space.like(), self.matrix.shape[0]
        if isinstance(zeros, tuple) or jnp.ndim(zeros) < 1 or zeros.shape[0] != m:
            raise input_error(
                "dvax.generators.KroneckerSum(matrix)",
                f"shape {self.matrix.shape}",
                f"it acts on the first axis of the state, whose shape is {_tree.shapes(zeros)}",
                f"Stack {m} components on one grid: x0 of shape ({m}, *grid)",
            )
        self.field.check(Euclidean(zeros.shape[1:]))

    def adjoint(self, space: AbstractSpace) -> "KroneckerSum":
        weight_ratio = _norm_ratio(space)
        _tree.require(
            lambda: float(weight_ratio) <= 1.0 + 1e-12,
            "dvax.generators.KroneckerSum.adjoint(space)", weight_ratio,
            "all points must have the same weight, or A* is no Kronecker sum",
            "Use a space with one weight for all points",
        )  # fmt: skip
        return KroneckerSum(self.field.adjoint(Euclidean(space.like().shape[1:])), self.matrix.T)

    def growth(self, space: AbstractSpace) -> Growth:
        coupling = jnp.linalg.eigvalsh(0.5 * (self.matrix + self.matrix.T))[-1]
        return Growth(_norm_ratio(space), jnp.max(jnp.real(_rates(self.field))) + coupling)

    def chord_deviation(self, step: FlowStep, space: AbstractSpace, growth: Growth) -> Tree:
        step = FlowStep(step.h, *values((step.x0, step.x1, step.c)))
        return normwise_chord_deviation(self, step, space, growth)


class ModalPropagator(AbstractPropagator):
    """A propagator with one m × m matrix for every mode of a transform of the components.

    The factors have the shape (*modes, m, m).
    """

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
        return in_form_of(x0, total, jax.vmap(self.transform.backward))


def _rates(field: Elliptic | Diagonal | Scalar) -> jax.Array:
    """Return the eigenvalues of F, one a mode."""
    if isinstance(field, Elliptic):
        return field.symbol
    if isinstance(field, Diagonal):
        return field.entries
    return field.a


def _transform(field: Elliptic | Diagonal | Scalar) -> Transform | None:
    return field.transform if isinstance(field, Elliptic) else None


def _norm_ratio(space: AbstractSpace) -> jax.Array:
    """Return the ratio √(max w/min w) between the norm of the space and the Euclidean norm."""
    w = space.weights()
    return jnp.sqrt(jnp.max(w) / jnp.min(w))
