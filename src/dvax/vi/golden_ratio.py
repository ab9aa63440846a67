"""Malitsky's golden ratio algorithm, with its adaptive step."""

from typing import Any

import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSolver, Answer, FrozenVI
from .iteration import Trial, first_step, iterate, residual_vector
from .parameters import GOLDEN, STEPS, check_parameters

_LARGEST_STEP = 1e10


class GoldenRatio(AbstractSolver):
    """x̄ = ((φ−1)y + x̄)/φ, y⁺ = proj_K(x̄ − λF(y)): one evaluation and one projection per iteration,
    with γ and L_F unknown (aGRAAL, Malitsky 2020, Algorithm 1):

        λ⁺ = min{(1/φ + 1/φ²) λ, φθ/(4λ) ‖y − y₋‖²/‖F(y) − F(y₋)‖², 10¹⁰},   θ⁺ = φ λ⁺/λ.

    It converges wherever ⟨F(y), y − y*⟩ ≥ 0 on K for a solution y*, which strong pseudomonotonicity
    implies, and linearly under the error bound C1. λ follows the local steepness of F and may grow.
    The default φ = 1.5, below the golden ratio, is the author's recommendation: λ can then grow by 1/9
    per iteration.

    **Arguments:** `phi` in (1, 1.618]; `max_steps`, the maximum number of iterations.

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

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        return golden_ratio(vi, y0, tol, self.max_steps, phi=self.phi)


def golden_ratio(
    vi: FrozenVI, y0: Tree, tol: Any, max_steps: int, first: Any = None, phi: float = 1.5
) -> Answer:
    """Run the golden ratio algorithm.

    Without a `first` step λ₀ is a difference quotient at proj_K(y0), and a projection step from there
    gives the second point. With one, both points are y0, which saves evaluations and projections if y0
    is close to the solution; F must then be defined at y0 even if it lies outside of K.
    """
    growth = 1.0 / phi + 1.0 / phi**2

    def begin(vi: FrozenVI, y: Tree) -> tuple:
        Fy = vi.F(y)
        if first is not None:
            lam = jnp.asarray(first)
            return y, Fy, y, Fy, y, lam, jnp.ones_like(lam)
        lam = first_step(vi, y, Fy)
        # A second point, for the first difference quotient.
        after = vi.K.project(_tree.sub(y, _tree.scale(lam, Fy)), vi.space)
        return after, vi.F(after), y, Fy, y, lam, jnp.ones_like(lam)

    def advance(vi: FrozenVI, state: tuple) -> tuple[tuple, Trial]:
        y, Fy, y_previous, F_previous, average, lam, theta = state
        distance = vi.space.norm(_tree.sub(y, y_previous))
        change = vi.space.norm(_tree.sub(Fy, F_previous))
        flat = change == 0
        ratio = distance / jnp.where(flat, 1.0, change)
        limit = jnp.where(flat, jnp.inf, phi * theta / (4.0 * lam) * ratio**2)
        new = jnp.minimum(jnp.minimum(growth * lam, limit), _LARGEST_STEP)
        average = _tree.scale(1 / phi, _tree.add(_tree.scale(phi - 1, y), average))
        after = vi.K.project(_tree.sub(average, _tree.scale(new, Fy)), vi.space)
        F_after = vi.F(after)
        w = residual_vector(F_after, Fy, average, after, new)
        state = after, F_after, y, Fy, average, new, phi * new / lam
        return state, Trial(after, w, F_after, new, [after, average], 1, base=(average, new))

    evaluations = 1 if first is not None else 2 + (vi.L_F is None)
    return iterate(
        vi, y0, tol, begin, advance, max_steps, initial_evaluations=evaluations, iterate_count=2,
        projects_start=first is None,
    )  # fmt: skip
