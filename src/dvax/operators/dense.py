"""Operators P given by a symmetric positive definite matrix."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from ..spaces.matrices import numerical_range_on_axis
from .abstract import AbstractOperator, Spectrum


class Dense(AbstractOperator):
    """P v = matrix @ v, self-adjoint and positive definite in the control space's inner product.

    In a Euclidean space the matrix must be symmetric; with weights w, diag(w) @ matrix must be.

    **Raises:** `dvax.InputError` if the matrix is not square. `dvax.Problem` raises it if the operator
    is not self-adjoint and positive definite in the control space.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> P = dvax.operators.Dense(jnp.array([[2.0, 0.5], [0.5, 1.0]]))
    >>> P.apply(jnp.array([1.0, 0.0])).tolist()
    [2.0, 0.5]

    ```
    """

    matrix: jax.Array
    inverse_matrix: jax.Array

    def __init__(self, matrix: Any):
        name = "dvax.operators.Dense(matrix)"
        self.matrix = _tree.as_array(matrix, name)
        shape = self.matrix.shape
        if len(shape) != 2 or shape[0] != shape[1]:
            raise input_error(
                name,
                f"shape {shape}",
                "P maps the control space to itself, so its matrix must be square",
                "Use dvax.operators.Diagonal for a vector of diagonal entries",
            )
        if _tree.is_concrete(self.matrix):
            _check_positive(name, np.asarray(self.matrix))
        # Every evaluation of the law applies P⁻¹. XLA fuses the product with a stored inverse, but
        # not a triangular solve. The method requires a well-conditioned P in any case.
        self.inverse_matrix = _tree.prepare(_inverse, self.matrix)

    def apply(self, v: Tree) -> Tree:
        return self.matrix @ v

    def inverse(self, v: Tree) -> Tree:
        return self.inverse_matrix @ v

    def check(self, space: AbstractSpace) -> None:
        name = "dvax.operators.Dense(matrix)"
        _tree.fits_matrix(name, self.matrix, space.like(), "control space")

        def is_symmetric() -> bool:
            # NumPy: in a function that JAX traces, its own product would be traced.
            weighted = np.asarray(space.weights()).reshape(-1, 1) * np.asarray(self.matrix)
            return np.allclose(weighted, weighted.T, rtol=1e-13, atol=0.0)

        _tree.require(
            is_symmetric,
            name,
            self.matrix,
            f"P must be self-adjoint in {space!r}: diag(weights) @ matrix must be symmetric",
            "If the asymmetry is roundoff, symmetrise the matrix",
        )
        _tree.require(
            lambda: float(self.spectrum(space).m) > 0,
            name,
            self.matrix,
            "P must be coercive, so every eigenvalue must be positive",
            "Add a multiple of the identity",
        )

    def spectrum(self, space: AbstractSpace) -> Spectrum:
        # P is self-adjoint, so these are the ends of its spectrum.
        return Spectrum(*numerical_range_on_axis(self.matrix, space))


def _inverse(matrix: Any) -> Any:
    return (np if isinstance(matrix, np.ndarray) else jnp).linalg.inv(matrix)


def _check_positive(name: str, matrix: np.ndarray) -> None:
    """Raise an `InputError` if P is coercive in no inner product with diagonal weights."""
    given = ""
    if not np.isfinite(matrix).all():
        given = f"{_tree.short(matrix)}, with entries that are not finite"
    elif np.allclose(matrix, matrix.T, rtol=1e-13, atol=0.0):
        given = _describe_indefinite(matrix)
    elif (sign := np.linalg.slogdet(matrix)[0]) <= 0:  # the product of the eigenvalues
        kind = "a singular matrix" if sign == 0 else "a matrix with a negative determinant"
        given = f"{kind} (rank {np.linalg.matrix_rank(matrix)}, size {len(matrix)})"
    if given:
        rule = "P must be bounded and coercive, so its matrix must be finite and positive definite"
        fix = "Correct the matrix, or add a multiple of the identity"
        raise input_error(name, given, rule, fix)


def _describe_indefinite(matrix: np.ndarray) -> str:
    """Return a description of a symmetric matrix, or "" if it is positive definite."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        smallest, rank = np.linalg.eigvalsh(matrix)[0], np.linalg.matrix_rank(matrix)
        kind = (
            "a singular matrix" if rank < len(matrix) else "a matrix that is not positive definite"
        )
        about = f"smallest eigenvalue {smallest:.3g}, rank {rank}, size {len(matrix)}"
        return f"{kind} ({about})"
    return ""
