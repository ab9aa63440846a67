"""Tseng's forward-backward-forward method."""

from functools import partial
from typing import Any

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSolver, Answer, FrozenVI
from .extragradient import contraction, extrapolate, initial_state
from .iteration import Trial, iterate, residual_vector
from .parameters import SAFETY, STEPS, check_parameters


class ForwardBackwardForward(AbstractSolver):
    """z = proj_K(y − λF(y)), y⁺ = z − λ(F(z) − F(y)): one projection per iteration (Tseng 2000).

    With L_F known, λ = step/L_F, and for F strongly pseudomonotone with modulus γ

        ‖y⁺ − y*‖² ≤ ‖y − y*‖² − (1 − λ²L_F²)‖y − z‖² − 2λγ‖z − y*‖²,

    so that every iteration contracts by q² = 1 − ab/(a+b), a = 1 − λ²L_F², b = 2λγ, as for
    `Extragradient` (Boţ, Csetnek and Vuong 2020 for pseudomonotone F). With L_F unknown, λ is found
    by backtracking until λ‖F(y) − F(z)‖ ≤ step ‖y − z‖, which implies the inequality with
    a = 1 − step².

    y may leave K, so F must be defined in a neighbourhood of K. z lies in K and is returned.

    **Arguments:** `step` in (0, 1); `max_steps`, the maximum number of iterations.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: 2.0 * y - 1.0, dvax.sets.Box(0.0, 0.25), jnp.array(0.0),
    ...                    solver=dvax.vi.ForwardBackwardForward(), gamma=2.0)
    >>> float(vi.y)
    0.25

    ```
    """

    step: float = 0.7
    max_steps: int = 10_000

    def __check_init__(self) -> None:
        check_parameters(self, step=SAFETY, max_steps=STEPS)

    def contraction(self, gamma: Any, L_F: Any) -> Any:
        """Return the proved factor q with ‖y⁺ − y*‖ ≤ q‖y − y*‖ at the step λ = step/L_F."""
        return contraction(self.step, gamma, L_F)

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        begin = partial(initial_state, self.step)

        def advance(vi: FrozenVI, state: tuple) -> tuple[tuple, Trial]:
            y, lam = state
            Fy = vi.F(y)
            z, Fz, lam, evaluations = extrapolate(vi, y, Fy, lam, self.step)
            after = _tree.sub(z, _tree.scale(lam, _tree.sub(Fz, Fy)))
            w = residual_vector(Fz, Fy, y, z, lam)
            return (after, lam), Trial(z, w, Fz, lam, [after], evaluations + 1, base=(y, lam))

        return iterate(
            vi, y0, tol, begin, advance, self.max_steps, initial_evaluations=1 + (vi.L_F is None)
        )
