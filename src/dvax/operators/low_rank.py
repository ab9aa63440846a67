"""Operators P that are a diagonal plus a matrix of low rank."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from .abstract import AbstractOperator, Spectrum

_MAX_DENSE_SIZE = 512
"""Number of unknowns up to which the spectrum is computed from the dense matrix."""


class LowRank(AbstractOperator):
    """P v = d ⊙ v + U diag(s) Uᵀ v, with d > 0 and k columns in U, at the cost of 2nk multiplications.

    P⁻¹ is explicit by Woodbury's formula. P is coercive if and only if S⁻¹ + UᵀD⁻¹U has as many
    negative eigenvalues as s has negative entries (Haynsworth's inertia formula); this costs k³.

    The bounds of the spectrum are exact if `diagonal` is one number and k < n, and for up to 512
    unknowns. Otherwise they enclose it: with the eigenvalues ν of D^{−1/2}USUᵀD^{−1/2}, σ(P) lies
    between min d · min(1, 1 + ν) and max d · max(1, 1 + ν).

    **Arguments:** `diagonal`: d, a vector, or one number for all entries; `U`: a matrix with one row
    an entry of v; `s`: a vector of nonzero numbers, which may be negative if P remains coercive.

    **Raises:** `dvax.InputError` if the shapes do not fit, an entry of d is not positive or an entry
    of s is 0. `dvax.Problem` raises it if P is not coercive or not self-adjoint in the control space:
    with weights w, U diag(s) Uᵀ may only couple entries of equal weight.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> P = dvax.operators.LowRank(1.0, jnp.ones((3, 1)), jnp.array([2.0]))
    >>> P.apply(jnp.array([1.0, 0.0, 0.0])).tolist()
    [3.0, 2.0, 2.0]
    >>> round(float(P.spectrum(dvax.spaces.Euclidean(3)).norm), 12)
    7.0

    ```
    """

    diagonal: jax.Array
    U: jax.Array
    s: jax.Array
    inverse_diagonal: jax.Array
    inverse_capacitance: jax.Array

    def __init__(self, diagonal: Any, U: Any, s: Any):
        name = "dvax.operators.LowRank"
        self.diagonal = _tree.as_array(diagonal, f"{name}(diagonal)")
        self.U = _tree.as_array(U, f"{name}(U)", min_size=0)
        self.s = _tree.as_array(s, f"{name}(s)", min_size=0)
        shapes = jnp.shape(self.diagonal), jnp.shape(self.U), jnp.shape(self.s)
        if (
            len(shapes[1]) != 2
            or shapes[0] not in ((), shapes[1][:1])
            or shapes[2] != shapes[1][1:]
        ):
            raise input_error(
                f"{name}(diagonal, U, s)",
                f"shapes {shapes[0]}, {shapes[1]} and {shapes[2]}",
                "U must have one row for each entry of the diagonal (unless that is one number) "
                "and one column for each entry of s",
                "Give the shapes (n,), (n, k) and (k,)",
            )
        _tree.require(
            lambda: jnp.all((self.diagonal > 0) & jnp.isfinite(self.diagonal)),
            f"{name}(diagonal)",
            self.diagonal,
            "the diagonal must be positive and finite, or the inverse has no explicit form",
            "Use dvax.operators.Dense, or move a multiple of the identity into the diagonal",
        )
        _tree.require(
            lambda: jnp.all((self.s != 0) & jnp.isfinite(self.s)) & jnp.all(jnp.isfinite(self.U)),
            f"{name}(U, s)",
            self.s,
            "U must be finite, and the entries of s finite and not 0",
            "Remove the columns of U whose s is 0",
        )
        # Stored, since every evaluation of the law applies P⁻¹.
        self.inverse_diagonal = 1.0 / self.diagonal
        self.inverse_capacitance = jnp.linalg.inv(self._capacitance())

    def apply(self, v: Tree) -> Tree:
        return self.diagonal * v + self.U @ (self.s * (self.U.T @ v))

    def inverse(self, v: Tree) -> Tree:
        scaled = self.inverse_diagonal * v
        correction = self.U @ (self.inverse_capacitance @ (self.U.T @ scaled))
        return scaled - self.inverse_diagonal * correction

    def check(self, space: AbstractSpace) -> None:
        name = "dvax.operators.LowRank(U, s)"
        zeros = space.like()
        if isinstance(zeros, tuple) or jnp.shape(zeros) != self.U.shape[:1]:
            raise input_error(
                name,
                f"U of shape {self.U.shape}",
                f"it acts on the control space, whose elements have shape {_tree.shapes(zeros)}",
                "Give U as many rows as the control has entries, and the control as a vector",
            )
        weights = jnp.broadcast_to(jnp.asarray(space.weights(), self.U.dtype), self.U.shape[:1])
        _tree.require(
            lambda: self._commutes_with(weights),
            name,
            (self.U, weights),
            f"P must be self-adjoint in {space!r}: U diag(s) Uᵀ may only couple equal weights",
            "Use dvax.operators.Dense with a matrix that is self-adjoint for these weights",
        )
        _tree.require(
            self._is_coercive,
            name,
            (self.diagonal, self.U, self.s),
            "P must be coercive, so every eigenvalue must be positive",
            "Increase the diagonal, or the negative entries of s",
        )

    def spectrum(self, space: AbstractSpace) -> Spectrum:
        # If P is self-adjoint its matrix is symmetric and commutes with the weights, so the spectrum
        # does not depend on the weights.
        n, k = self.U.shape
        if jnp.ndim(self.diagonal) == 1 and n <= _MAX_DENSE_SIZE:
            matrix = jnp.diag(self.diagonal) + (self.U * self.s[None, :]) @ self.U.T
            ends = jnp.linalg.eigvalsh(matrix)
            return Spectrum(ends[0], ends[-1])
        root = jnp.broadcast_to(jnp.sqrt(self.inverse_diagonal), (n,))
        triangle = jnp.linalg.qr(root[:, None] * self.U, mode="r")
        nu = 1.0 + jnp.linalg.eigvalsh((triangle * self.s[None, :]) @ triangle.T)
        # For k < n there are vectors orthogonal to U, on which P is the diagonal alone.
        has_complement = k < n
        low = jnp.minimum(1.0, nu[0]) if has_complement else nu[0]
        high = jnp.maximum(1.0, nu[-1]) if has_complement else nu[-1]
        return Spectrum(
            jnp.min(self.diagonal) * low,
            jnp.max(self.diagonal) * high,
            exact=jnp.ndim(self.diagonal) == 0,
        )

    def _capacitance(self) -> jax.Array:
        """Return the capacitance matrix S⁻¹ + UᵀD⁻¹U of Woodbury's formula."""
        inverse = jnp.broadcast_to(self.inverse_diagonal, self.U.shape[:1])
        return jnp.diag(1.0 / self.s) + self.U.T @ (inverse[:, None] * self.U)

    def _is_coercive(self) -> bool:
        negative = jnp.sum(jnp.linalg.eigvalsh(self._capacitance()) < 0)
        return bool(negative == jnp.sum(self.s < 0))

    def _commutes_with(self, weights: jax.Array) -> bool:
        """Return whether W USUᵀ is symmetric, from factors in an orthonormal basis of U and WU.

        This needs matrices of 2k columns, and no n × n matrix."""
        U, w = np.asarray(self.U), np.asarray(weights)
        _, triangle = np.linalg.qr(np.hstack([U, w[:, None] * U]))
        unweighted, weighted = triangle[:, : U.shape[1]], triangle[:, U.shape[1] :]
        product = (weighted * np.asarray(self.s)) @ unweighted.T
        return bool(np.max(np.abs(product - product.T)) <= 1e-12 * np.max(np.abs(product)))
