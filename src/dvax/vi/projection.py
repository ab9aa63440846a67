"""The projection method."""

from typing import Any

import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSolver, Answer, Frozen
from .iteration import Trial, certificate, first_step, iterate
from .parameters import STEPS, check_parameters


class Projection(AbstractSolver):
    """y⁺ = proj_K(y − λF(y)) (Khanh and Vuong 2014, "modified projection method").

    With γ and L_F known, every λ in (0, 2γ/L_F²) contracts:

        ‖y⁺ − y*‖ ≤ [1 + λ(2γ − λL_F²)]^{−1/2} ‖y − y*‖,

    best at λ = γ/L_F², which is what is used: about 2(L_F/γ)² ln(1/ε) iterations, one evaluation of
    F and one projection each.

    Where γ or L_F is unknown, λ = λ₀/(1 + j), with j the number of iterations that did not bring
    the best ‖w‖ down by a thousandth. Either j stops growing, and ‖w‖ falls geometrically; or it
    grows for ever, and then λ → 0 with Σλ = ∞, under which the method converges for every strongly
    pseudomonotone Lipschitz F (same source, Theorem 4.1), but not linearly.

    **Arguments:** `max_steps`, the most iterations.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: 2.0 * y - 1.0, dvax.sets.Box(0.0, 0.25), jnp.array(0.0),
    ...                    solver=dvax.vi.Projection(), gamma=2.0, L_F=2.0)
    >>> float(vi.y)
    0.25

    ```
    """

    max_steps: int = 100_000

    def __check_init__(self) -> None:
        check_parameters(self, max_steps=STEPS)

    def contraction(self, gamma: Any, L_F: Any) -> Any:
        """The proven factor q = (1 + (γ/L_F)²)^{−1/2} with ‖y⁺ − y*‖ ≤ q‖y − y*‖ at λ = γ/L_F²."""
        return 1.0 / jnp.sqrt(1.0 + (gamma / L_F) ** 2)

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        best = None if vi.gamma is None or vi.L_F is None else vi.gamma / vi.L_F**2

        def begin(vi: Frozen, y: Tree) -> tuple:
            Fy = vi.F(y)
            first = first_step(vi, y, Fy)
            first = first if best is None else jnp.asarray(best, first.dtype)
            return y, Fy, first, jnp.zeros_like(first), jnp.full_like(first, jnp.inf)

        def advance(vi: Frozen, state: tuple) -> tuple[tuple, Trial]:
            y, Fy, first, failures, least = state
            lam = first / (1.0 + failures)
            z = vi.K.project(_tree.sub(y, _tree.scale(lam, Fy)), vi.space)
            Fz = vi.F(z)
            w = certificate(Fz, Fy, y, z, lam)
            if best is None:
                residual = vi.space.norm(w)
                fell = residual <= 0.999 * least
                failures = jnp.where(fell, failures, failures + 1.0)
                least = jnp.minimum(least, residual)
            # A λ that is known to be right may be as small as it likes.
            step = lam if best is None else jnp.asarray(1.0 / vi.L_F, lam.dtype)
            trial = Trial(z, w, Fz, step, [z], 1, base=(y, lam))
            return (z, Fz, first, failures, least), trial

        return iterate(vi, y0, tol, begin, advance, self.max_steps, begun=1 + (vi.L_F is None))
