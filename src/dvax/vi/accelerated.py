"""Nesterov's accelerated projected gradient method, for an F that is a gradient."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSolver, Answer, FrozenVI
from .iteration import Trial, first_step, iterate, residual_vector
from .parameters import LEAST, STEPS, check_parameters


class Accelerated(AbstractSolver):
    """y⁺ = proj_K(z − λF(z)), z = y + (a₋ − 1)/a (y − y₋), a = (1 + √(1 + 4a₋²λ₋/λ))/2, for F = ∇ψ
    with a convex ψ (FISTA, Beck and Teboulle 2009; with a step that may grow, Scheinberg, Goldfarb
    and Bai 2014): about √(L_F/γ) ln(1/ε) iterations, where a method that needs no ψ takes
    L_F/γ ln(1/ε).

    γ and L_F need not be known. λ is halved if λ⟨F(y⁺) − F(z), y⁺ − z⟩ ≤ ½‖y⁺ − z‖² fails, and grows
    by a tenth otherwise. With the convexity of ψ this test implies the inequality that FISTA needs,
    ψ(y⁺) ≤ ψ(z) + ⟨F(z), y⁺ − z⟩ + ‖y⁺ − z‖²/(2λ), without evaluating ψ. The momentum is reset to zero
    if it points uphill, ⟨z − y⁺, y⁺ − y⟩ > 0 (O'Donoghue and Candès 2015), which gives the linear rate
    without γ.

    If F is not a gradient, convergence is not guaranteed; the certificate ‖w‖ holds nevertheless.

    **Arguments:** `least`, a lower limit of the tolerance on ‖w‖ (the roundoff floor scales with y
    and F, while fixed steps of `dvax.solve` request 10⁻¹²); `max_steps`, the maximum number of
    iterations.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> stiff = jnp.array([1.0, 1e3, 1e4])
    >>> K, solver = dvax.sets.Simplex(1.0), dvax.vi.Accelerated()
    >>> vi = dvax.solve_vi(lambda y, args: stiff * y - 1.0, K, jnp.ones(3), solver=solver)
    >>> [f"{float(v):.6f}" for v in vi.y], bool(vi.iterations < 400)
    (['0.998901', '0.000999', '0.000100'], True)

    ```
    """

    least: float = 0.0
    max_steps: int = 20_000

    def __check_init__(self) -> None:
        check_parameters(self, least=LEAST, max_steps=STEPS)

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        # A proved L_F is the slope at the worst point, but the step needs the local slope. It is
        # computed from a derivative: near the solution a difference quotient along −F contains only
        # rounding.
        space, differentiable_F, local = vi.space, vi.F, vi._replace(L_F=None)

        def begin(vi: FrozenVI, y: Tree) -> tuple:
            def slope(d: Tree) -> Tree:
                return lax.stop_gradient(jax.jvp(differentiable_F, (y,), (d,))[1])

            lam = first_step(local, y, vi.F(y), slope)
            return y, y, jnp.ones_like(lam), lam, lam

        def advance(vi: FrozenVI, state: tuple) -> tuple[tuple, Trial]:
            y, y_previous, a, lam_previous, lam = state
            a_next = 0.5 * (1.0 + jnp.sqrt(1.0 + 4.0 * a * a * lam_previous / lam))
            z = _tree.add(y, _tree.scale((a - 1.0) / a_next, _tree.sub(y, y_previous)))
            Fz = vi.F(z)
            new = vi.K.project(_tree.sub(z, _tree.scale(lam, Fz)), space)
            F_new = vi.F(new)
            w = residual_vector(F_new, Fz, z, new, lam)
            move, change = _tree.sub(new, z), _tree.sub(F_new, Fz)
            square = space.inner(move, move)
            # Bound on the rounding error of F in the left side of the test.
            eps = jnp.finfo(lam.dtype).eps
            roundoff = 8 * eps * space.norm(Fz) * jnp.sqrt(square)
            accepted = lam * (space.inner(change, move) - roundoff) <= 0.5 * square
            uphill = space.inner(move, _tree.sub(new, y)) < 0
            state = (
                _tree.where(accepted, new, y),
                _tree.where(accepted, y, y_previous),
                jnp.where(accepted, jnp.where(uphill, 1.0, a_next), a),
                jnp.where(accepted, lam, lam_previous),
                jnp.where(accepted, 1.1 * lam, 0.5 * lam),
            )
            # With momentum an iterate may repeat without a cycle, so only a repetition without
            # momentum counts as stationary.
            unchanged = space.norm(_tree.sub(new, y)) <= 2 * eps * space.norm(new)
            stationary = accepted & (a == 1.0) & unchanged
            return state, Trial(
                new, w, F_new, lam, [new, y], 2, may_repeat=~stationary, base=(z, lam)
            )

        tol = jnp.maximum(tol, self.least)
        if self.least > 0.0:
            # The caller knows which residual roundoff leaves.
            vi = vi._replace(rtol=None)
        return iterate(
            vi, y0, tol, begin, advance, self.max_steps, initial_evaluations=1, iterate_count=2
        )
