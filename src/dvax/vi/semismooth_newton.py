"""Semismooth Newton's method on the normal map, safeguarded by the extragradient method."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from .. import _tree
from .._tree import Tree
from .abstract import AbstractSolver, Answer, Frozen
from .extragradient import extragradient_step
from .iteration import Trial, first_step, iterate


class _Point(NamedTuple):
    """z ∈ H with y = proj_K(z) and w = F(y) + (z − y)/τ ∈ F(y) + N_K(y)."""

    z: Tree
    y: Tree
    w: Tree
    norm: jax.Array


class _State(NamedTuple):
    """`point`, where Newton's method starts from; `base` and `lam`, where the safeguard goes on;
    `best`, the least ‖w‖ so far; attempts are made when `wait` is 0, `pause` apart."""

    point: _Point
    base: Tree
    lam: jax.Array
    best: jax.Array
    wait: jax.Array
    pause: jax.Array


class SemismoothNewton(AbstractSolver):
    """Newton's method for the normal map Φ(z) = F(y) + (z − y)/τ with y = proj_K(z), whose value is
    the certificate w itself: [F′(y) D + (I − D)/τ] d = −Φ(z), z⁺ = z + d, D ∈ ∂proj_K(z).

    A Newton point is taken only if it halves the best ‖w‖; otherwise one extragradient step is made
    from where those steps stand: their own last iterate, or the last Newton point. If infinitely
    many are taken, ‖w‖ → 0 by construction; if finitely many, the tail is the extragradient method.
    So it converges wherever that does, and where it converges to y* the last steps are Newton's: for
    polyhedral K, strict complementarity and F in C¹, the matrix is regular with an inverse of norm at
    most about 1/γ, and the rate quadratic.
    Where a Newton point is refused, the next attempts are spaced out by 1, 2, 4, 8 iterations.

    Up to `dense` unknowns the matrix is formed and factorised; beyond, GMRES applies it, to
    min(0.1, ‖w‖/‖w₀‖) at first and tighter as ‖w‖ falls.

    **Arguments:** `step` of the safeguard, in (0, 1); `max_steps`; `dense`.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> vi = dvax.solve_vi(lambda y, args: y**3 + y - 1.0, dvax.sets.Box(0.0, jnp.inf),
    ...                    jnp.ones(3), solver=dvax.vi.SemismoothNewton())
    >>> f"{float(vi.y[0]):.10f}", int(vi.iterations) < 8
    ('0.6823278038', True)

    ```
    """

    step: float = 0.7
    max_steps: int = 1000
    dense: int = 1024

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        flat0, unravel = ravel_pytree(y0)

        def point(vi: Frozen, z: Tree, tau: Any) -> _Point:
            y = vi.K.project(z, vi.space)
            w = _tree.add(vi.F(y), _tree.scale(1.0 / tau, _tree.sub(z, y)))
            return _Point(z, y, w, vi.space.norm(w))

        def begin(vi: Frozen, y: Tree) -> tuple:
            Fy = vi.F(y)
            tau = first_step(vi, y, Fy)
            start = point(vi, _tree.sub(y, _tree.scale(tau, Fy)), tau)
            zero, one = jnp.asarray(0), jnp.asarray(1)
            return _State(start, start.y, self.step * tau, start.norm, zero, one), tau, start.norm

        # The iteration is never differentiated (`stopped`), but its F has a slope.
        slope_of = vi.F

        def newton(vi: Frozen, p: _Point, tau: Any, first: Any) -> _Point:
            def apply(flat: jax.Array) -> jax.Array:
                d = unravel(flat)
                dy = jax.jvp(lambda z: vi.K.project(z, vi.space), (p.z,), (d,))[1]
                bent = lax.stop_gradient(jax.jvp(slope_of, (p.y,), (dy,))[1])
                held = _tree.scale(1.0 / tau, _tree.sub(d, dy))
                return ravel_pytree(_tree.add(bent, held))[0]

            right = -ravel_pytree(p.w)[0]
            if flat0.size <= self.dense:
                matrix = jax.vmap(apply, out_axes=1)(jnp.eye(flat0.size, dtype=flat0.dtype))
                move = jnp.linalg.solve(matrix, right)
            else:
                rtol: Any = jnp.clip(p.norm / first, 1e-8, 0.1)
                move, _ = jax.scipy.sparse.linalg.gmres(
                    apply, right, tol=rtol, atol=0.0, restart=40, maxiter=5
                )
            return point(vi, _tree.add(p.z, unravel(move)), tau)

        def safeguard(vi: Frozen, s: _State, tau: Any) -> tuple[_Point, Tree, Any, Any]:
            base, trial = extragradient_step(vi, s.base, s.lam, self.step)
            # w − F(y) ∈ N_K(y), so that y + τ(w − F(y)) projects onto y and has the same w.
            normal = _tree.sub(trial.w, vi.F(trial.y))
            z = _tree.add(trial.y, _tree.scale(tau, normal))
            reached = _Point(z, trial.y, trial.w, vi.space.norm(trial.w))
            return reached, base, trial.step, trial.calls + 1

        def advance(vi: Frozen, carry: tuple) -> tuple[tuple, Trial]:
            s, tau, first = carry
            tries = s.wait == 0
            candidate = lax.cond(tries, lambda: newton(vi, s.point, tau, first), lambda: s.point)
            taken = tries & (candidate.norm <= 0.5 * s.best)
            after, base, lam, calls = lax.cond(
                taken,
                lambda: (candidate, candidate.y, s.lam, jnp.asarray(0)),
                lambda: safeguard(vi, s, tau),
            )
            best = jnp.minimum(s.best, after.norm)
            pause = jnp.where(taken, 1, jnp.where(tries, jnp.minimum(2 * s.pause, 8), s.pause))
            wait = jnp.where(taken, 0, jnp.where(tries, s.pause, s.wait - 1))
            new = _State(after, base, lam, best, wait, pause)
            calls = calls + jnp.where(tries, 1, 0)
            return (new, tau, first), Trial(after.y, after.w, tau, [after.z, base], calls)

        return iterate(vi, y0, tol, begin, advance, self.max_steps, begun=3)
