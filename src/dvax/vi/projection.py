"""The projection method."""

from typing import Any

import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSolver, Answer, FrozenVI
from .iteration import Trial, first_step, iterate, residual_vector
from .parameters import STEPS, check_parameters


class Projection(AbstractSolver):
    """y⁺ = proj_K(y − λF(y)) (Khanh and Vuong 2014, "modified projection method").

    With γ and L_F known, every λ in (0, 2γ/L_F²) contracts:

        ‖y⁺ − y*‖ ≤ [1 + λ(2γ − λL_F²)]^{−1/2} ‖y − y*‖,

    with the smallest factor at λ = γ/L_F², the step used here: about 2(L_F/γ)² ln(1/ε) iterations, with
    one evaluation of F and one projection each.

    If γ or L_F is unknown, λ = λ₀/(1 + j), with j the number of iterations that did not reduce the
    smallest ‖w‖ by a thousandth. Either j remains bounded, and ‖w‖ decreases geometrically;
    or j → ∞, and then λ → 0 with Σλ = ∞, under which the method converges for every strongly
    pseudomonotone Lipschitz F (same source, Theorem 4.1), but not linearly.

    **Arguments:** `max_steps`, the maximum number of iterations.

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
        """Return the proved factor q = (1 + (γ/L_F)²)^{−1/2} with ‖y⁺ − y*‖ ≤ q‖y − y*‖ at λ =
        γ/L_F²."""
        return 1.0 / jnp.sqrt(1.0 + (gamma / L_F) ** 2)

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        contracting_step = None if vi.gamma is None or vi.L_F is None else vi.gamma / vi.L_F**2

        def begin(vi: FrozenVI, y: Tree) -> tuple:
            Fy = vi.F(y)
            first = first_step(vi, y, Fy)
            first = (
                first if contracting_step is None else jnp.asarray(contracting_step, first.dtype)
            )
            return y, Fy, first, jnp.zeros_like(first), jnp.full_like(first, jnp.inf)

        def advance(vi: FrozenVI, state: tuple) -> tuple[tuple, Trial]:
            y, Fy, first, failures, least = state
            lam = first / (1.0 + failures)
            z = vi.K.project(_tree.sub(y, _tree.scale(lam, Fy)), vi.space)
            Fz = vi.F(z)
            w = residual_vector(Fz, Fy, y, z, lam)
            shrinks: Any = False  # then a point that was there before is no cycle
            if contracting_step is None:
                residual = vi.space.norm(w)
                decreased = residual <= 0.999 * least
                shrinks = ~decreased
                failures = jnp.where(decreased, failures, failures + 1.0)
                least = jnp.minimum(least, residual)
            # A proved λ may be arbitrarily small, so 1/L_F is reported: the loop must not reject it.
            step = lam if contracting_step is None else jnp.asarray(1.0 / vi.L_F, lam.dtype)
            trial = Trial(z, w, Fz, step, [z], 1, may_repeat=shrinks, base=(y, lam))
            return (z, Fz, first, failures, least), trial

        return iterate(
            vi, y0, tol, begin, advance, self.max_steps, initial_evaluations=1 + (vi.L_F is None)
        )
