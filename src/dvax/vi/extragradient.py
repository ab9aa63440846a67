"""Korpelevich's extragradient method."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._tree import Tree
from .abstract import RESULTS, AbstractSolver, Answer, Frozen
from .implicit import with_implicit_derivative


class Extragradient(AbstractSolver):
    """z = proj_K(y − λF(y)), y⁺ = proj_K(y − λF(z)).

    With L_F known the step is λ = step/L_F, and for F strongly pseudomonotone with modulus γ every
    iteration contracts: ‖y⁺ − y*‖² ≤ (1 − ab/(a+b)) ‖y − y*‖² with a = 1 − λ²L_F², b = 2λγ.
    (From ‖y⁺−y*‖² ≤ ‖y−y*‖² − a‖y−z‖² − b‖z−y*‖² (Korpelevich 1976, with strong
    pseudomonotonicity in the last term) and a p² + b q² ≥ ab/(a+b) (p+q)².)
    With L_F unknown, λ is found by backtracking until λ‖F(y) − F(z)‖ ≤ step ‖y − z‖
    (Khobotov 1987), which keeps the same inequality with a = 1 − step².

    The certificate of z costs nothing: w = F(z) − F(y) + (y − z)/λ.

    **Arguments:** `step` in (0, 1); `max_steps`, the most iterations.

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

    def contraction(self, gamma: Any, L_F: Any) -> Any:
        """The proven factor q with ‖y⁺ − y*‖ ≤ q‖y − y*‖ at the step λ = step/L_F."""
        a, b = 1.0 - self.step**2, 2.0 * self.step * gamma / L_F
        return jnp.sqrt(1.0 - a * b / (a + b))

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        gamma = 1.0 if vi.gamma is None else vi.gamma
        frozen = _stopped(vi)
        start = vi.K.project(y0, vi.space)
        first = 1.0 if vi.L_F is None else self.step / vi.L_F

        def advance(state: tuple) -> tuple:
            y, _, lam, _, count, _ = state
            Fy = frozen.F(y)
            z, Fz, lam = self._extrapolate(frozen, y, Fy, lam)
            w = _tree.add(_tree.sub(Fz, Fy), _tree.scale(1.0 / lam, _tree.sub(y, z)))
            residual = frozen.space.norm(w)
            after = frozen.K.project(_tree.sub(y, _tree.scale(lam, Fz)), frozen.space)
            # The certificate belongs to z, so z is what is returned.
            done = residual <= gamma * tol
            return after, z, lam, residual, count + 1, done

        def unfinished(state: tuple) -> jax.Array:
            residual, count, done = state[3], state[4], state[5]
            return ~done & (count < self.max_steps) & (residual < jnp.inf)

        dtype = jnp.result_type(*jax.tree_util.tree_leaves(start))
        state = (
            lax.stop_gradient(start),
            lax.stop_gradient(start),
            jnp.asarray(lax.stop_gradient(first), dtype),
            jnp.asarray(jnp.finfo(dtype).max, dtype),
            jnp.asarray(0),
            jnp.asarray(False),
        )
        state = lax.while_loop(unfinished, advance, state)
        _, found, lam, residual, count, done = state
        y = with_implicit_derivative(vi, found, lam, lambda guess: guess, pointwise=False)
        result = RESULTS.where(done, RESULTS.successful, RESULTS.max_steps)
        # Once y − λF(y) rounds to y, every point looks like a solution.
        collapsed = lam < 1e3 * jnp.finfo(dtype).eps
        result = RESULTS.where(collapsed, RESULTS.not_lipschitz, result)
        result = RESULTS.where(jnp.isfinite(residual), result, RESULTS.nonfinite)
        # One fixed step for every z, whatever λ the search ended with: z is compared between times.
        tau = 1.0 if vi.L_F is None else 1.0 / vi.L_F
        z = _tree.sub(found, _tree.scale(tau, frozen.F(found)))
        return Answer(y, lax.stop_gradient(z), residual, count, result)

    def _extrapolate(self, vi: Frozen, y: Tree, Fy: Tree, lam: Any) -> tuple[Tree, Tree, Any]:
        def trial(lam: Any) -> tuple[Tree, Tree]:
            z = vi.K.project(_tree.sub(y, _tree.scale(lam, Fy)), vi.space)
            return z, vi.F(z)

        if vi.L_F is not None:
            return *trial(lam), lam

        def too_long(carry: tuple) -> jax.Array:
            z, Fz, lam = carry
            change = lam * vi.space.norm(_tree.sub(Fz, Fy))
            return change > self.step * vi.space.norm(_tree.sub(z, y))

        def shorten(carry: tuple) -> tuple:
            lam = 0.6 * carry[2]
            return *trial(lam), lam

        # Growing a little first lets λ recover where F is flatter than where it was set.
        grown = 1.25 * lam
        return lax.while_loop(too_long, shorten, (*trial(grown), grown))


def _stopped(vi: Frozen) -> Frozen:
    """The same problem with derivatives cut: the iteration itself is never differentiated."""
    return vi._replace(
        F=lambda y: lax.stop_gradient(vi.F(y)), K=jax.tree_util.tree_map(lax.stop_gradient, vi.K)
    )
