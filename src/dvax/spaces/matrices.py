"""Matrices as maps of a space of vectors with weights."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .abstract import AbstractSpace


def similar_matrix(matrix: Any, weights: Any) -> Any:
    """Return W^{1/2} M W^{-1/2}, whose Euclidean norm is that of M in the norm of the weights."""
    root = (np if isinstance(weights, np.ndarray) else jnp).sqrt(weights)
    return root.reshape(-1, 1) * matrix / root.reshape(1, -1)


def numerical_range_on_axis(matrix: jax.Array, space: AbstractSpace) -> tuple[jax.Array, jax.Array]:
    """Return the smallest and the largest ⟨Mv, v⟩ of ‖v‖ = 1, the eigenvalues of the symmetric part."""

    def eigenvalues(matrix: Any, weights: Any) -> Any:
        similar = similar_matrix(matrix, weights)
        module = np if isinstance(similar, np.ndarray) else jnp
        return module.linalg.eigvalsh(0.5 * (similar + similar.T))

    values = _tree.prepare(eigenvalues, matrix, space.weights())
    smallest, largest = (_tree.prepare(lambda v, k=k: v[k], values) for k in (0, -1))
    return smallest, largest
