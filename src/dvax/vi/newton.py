"""Newton's method on the normal map, safeguarded by the extragradient method: what
`SemismoothNewton` and `ActiveSet` share, whichever way they solve the linear systems."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._batch import any_lane
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


_RUN = 5
"""Newton steps in a row that need not halve the best ‖w‖, at first: a few guesses find most sets."""

_WILD = 10.0
"""A Newton point whose ‖w‖ is so many times the best is not gone on from."""


_OTHER = 1e3
"""Where F is so many times what it was, a first Newton point has left the region where F is anything
like its linearisation."""


class _State(NamedTuple):
    """`z`, and `ahead`, the linearisation at `at` of F where z projects to; `base` and `lam`, where the
    safeguard goes on; `best`, the ‖w‖ to be halved; `left`, how many Newton steps may still fail to,
    of the `run` that they had; Newton rests for `wait` steps, next time for `pause`; `singular`,
    whether its last system was; `limit`, how large F may be at the first Newton point."""

    z: Tree
    at: Tree
    ahead: Tree
    base: Tree
    lam: jax.Array
    best: jax.Array
    left: jax.Array
    run: jax.Array
    wait: jax.Array
    pause: jax.Array
    singular: jax.Array
    limit: jax.Array


def safeguarded_newton(
    vi: Frozen, y0: Tree, tol: Any, solve: Solve, *, step: float, max_steps: int
) -> Answer:
    """Newton's method for Φ(z) = F(y) + (z − y)/τ with y = proj_K(z), whose value is the certificate w.

    The first linearisation is made at y₀ itself with z = y₀ − τF(y₀), as for the natural map: one
    evaluation of F, and from a good guess a second one ends the solve. A run of Newton steps is gone on
    with while it halves the best ‖w‖ at least every sixth step (each run that fails doubles what the
    next may take: an obstacle's contact set moves node by node); otherwise extragradient steps are made
    from the last point that halved it, or from where they stopped last time.
    """
    # The iteration is never differentiated (`stopped`), but its F has a slope.
    slope_of = vi.F

    def slope_at(y: Tree) -> Callable[[Tree], Tree]:
        return lambda d: lax.stop_gradient(jax.jvp(slope_of, (y,), (d,))[1])

    def begin(vi: Frozen, y: Tree) -> tuple:
        Fy, slope = vi.F(y), slope_at(y)
        tau = first_step(vi, y, Fy, slope)
        z = _tree.sub(y, _tree.scale(tau, Fy))
        bent = slope(_tree.sub(vi.K.project(z, vi.space), y))
        ahead = _tree.add(Fy, bent)
        limit = _OTHER * (vi.space.norm(Fy) + vi.space.norm(bent))
        none, one, far = jnp.asarray(0), jnp.asarray(1), jnp.full_like(tau, jnp.inf)
        run, no = jnp.asarray(_RUN), jnp.asarray(False)
        state = _State(z, y, ahead, y, step * tau, far, run, run, none, one, no, limit)
        return state, tau, far

    def newton(vi: Frozen, s: _State, tau: Any, first: Any) -> tuple[Tree, Tree, Tree, Tree]:
        project = lambda z: vi.K.project(z, vi.space)  # noqa: E731
        right = _tree.sub(_tree.scale(-tau, s.ahead), _tree.sub(s.z, project(s.z)))
        tangent = lambda d: jax.jvp(project, (s.z,), (d,))[1]  # noqa: E731
        shrunk = jnp.where(jnp.isfinite(first), s.best / first, 1.0)
        d = solve(Linearised(vi, s.at, s.z, slope_at(s.at), tangent, tau, shrunk), right)
        z = _tree.add(s.z, d)
        y = project(z)
        Fy = vi.F(y)
        return z, y, Fy, _tree.add(Fy, _tree.scale(1.0 / tau, _tree.sub(z, y)))

    def safeguard(vi: Frozen, s: _State, tau: Any) -> tuple:
        base, trial = extragradient_step(vi, s.base, s.lam, step)
        # w − F(y) ∈ N_K(y), so that y + τ(w − F(y)) projects onto y and has the same w.
        normal = _tree.sub(trial.w, trial.value)
        z = _tree.add(trial.y, _tree.scale(tau, normal))
        return (z, trial.y, trial.value, trial.w), base, trial.step, jnp.asarray(trial.calls)

    def advance(vi: Frozen, carry: tuple) -> tuple[tuple, Trial]:
        s, tau, first = carry
        tries = s.wait == 0
        idle = s.z, s.at, s.ahead, s.ahead
        found = lax.cond(any_lane(tries), lambda: newton(vi, s, tau, first), lambda: idle)
        norm = vi.space.norm(found[3])
        # Nothing is known yet that the first point could halve; but it must lie where F is alike.
        alike = (vi.space.norm(found[2]) <= s.limit) | jnp.isfinite(s.best)
        halved = tries & (norm <= 0.5 * s.best) & alike
        onward = tries & alike & (s.left > 0) & (norm <= _WILD * s.best) & jnp.isfinite(norm)
        taken = halved | onward
        reached, base, lam, calls = lax.cond(
            any_lane(~taken),
            lambda: safeguard(vi, s, tau),
            lambda: (idle, s.base, s.lam, jnp.asarray(0)),
        )
        z, y, value, w = _tree.where(taken, found, reached)
        base = _tree.where(halved, y, _tree.where(taken, s.base, base))
        used = lam
        lam, calls = jnp.where(taken, s.lam, lam), jnp.where(taken, 0, calls)
        norm = vi.space.norm(w)
        failed = tries & ~taken
        new = _State(
            z=z,
            at=y,
            ahead=value,
            base=base,
            lam=lam,
            best=jnp.where(halved | ~taken, jnp.minimum(s.best, norm), s.best),
            left=jnp.where(
                halved, s.run, jnp.where(failed, 2 * s.run, s.left - jnp.where(tries, 1, 0))
            ),
            run=jnp.where(failed, 2 * s.run, s.run),
            wait=jnp.where(taken, 0, jnp.where(failed, s.pause, s.wait - 1)),
            pause=jnp.where(halved, 1, jnp.where(failed, jnp.minimum(2 * s.pause, 8), s.pause)),
            singular=jnp.where(tries, ~_tree.all_finite(found[0]), s.singular),
            limit=s.limit,
        )
        first = jnp.where(jnp.isfinite(first), first, norm)
        word = RESULTS.where(new.singular, RESULTS.singular, RESULTS.max_steps)
        calls = calls + jnp.where(tries, 1, 0)
        trial = Trial(
            y, w, value, tau, [z, base], calls, word,
            tentative=taken & ~halved, length=jnp.where(taken, tau, used),
        )  # fmt: skip
        return (new, tau, first), trial

    return iterate(vi, y0, tol, begin, advance, max_steps, begun=1, moves=2)
