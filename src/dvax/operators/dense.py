"""P given as a symmetric positive definite matrix."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from .abstract import AbstractOperator, Spectrum


class Dense(AbstractOperator):
    """P v = matrix @ v, self-adjoint and positive definite in the control space's inner product.

    In a Euclidean space the matrix is symmetric; with weights w, diag(w) @ matrix is.

    **Raises:** `dvax.InputError` where the matrix is not square; and, when a `dvax.Problem` is made
    of it, where it is not self-adjoint or not positive definite there.

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
            raise InputError(
                InputProblem(
                    name,
                    f"shape {shape}",
                    "P maps the control space to itself, so its matrix is square",
                    "Use dvax.operators.Diagonal for a vector of diagonal entries",
                )
            )
        if _tree.is_concrete(self.matrix):
            _check_positive(name, np.asarray(self.matrix))
        # The law applies P⁻¹ at every evaluation: a stored inverse is one product that fuses with
        # what surrounds it, a triangular solve is not; P is well conditioned or nothing else works.
        self.inverse_matrix = jnp.linalg.inv(self.matrix)

    def apply(self, v: Tree) -> Tree:
        return self.matrix @ v

    def inverse(self, v: Tree) -> Tree:
        return self.inverse_matrix @ v

    def check(self, space: AbstractSpace) -> None:
        name = "dvax.operators.Dense(matrix)"
        _tree.fits_matrix(name, self.matrix, space.zeros(), "control space")
        weighted = jnp.asarray(space.weights()).reshape(-1, 1) * self.matrix
        _tree.require(
            lambda: np.allclose(weighted, np.asarray(weighted).T, rtol=1e-13, atol=0.0),
            name,
            self.matrix,
            f"P must be self-adjoint in {space!r}: diag(weights) @ matrix is symmetric",
            "If only rounding is in the way, symmetrise the matrix before you give it",
        )
        _tree.require(
            lambda: self.spectrum(space).m > 0,
            name,
            self.matrix,
            "P must be coercive, so every eigenvalue is positive",
            "Add a multiple of the identity",
        )

    def spectrum(self, space: AbstractSpace) -> Spectrum:
        # Similar to W^{1/2} P W^{-1/2}, which is symmetric where P is self-adjoint for W.
        root = jnp.broadcast_to(jnp.sqrt(space.weights()), self.matrix.shape[:1])
        similar = root[:, None] * self.matrix / root[None, :]
        eigenvalues = jnp.linalg.eigvalsh(0.5 * (similar + similar.T))
        return Spectrum(eigenvalues[0], eigenvalues[-1])


def _check_positive(name: str, matrix: np.ndarray) -> None:
    """Raise an `InputError` where no inner product with diagonal weights makes P coercive."""
    given = ""
    if not np.isfinite(matrix).all():
        given = f"{_tree.short(matrix)}, which has entries that are not finite"
    elif np.allclose(matrix, matrix.T, rtol=1e-13, atol=0.0):
        given = _not_definite(matrix)
    elif (sign := np.linalg.slogdet(matrix)[0]) <= 0:  # the product of the eigenvalues
        kind = "a singular matrix" if sign == 0 else "a matrix with a negative determinant"
        given = f"{kind} (rank {np.linalg.matrix_rank(matrix)}, size {len(matrix)})"
    if given:
        rule = "P must be bounded and coercive, so its matrix is finite and positive definite"
        fix = "Correct the matrix, or add a multiple of the identity"
        raise InputError(InputProblem(name, given, rule, fix))


def _not_definite(matrix: np.ndarray) -> str:
    """What is wrong with a symmetric matrix that is not positive definite, else nothing."""
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
