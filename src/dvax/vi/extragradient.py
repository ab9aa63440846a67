"""Korpelevich's extragradient method."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSolver, Answer, FrozenVI
from .iteration import Trial, first_step, iterate, residual_vector
from .parameters import SAFETY, STEPS, check_parameters

GROWTH, REDUCTION = 1.25, 0.6
"""Backtracking starts from the last λ times `GROWTH`, so that λ recovers in regions where F is flatter,
and reduces it by `REDUCTION`."""

SMALLEST_REDUCTION = 1e-24
"""Backtracking stops when λ has been reduced by this factor."""


class Extragradient(AbstractSolver):
    """z = proj_K(y − λF(y)), y⁺ = proj_K(y − λF(z)).

    With L_F known the step is λ = step/L_F, and for F strongly pseudomonotone with modulus γ every
    iteration contracts: ‖y⁺ − y*‖² ≤ (1 − ab/(a+b)) ‖y − y*‖² with a = 1 − λ²L_F², b = 2λγ.
    This follows from ‖y⁺−y*‖² ≤ ‖y−y*‖² − a‖y−z‖² − b‖z−y*‖² (Korpelevich 1976, with strong
    pseudomonotonicity in the last term) and a p² + b q² ≥ ab/(a+b) (p+q)².
    With L_F unknown, λ is found by backtracking until λ‖F(y) − F(z)‖ ≤ step ‖y − z‖
    (Khobotov 1987), which implies the same inequality with a = 1 − step².

    The certificate of z needs no further evaluation: w = F(z) − F(y) + (y − z)/λ.

    **Arguments:** `step` in (0, 1); `max_steps`, the maximum number of iterations.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: 2.0 * y - 1.0, dvax.sets.Box(0.0, 0.25), jnp.array(0.0),
    ...                    solver=dvax.vi.Extragradient(), gamma=2.0)
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
            after, trial = extragradient_step(vi, y, lam, self.step)
            return (after, trial.step), trial._replace(iterates=[after])

        return iterate(
            vi, y0, tol, begin, advance, self.max_steps, initial_evaluations=1 + (vi.L_F is None)
        )


def contraction(step: float, gamma: Any, L_F: Any) -> Any:
    """Return the factor q, which Tseng's method has as well."""
    a, b = 1.0 - step**2, 2.0 * step * gamma / L_F
    return jnp.sqrt(1.0 - a * b / (a + b))


def initial_state(step: float, vi: FrozenVI, y: Tree) -> tuple[Tree, Any]:
    """Return the first iterate and the first λ."""
    return y, step * first_step(vi, y, vi.F(y))


def extragradient_step(vi: FrozenVI, y: Tree, lam: Any, step: float) -> tuple[Tree, Trial]:
    """Return y⁺, and z with its certificate, from y and a first λ."""
    Fy = vi.F(y)
    z, Fz, lam, evaluations = extrapolate(vi, y, Fy, lam, step)
    after = vi.K.project(_tree.sub(y, _tree.scale(lam, Fz)), vi.space)
    # The certificate is one of z, so the trial point is z and not y⁺.
    w = residual_vector(Fz, Fy, y, z, lam)
    return after, Trial(z, w, Fz, lam, [z], evaluations + 1, base=(y, lam))


def extrapolate(
    vi: FrozenVI, y: Tree, Fy: Tree, lam: Any, step: float
) -> tuple[Tree, Tree, Any, Any]:
    """Return z, F(z), the λ of z, and the number of evaluations of F."""

    def trial(lam: Any) -> tuple[Tree, Tree]:
        z = vi.K.project(_tree.sub(y, _tree.scale(lam, Fy)), vi.space)
        return z, vi.F(z)

    if vi.L_F is not None:
        return *trial(lam), lam, 1

    F_is_finite = jnp.isfinite(vi.space.norm(Fy))

    def too_long(carry: tuple) -> jax.Array:
        z, Fz, lam, _ = carry
        change = lam * vi.space.norm(_tree.sub(Fz, Fy))
        # A NaN in z or F(z) also shortens the step; the limit on λ ends the loop.
        accepted = change <= step * vi.space.norm(_tree.sub(z, y))
        return ~accepted & F_is_finite & (lam > SMALLEST_REDUCTION * longest)

    def shorten(carry: tuple) -> tuple:
        lam = REDUCTION * carry[2]
        return *trial(lam), lam, carry[3] + 1

    longest = GROWTH * lam
    return lax.while_loop(too_long, shorten, (*trial(longest), longest, jnp.asarray(1)))
