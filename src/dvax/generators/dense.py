"""Generators given by a dense matrix."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from ..spaces.matrices import numerical_range_on_axis, similar_matrix
from .abstract import AbstractGenerator, AbstractPropagator, FlowStep, Growth
from .chord_deviation import normwise_chord_deviation
from .phi import flow_factors, phi_matrix


class Dense(AbstractGenerator):
    """A v = matrix @ v for states that are vectors of n entries.

    The growth bound is the logarithmic norm: M = 1 and ω = λ_max of the symmetric part of A in the
    space's inner product, since d/dt ½‖e^{At}v‖² = ⟨A e^{At}v, e^{At}v⟩ ≤ ω‖e^{At}v‖². For a highly
    non-normal matrix this ω is much larger than the real parts of the eigenvalues. `omega` may then
    prescribe any rate above these real parts, with M = √cond(Q) for the solution Q > 0 of Lyapunov's
    equation (A − ω)ᵀQ + Q(A − ω) = −I: in the norm of Q the semigroup grows at most as e^{ωt}, and
    this norm is equivalent to that of the space with the factor √cond(Q). The bound is verified for
    the computed Q, so it holds despite the roundoff in Q.

    **Arguments:** `matrix`: square, in 1/time; `omega`: the prescribed rate of the growth bound, in
    1/time.

    **Raises:** `dvax.InputError` if the matrix is not square, or `omega` is not above the real parts
    of its eigenvalues.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> A = dvax.generators.Dense(jnp.array([[-1.0, 2.0], [-2.0, -1.0]]))
    >>> float(A.growth(dvax.spaces.Euclidean(2)).omega)
    -1.0

    ```
    """

    matrix: jax.Array
    omega: jax.Array | None

    def __init__(self, matrix: Any, omega: Any = None):
        self.matrix = _tree.as_array(matrix, "dvax.generators.Dense(matrix)")
        shape = self.matrix.shape
        if len(shape) != 2 or shape[0] != shape[1]:
            raise input_error(
                "dvax.generators.Dense(matrix)",
                f"shape {shape}",
                "a generator maps the state space to itself, so its matrix must be square",
                "Use dvax.generators.Diagonal for a vector of diagonal entries",
            )
        self.omega = None
        if omega is not None:
            name = "dvax.generators.Dense(omega)"
            rate = self.omega = _tree.as_number(omega, name, "Give the rate of the growth bound")
            _tree.require(
                lambda: np.isfinite(rate), name, rate,
                "the rate of a growth bound must be finite", "Omit it, or give a finite number",
            )  # fmt: skip
            _tree.require(
                lambda: np.isfinite(self.matrix), "dvax.generators.Dense(matrix)", self.matrix,
                "every entry must be finite", "Correct the entries that are not",
            )  # fmt: skip
            _tree.require(
                lambda: np.max(np.real(np.linalg.eigvals(np.asarray(self.matrix)))) < float(rate),
                name,
                rate,
                "omega must be above the real part of every eigenvalue, or e^{ωt} is no bound",
                "Give a larger value, or omit it for the logarithmic norm",
            )

    def apply(self, v: Tree) -> Tree:
        return self.matrix @ v

    def propagator(self, h: Any, terms: int) -> "MatrixPropagator":
        return MatrixPropagator(flow_factors(h, phi_matrix(h * self.matrix, terms)))

    def check(self, space: AbstractSpace) -> None:
        name = "dvax.generators.Dense(matrix)"
        _tree.fits_matrix(name, self.matrix, space.like(), "state space")

    def adjoint(self, space: AbstractSpace) -> "Dense":
        # ⟨Av, w⟩ = vᵀAᵀWw, so A* = W⁻¹AᵀW.
        w = jnp.broadcast_to(space.weights(), self.matrix.shape[:1])
        return Dense(self.matrix.T * w[None, :] / w[:, None], self.omega)

    def growth(self, space: AbstractSpace) -> Growth:
        # ⟨Av, v⟩ = vᵀWAv = qᵀ(W^{1/2}AW^{-1/2})q with q = W^{1/2}v.
        if self.omega is not None:
            similar = similar_matrix(self.matrix, space.weights())
            return Growth(_lyapunov_constant(similar, self.omega), self.omega)
        return Growth(jnp.ones(()), numerical_range_on_axis(self.matrix, space)[1])

    def chord_deviation(self, step: FlowStep, space: AbstractSpace, growth: Growth) -> Tree:
        return normwise_chord_deviation(self, step, space, growth)


_MOST_DOUBLINGS = 60
"""2⁶⁰ terms are more than any matrix needs whose eigenvalues can be told from 0 in doubles."""


def _lyapunov_constant(matrix: jax.Array, omega: jax.Array) -> jax.Array:
    """Return M with ‖e^{At}‖ ≤ M e^{ωt} from Lyapunov's equation, or ∞ if it yields no bound."""
    eye = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    shifted = matrix - omega * eye
    Q = _lyapunov_solution(shifted)
    eigenvalues = jnp.linalg.eigvalsh(Q)
    decreasing = jnp.linalg.eigvalsh(shifted.T @ Q + Q @ shifted)[-1] <= 0.0
    holds = decreasing & (eigenvalues[0] > 0.0)
    smallest = jnp.where(holds, eigenvalues[0], 1.0)
    return jnp.where(holds, jnp.sqrt(eigenvalues[-1] / smallest), jnp.inf)


def _lyapunov_solution(S: jax.Array) -> jax.Array:
    """Return Q with SᵀQ + QS = −I, if every eigenvalue of S has a negative real part.

    With U = (pI − S)⁻¹(pI + S), p > 0, the equation with −R for −I is Q = V + UᵀQU, where
    V = 2p(pI − S)⁻ᵀR(pI − S)⁻¹. Its series is summed by doubling (Smith, SIAM J. Appl. Math. 16, 1968):
    products of matrices, which every platform has; a Schur decomposition exists on processors only.
    A second solve, for the residual, removes most of the rounding of the first.
    """
    eye = jnp.eye(S.shape[0], dtype=S.dtype)
    # The geometric mean of the smallest and the largest modulus of an eigenvalue, as far as norms say.
    p = jnp.sqrt(jnp.linalg.norm(S) / jnp.linalg.norm(jnp.linalg.inv(S)))
    inverse = jnp.linalg.inv(p * eye - S)

    def unfinished(carry: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        U, _, doublings = carry
        return (jnp.max(jnp.abs(U)) > jnp.finfo(S.dtype).eps) & (doublings < _MOST_DOUBLINGS)

    def double(
        carry: tuple[jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        U, Q, doublings = carry
        return U @ U, Q + U.T @ Q @ U, doublings + 1

    def improve(_: jax.Array, Q: jax.Array) -> jax.Array:
        R = eye + S.T @ Q + Q @ S
        V = 2.0 * p * inverse.T @ R @ inverse
        start = inverse @ (p * eye + S), V, jnp.zeros((), int)
        Q = Q + jax.lax.while_loop(unfinished, double, start)[1]
        return 0.5 * (Q + Q.T)

    return jax.lax.fori_loop(0, 2, improve, jnp.zeros_like(S))


class MatrixPropagator(AbstractPropagator):
    """A propagator whose factors are dense matrices."""

    factors: tuple[jax.Array, ...]

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        products = [m @ v for m, v in zip(self.factors, (x0, *c), strict=False)]
        return sum(products[1:], start=products[0])
