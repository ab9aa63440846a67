"""Nesterov's accelerated projected gradient method, for an F that is a gradient."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSolver, Answer, Frozen
from .iteration import Trial, certificate, first_step, iterate
from .parameters import LEAST, STEPS, check_parameters


class Accelerated(AbstractSolver):
    """y⁺ = proj_K(z − λF(z)), z = y + (a₋ − 1)/a (y − y₋), a = (1 + √(1 + 4a₋²λ₋/λ))/2, for F = ∇ψ
    with a convex ψ (FISTA, Beck and Teboulle 2009; with a step that may grow, Scheinberg, Goldfarb
    and Bai 2014): about √(L_F/γ) ln(1/ε) iterations, where a method that needs no ψ takes
    L_F/γ ln(1/ε).

    γ and L_F need not be known. λ is halved where λ⟨F(y⁺) − F(z), y⁺ − z⟩ ≤ ½‖y⁺ − z‖² fails: the
    convexity of ψ makes of it the inequality that FISTA rests on, ψ(y⁺) ≤ ψ(z) + ⟨F(z), y⁺ − z⟩ +
    ‖y⁺ − z‖²/(2λ), and ψ itself is not needed; elsewhere λ grows by a tenth. The momentum is begun
    anew where it points uphill, ⟨z − y⁺, y⁺ − y⟩ > 0 (O'Donoghue and Candès 2015), which gives the
    linear rate without γ.

    Where F is no gradient nothing of this is known; the certificate ‖w‖ holds all the same.

    **Arguments:** `least`, the smallest ‖w‖ that is asked for, whatever the tolerance: what
    rounding leaves has the size of y and F, and fixed steps of `dvax.solve` ask for 10⁻¹²;
    `max_steps`, the most iterations.

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

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        # A proved L_F is that of the worst point; here the slope at hand is what matters. It is taken
        # by a derivative: near the solution a difference quotient along −F is one of rounding.
        space, bent, local = vi.space, vi.F, vi._replace(L_F=None)

        def begin(vi: Frozen, y: Tree) -> tuple:
            slope = lambda d: lax.stop_gradient(jax.jvp(bent, (y,), (d,))[1])  # noqa: E731
            lam = first_step(local, y, vi.F(y), slope)
            return y, y, jnp.ones_like(lam), lam, lam

        def advance(vi: Frozen, state: tuple) -> tuple[tuple, Trial]:
            y, before, age, last, lam = state
            older = 0.5 * (1.0 + jnp.sqrt(1.0 + 4.0 * age * age * last / lam))
            z = _tree.add(y, _tree.scale((age - 1.0) / older, _tree.sub(y, before)))
            Fz = vi.F(z)
            new = vi.K.project(_tree.sub(z, _tree.scale(lam, Fz)), space)
            F_new = vi.F(new)
            w = certificate(F_new, Fz, z, new, lam)
            move, turn = _tree.sub(new, z), _tree.sub(F_new, Fz)
            square = space.inner(move, move)
            # What F's rounding may add to the left side.
            eps = jnp.finfo(lam.dtype).eps
            blur = 8 * eps * space.norm(Fz) * jnp.sqrt(square)
            short = lam * (space.inner(turn, move) - blur) <= 0.5 * square
            uphill = space.inner(move, _tree.sub(new, y)) < 0
            state = (
                _tree.where(short, new, y),
                _tree.where(short, y, before),
                jnp.where(short, jnp.where(uphill, 1.0, older), age),
                jnp.where(short, lam, last),
                jnp.where(short, 1.1 * lam, 0.5 * lam),
            )
            # A swing comes back to where it was, and goes on; at rest is what moves no more without
            # momentum.
            still = space.norm(_tree.sub(new, y)) <= 2 * eps * space.norm(new)
            at_rest = short & (age == 1.0) & still
            return state, Trial(new, w, F_new, lam, [new, y], 2, tentative=~at_rest, base=(z, lam))

        tol = jnp.maximum(tol, self.least)
        return iterate(vi, y0, tol, begin, advance, self.max_steps, begun=1, moves=2)
