"""P as a diagonal and a few directions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from .abstract import AbstractOperator, Spectrum

_DENSE = 512
"""Up to this size the spectrum is that of the matrix written out."""


class LowRank(AbstractOperator):
    """P v = d ⊙ v + U diag(s) Uᵀ v, with d > 0 and k columns in U, at the cost of 2nk products.

    P⁻¹ is explicit as well (Woodbury). P is coercive exactly when S⁻¹ + UᵀD⁻¹U has as many negative
    eigenvalues as there are negative s (Haynsworth's inertia formula), which costs k³.

    The ends of the spectrum are exact for a `diagonal` that is one number with k < n, and up to 512
    unknowns. Beyond, they enclose it: with ν the eigenvalues of D^{−1/2}USUᵀD^{−1/2}, σ(P) lies
    between min d · min(1, 1 + ν) and max d · max(1, 1 + ν).

    **Arguments:** `diagonal`: d, a vector, or one number for all of it; `U`: a matrix with a row an
    entry of v; `s`: a vector, no entry 0, negative ones allowed while P stays coercive.

    **Raises:** `dvax.InputError` where shapes do not fit, an entry of d is not positive or of s is 0;
    and, when a `dvax.Problem` is made of it, where P is not coercive, or not self-adjoint there:
    in a space with weights w, U diag(s) Uᵀ may only couple entries that weigh the same.

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
    middle: jax.Array

    def __init__(self, diagonal: Any, U: Any, s: Any):
        name = "dvax.operators.LowRank"
        self.diagonal = _tree.as_array(diagonal, f"{name}(diagonal)")
        self.U = _tree.as_array(U, f"{name}(U)", least=0)
        self.s = _tree.as_array(s, f"{name}(s)", least=0)
        shapes = jnp.shape(self.diagonal), jnp.shape(self.U), jnp.shape(self.s)
        if (
            len(shapes[1]) != 2
            or shapes[0] not in ((), shapes[1][:1])
            or shapes[2] != shapes[1][1:]
        ):
            raise InputError(
                InputProblem(
                    f"{name}(diagonal, U, s)",
                    f"shapes {shapes[0]}, {shapes[1]} and {shapes[2]}",
                    "U has a row an entry of the diagonal (or that is one number) and a column an "
                    "entry of s",
                    "Give the shapes (n,), (n, k) and (k,)",
                )
            )
        _tree.require(
            lambda: jnp.all((self.diagonal > 0) & jnp.isfinite(self.diagonal)),
            f"{name}(diagonal)",
            self.diagonal,
            "the diagonal part is positive and finite, or the inverse has no explicit form",
            "Use dvax.operators.Dense, or move a multiple of the identity into the diagonal",
        )
        _tree.require(
            lambda: jnp.all((self.s != 0) & jnp.isfinite(self.s)) & jnp.all(jnp.isfinite(self.U)),
            f"{name}(U, s)",
            self.s,
            "the directions are finite and their factors not 0",
            "Leave out the columns of U whose s is 0",
        )
        # Kept: the law applies P⁻¹ at every evaluation.
        self.inverse_diagonal = 1.0 / self.diagonal
        self.middle = jnp.linalg.inv(self._capacity())

    def apply(self, v: Tree) -> Tree:
        return self.diagonal * v + self.U @ (self.s * (self.U.T @ v))

    def inverse(self, v: Tree) -> Tree:
        across = self.inverse_diagonal * v
        return across - self.inverse_diagonal * (self.U @ (self.middle @ (self.U.T @ across)))

    def check(self, space: AbstractSpace) -> None:
        name = "dvax.operators.LowRank(U, s)"
        zeros = space.zeros()
        if isinstance(zeros, tuple) or jnp.shape(zeros) != self.U.shape[:1]:
            raise InputError(
                InputProblem(
                    name,
                    f"U of shape {self.U.shape}",
                    f"it acts on the control space, whose elements have shape {_tree.shapes(zeros)}",
                    "Give U as many rows, and the control as a vector",
                )
            )
        weights = jnp.broadcast_to(jnp.asarray(space.weights(), self.U.dtype), self.U.shape[:1])
        _tree.require(
            lambda: self._commutes(weights),
            name,
            (self.U, weights),
            f"P must be self-adjoint in {space!r}: U diag(s) Uᵀ couples entries that weigh the same",
            "Use dvax.operators.Dense with a matrix that is self-adjoint for these weights",
        )
        _tree.require(
            self._coercive,
            name,
            (self.diagonal, self.U, self.s),
            "P must be coercive, so every eigenvalue is positive",
            "Raise the diagonal, or the negative entries of s",
        )

    def spectrum(self, space: AbstractSpace) -> Spectrum:
        # Where P is self-adjoint, its matrix is symmetric and commutes with the weights, so the
        # spectrum is that of the matrix in every such space.
        n, k = self.U.shape
        if jnp.ndim(self.diagonal) == 1 and n <= _DENSE:
            matrix = jnp.diag(self.diagonal) + (self.U * self.s[None, :]) @ self.U.T
            ends = jnp.linalg.eigvalsh(matrix)
            return Spectrum(ends[0], ends[-1])
        root = jnp.broadcast_to(jnp.sqrt(self.inverse_diagonal), (n,))
        triangle = jnp.linalg.qr(root[:, None] * self.U, mode="r")
        nu = 1.0 + jnp.linalg.eigvalsh((triangle * self.s[None, :]) @ triangle.T)
        # With as many directions as entries, none may be left where P is the diagonal alone.
        alone = k < n
        low = jnp.minimum(1.0, nu[0]) if alone else nu[0]
        high = jnp.maximum(1.0, nu[-1]) if alone else nu[-1]
        return Spectrum(
            jnp.min(self.diagonal) * low,
            jnp.max(self.diagonal) * high,
            exact=jnp.ndim(self.diagonal) == 0,
        )

    def _capacity(self) -> jax.Array:
        """S⁻¹ + UᵀD⁻¹U."""
        rest = jnp.broadcast_to(self.inverse_diagonal, self.U.shape[:1])
        return jnp.diag(1.0 / self.s) + self.U.T @ (rest[:, None] * self.U)

    def _coercive(self) -> bool:
        negative = jnp.sum(jnp.linalg.eigvalsh(self._capacity()) < 0)
        return bool(negative == jnp.sum(self.s < 0))

    def _commutes(self, weights: jax.Array) -> bool:
        """Whether W USUᵀ is symmetric, from 2k columns: in a basis Q of U and WU both factors are
        small, and no n × n matrix is written out."""
        U, w = np.asarray(self.U), np.asarray(weights)
        _, triangle = np.linalg.qr(np.hstack([U, w[:, None] * U]))
        plain, weighted = triangle[:, : U.shape[1]], triangle[:, U.shape[1] :]
        product = (weighted * np.asarray(self.s)) @ plain.T
        return bool(np.max(np.abs(product - product.T)) <= 1e-12 * np.max(np.abs(product)))
