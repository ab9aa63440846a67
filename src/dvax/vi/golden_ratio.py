"""Malitsky's golden ratio algorithm, with its adaptive step."""

from typing import Any

import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSolver, Answer, Frozen
from .iteration import Trial, certificate, first_step, iterate
from .parameters import GOLDEN, STEPS, check_parameters

_LONGEST = 1e10


class GoldenRatio(AbstractSolver):
    """x̄ = ((φ−1)y + x̄)/φ, y⁺ = proj_K(x̄ − λF(y)): one evaluation and one projection an iteration,
    and neither γ nor L_F need be known (aGRAAL, Malitsky 2020, Algorithm 1):

        λ⁺ = min{(1/φ + 1/φ²) λ, φθ/(4λ) ‖y − y₋‖²/‖F(y) − F(y₋)‖², 10¹⁰},   θ⁺ = φ λ⁺/λ.

    It converges wherever ⟨F(y), y − y*⟩ ≥ 0 on K for a solution y*, which strong pseudomonotonicity
    implies, and linearly under the error bound C1. λ follows the local steepness of F and may grow.
    φ = 1.5 and not the golden ratio itself, as its author recommends: then λ can grow by 1/9 an
    iteration.

    **Arguments:** `phi` in (1, 1.618]; `max_steps`, the most iterations.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: 2.0 * y - 1.0, dvax.sets.Box(0.0, 0.25), jnp.array(0.0),
    ...                    solver=dvax.vi.GoldenRatio(), gamma=2.0)
    >>> float(vi.y)
    0.25

    ```
    """

    phi: float = 1.5
    max_steps: int = 20_000

    def __check_init__(self) -> None:
        check_parameters(self, phi=GOLDEN, max_steps=STEPS)

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        phi = self.phi
        growth = 1.0 / phi + 1.0 / phi**2

        def begin(vi: Frozen, y: Tree) -> tuple:
            Fy = vi.F(y)
            lam = first_step(vi, y, Fy)
            # A first point apart from y, for the first difference quotient.
            after = vi.K.project(_tree.sub(y, _tree.scale(lam, Fy)), vi.space)
            return after, vi.F(after), y, Fy, y, lam, jnp.ones_like(lam)

        def advance(vi: Frozen, state: tuple) -> tuple[tuple, Trial]:
            y, Fy, before, F_before, average, lam, theta = state
            moved = vi.space.norm(_tree.sub(y, before))
            turned = vi.space.norm(_tree.sub(Fy, F_before))
            flat = turned == 0
            ratio = moved / jnp.where(flat, 1.0, turned)
            limit = jnp.where(flat, jnp.inf, phi * theta / (4.0 * lam) * ratio**2)
            new = jnp.minimum(jnp.minimum(growth * lam, limit), _LONGEST)
            average = _tree.scale(1 / phi, _tree.add(_tree.scale(phi - 1, y), average))
            after = vi.K.project(_tree.sub(average, _tree.scale(new, Fy)), vi.space)
            F_after = vi.F(after)
            w = certificate(F_after, Fy, average, after, new)
            state = after, F_after, y, Fy, average, new, phi * new / lam
            return state, Trial(after, w, F_after, new, [after, average], 1, base=(average, new))

        return iterate(
            vi, y0, tol, begin, advance, self.max_steps, begun=2 + (vi.L_F is None), moves=2
        )
