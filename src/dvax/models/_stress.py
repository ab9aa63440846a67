"""Symmetric tensors as vectors in a basis that diagonalises isotropic elasticity."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_ROOT2 = math.sqrt(2.0)

BASIS = np.array(
    [
        [-1 / math.sqrt(3), -1 / math.sqrt(3), -1 / math.sqrt(3), 0, 0, 0],
        [1 / _ROOT2, -1 / _ROOT2, 0, 0, 0, 0],
        [1 / math.sqrt(6), 1 / math.sqrt(6), -2 / math.sqrt(6), 0, 0, 0],
        [0, 0, 0, 1, 0, 0],
        [0, 0, 0, 0, 1, 0],
        [0, 0, 0, 0, 0, 1],
    ]
)
"""Orthonormal rows: minus the direction of the unit tensor, then five deviators."""


def mandel(tensor: Any) -> jax.Array:
    """Return (T₁₁, T₂₂, T₃₃, √2T₂₃, √2T₁₃, √2T₁₂) of a symmetric tensor, shape (…, 3, 3) to (…, 6).

    With the factors √2 the inner product of the vectors equals that of the tensors, a·b = A : B. With
    Voigt's factors (1 for stress, 2 for strain) it would not, and projections would be wrong.

    ```python
    >>> import jax.numpy as jnp
    >>> from dvax.models.duvaut_lions import mandel
    >>> v = mandel(jnp.array([[1.0, 0.5, 0.0], [0.5, 2.0, 0.0], [0.0, 0.0, 3.0]]))
    >>> round(float(v @ v), 12)                        # 1 + 4 + 9 + 2 · 0.25
    14.5

    ```
    """
    T = jnp.asarray(tensor)
    parts = [T[..., 0, 0], T[..., 1, 1], T[..., 2, 2]]
    parts += [_ROOT2 * T[..., i, j] for i, j in ((1, 2), (0, 2), (0, 1))]
    return jnp.stack(parts, axis=-1)


def tensor(vector: Any) -> jax.Array:
    """Return the symmetric tensor of a Mandel vector, shape (…, 6) to (…, 3, 3)."""
    v = jnp.asarray(vector)
    off = v[..., 3:] / _ROOT2
    rows = [
        [v[..., 0], off[..., 2], off[..., 1]],
        [off[..., 2], v[..., 1], off[..., 0]],
        [off[..., 1], off[..., 0], v[..., 2]],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def split(vector: Any) -> jax.Array:
    """Return (−tr/√3, five components of the deviator) of a Mandel vector, an orthogonal map."""
    v = jnp.asarray(vector)
    return v @ jnp.asarray(BASIS.T, v.dtype)


def join(parts: Any) -> jax.Array:
    """Return the Mandel vector with these `split` components."""
    y = jnp.asarray(parts)
    return y @ jnp.asarray(BASIS, y.dtype)
