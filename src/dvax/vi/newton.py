"""Newton's method on the normal map, safeguarded by the extragradient method: what
`SemismoothNewton` and `ActiveSet` share, whichever way they solve the linear systems."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._tree import Tree
from .abstract import RESULTS, Answer, Frozen
from .extragradient import extragradient_step
from .iteration import Trial, first_step, iterate


class Linearised(NamedTuple):
    """F near `at`: F(at) + F′(at)(· − at), and the z whose projection y is taken to be linear too.

    `slope` applies F′(at), and `tangent` an element D of the derivative of the projection at z.
    """

    vi: Frozen
    at: Tree
    z: Tree
    slope: Callable[[Tree], Tree]
    tangent: Callable[[Tree], Tree]
    tau: jax.Array
    shrunk: jax.Array


Solve = Callable[[Linearised, Tree], Tree]
"""d with τF′(at) D d + (I − D) d = right. `shrunk` says how small ‖w‖ has become, against the first."""


class _State(NamedTuple):
    """`z`, and F linearised at `at`, where it has the `value`; `base` and `lam`, where the safeguard
    goes on; `best`, the least ‖w‖ so far; Newton is tried when `wait` is 0, tries being `pause`
    apart; `singular`, whether the last linear system was."""

    z: Tree
    at: Tree
    value: Tree
    base: Tree
    lam: jax.Array
    best: jax.Array
    wait: jax.Array
    pause: jax.Array
    singular: jax.Array


def safeguarded_newton(
    vi: Frozen, y0: Tree, tol: Any, solve: Solve, *, step: float, max_steps: int
) -> Answer:
    """Newton's method for Φ(z) = F(y) + (z − y)/τ with y = proj_K(z), whose value is the certificate w.

    The first linearisation is made at y₀ itself with z = y₀ − τF(y₀), as for the natural map: one
    evaluation of F, and from a good guess a second one ends the solve. A Newton point is taken only if
    it halves the best ‖w‖; otherwise one extragradient step is made from where those stand.
    """
    # The iteration is never differentiated (`stopped`), but its F has a slope.
    slope_of = vi.F

    def slope_at(y: Tree) -> Callable[[Tree], Tree]:
        return lambda d: lax.stop_gradient(jax.jvp(slope_of, (y,), (d,))[1])

    def begin(vi: Frozen, y: Tree) -> tuple:
        Fy = vi.F(y)
        tau = first_step(vi, y, Fy, slope_at(y))
        z = _tree.sub(y, _tree.scale(tau, Fy))
        none, one = jnp.asarray(0), jnp.asarray(1)
        far = jnp.full_like(tau, jnp.inf)
        return _State(z, y, Fy, y, step * tau, far, none, one, jnp.asarray(False)), tau, far

    def newton(vi: Frozen, s: _State, tau: Any, first: Any) -> tuple[Tree, Tree, Tree, Tree]:
        project = lambda z: vi.K.project(z, vi.space)  # noqa: E731
        y, slope = project(s.z), slope_at(s.at)
        ahead = _tree.add(s.value, slope(_tree.sub(y, s.at)))
        right = _tree.sub(_tree.scale(-tau, ahead), _tree.sub(s.z, y))
        tangent = lambda d: jax.jvp(project, (s.z,), (d,))[1]  # noqa: E731
        shrunk = jnp.where(jnp.isfinite(first), s.best / first, 1.0)
        d = solve(Linearised(vi, s.at, s.z, slope, tangent, tau, shrunk), right)
        z = _tree.add(s.z, d)
        y = project(z)
        Fy = vi.F(y)
        return z, y, Fy, _tree.add(Fy, _tree.scale(1.0 / tau, _tree.sub(z, y)))

    def safeguard(vi: Frozen, s: _State, tau: Any) -> tuple:
        base, trial = extragradient_step(vi, s.base, s.lam, step)
        # w − F(y) ∈ N_K(y), so that y + τ(w − F(y)) projects onto y and has the same w.
        normal = _tree.sub(trial.w, trial.value)
        z = _tree.add(trial.y, _tree.scale(tau, normal))
        return z, trial.y, trial.value, trial.w, base, trial.step, jnp.asarray(trial.calls)

    def advance(vi: Frozen, carry: tuple) -> tuple[tuple, Trial]:
        s, tau, first = carry
        tries = s.wait == 0
        found = lax.cond(
            tries, lambda: newton(vi, s, tau, first), lambda: (s.z, s.at, s.value, s.value)
        )
        norm = vi.space.norm(found[3])
        taken = tries & (norm <= 0.5 * s.best) & jnp.isfinite(norm)
        z, y, value, w, base, lam, calls = lax.cond(
            taken,
            lambda: (*found, found[1], s.lam, jnp.asarray(0)),
            lambda: safeguard(vi, s, tau),
        )
        norm_after = vi.space.norm(w)
        singular = jnp.where(tries, ~_tree.all_finite(found[0]), s.singular)
        pause = jnp.where(taken, 1, jnp.where(tries, jnp.minimum(2 * s.pause, 8), s.pause))
        wait = jnp.where(taken, 0, jnp.where(tries, s.pause, s.wait - 1))
        best = jnp.minimum(s.best, norm_after)
        new = _State(z, y, value, base, lam, best, wait, pause, singular)
        calls = calls + jnp.where(tries, 1, 0)
        word = RESULTS.where(singular, RESULTS.singular, RESULTS.max_steps)
        first = jnp.where(jnp.isfinite(first), first, norm_after)
        return (new, tau, first), Trial(y, w, value, tau, [z, base], calls, word)

    return iterate(vi, y0, tol, begin, advance, max_steps, begun=1)
