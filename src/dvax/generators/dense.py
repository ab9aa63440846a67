"""A given as a matrix."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from .abstract import AbstractGenerator, AbstractPropagator, Arc, Growth
from .bend import normwise_bend
from .phi import flow_factors, phi_matrix


class Dense(AbstractGenerator):
    """A v = matrix @ v for states that are vectors of n entries.

    The growth bound is the logarithmic norm: M = 1 and ω = λ_max of the symmetric part of A in the
    space's inner product, since d/dt ½‖e^{At}v‖² = ⟨A e^{At}v, e^{At}v⟩ ≤ ω‖e^{At}v‖². For a matrix
    far from normal that ω is far above the real parts of the eigenvalues. With `omega` given, any
    number above those, M is √cond(Q) for the Q > 0 with (A − ω)ᵀQ + Q(A − ω) = −I (Lyapunov): in the
    norm of Q the semigroup grows no faster than e^{ωt}, and that norm is within √cond(Q) of the
    space's. The bound is checked on the Q found, so it holds though Q is rounded.

    **Arguments:** `matrix`: square, in 1/time; `omega`: the rate that the growth bound should have, in
    1/time.

    **Raises:** `dvax.InputError` where the matrix is not square, or `omega` not above the real parts
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
            raise InputError(
                InputProblem(
                    "dvax.generators.Dense(matrix)",
                    f"shape {shape}",
                    "a generator maps the state space to itself, so its matrix is square",
                    "Use dvax.generators.Diagonal for a vector of diagonal entries",
                )
            )
        self.omega = None
        if omega is not None:
            name = "dvax.generators.Dense(omega)"
            rate = self.omega = _tree.as_number(omega, name, "Give the rate of the growth bound")
            _tree.require(
                lambda: np.isfinite(rate), name, rate,
                "the rate of a growth bound is a finite number", "Leave it out, or give a finite one",
            )  # fmt: skip
            _tree.require(
                lambda: np.isfinite(self.matrix), "dvax.generators.Dense(matrix)", self.matrix,
                "every entry must be finite", "Correct the matrix there",
            )  # fmt: skip
            _tree.require(
                lambda: np.max(np.real(np.linalg.eigvals(np.asarray(self.matrix)))) < float(rate),
                name,
                rate,
                "no e^{ωt} bounds the semigroup unless ω is above the real part of every eigenvalue",
                "Give a larger one, or leave it out for the logarithmic norm",
            )

    def apply(self, v: Tree) -> Tree:
        return self.matrix @ v

    def propagator(self, h: Any, terms: int) -> "MatrixPropagator":
        return MatrixPropagator(flow_factors(h, phi_matrix(h * self.matrix, terms)))

    def check(self, space: AbstractSpace) -> None:
        name = "dvax.generators.Dense(matrix)"
        _tree.fits_matrix(name, self.matrix, space.zeros(), "state space")

    def adjoint(self, space: AbstractSpace) -> "Dense":
        # ⟨Av, w⟩ = vᵀAᵀWw, so A* = W⁻¹AᵀW.
        w = jnp.broadcast_to(space.weights(), self.matrix.shape[:1])
        return Dense(self.matrix.T * w[None, :] / w[:, None], self.omega)

    def growth(self, space: AbstractSpace) -> Growth:
        # ⟨Av, v⟩ = vᵀWAv: with q = W^{1/2}v it is qᵀ(W^{1/2}AW^{-1/2})q, so weights only rescale.
        root = jnp.broadcast_to(jnp.sqrt(space.weights()), self.matrix.shape[:1])
        similar = root[:, None] * self.matrix / root[None, :]
        if self.omega is not None:
            return Growth(_overshoot(similar, self.omega), self.omega)
        return Growth(jnp.ones(()), jnp.linalg.eigvalsh(0.5 * (similar + similar.T))[-1])

    def bend(self, arc: Arc, space: AbstractSpace, growth: Growth) -> Tree:
        return normwise_bend(self, arc, space, growth)


def _overshoot(matrix: jax.Array, omega: jax.Array) -> jax.Array:
    """An M with ‖e^{At}‖ ≤ M e^{ωt}, by Lyapunov's equation; ∞ where it shows none."""
    eye = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    shifted = matrix - omega * eye
    Q = jax.scipy.linalg.solve_sylvester(shifted.T, shifted, -eye)
    Q = 0.5 * (Q + Q.T)
    sizes = jnp.linalg.eigvalsh(Q)
    falls = jnp.linalg.eigvalsh(shifted.T @ Q + Q @ shifted)[-1] <= 0.0
    holds = falls & (sizes[0] > 0.0)
    return jnp.where(holds, jnp.sqrt(sizes[-1] / jnp.where(holds, sizes[0], 1.0)), jnp.inf)


class MatrixPropagator(AbstractPropagator):
    """Factors that are matrices."""

    factors: tuple[jax.Array, ...]

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        products = [m @ v for m, v in zip(self.factors, (x0, *c), strict=False)]
        return sum(products[1:], start=products[0])
