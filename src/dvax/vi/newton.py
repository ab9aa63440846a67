"""Newton's method for the normal map with an extragradient safeguard.

`SemismoothNewton` and `ActiveSet` share it and differ in how they solve the linear systems.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._batch import any_lane
from .._tree import Tree
from .abstract import RESULTS, Answer, FrozenVI
from .extragradient import extragradient_step
from .iteration import Trial, first_step, iterate


class Linearisation(NamedTuple):
    """The linearisation of F at `at`, and of the projection at z.

    `slope` applies F′(at), and `tangent` an element D of the generalised derivative of the projection
    at z. `reduction` is ‖w‖ relative to its first value, for the tolerance of iterative linear solvers.
    """

    vi: FrozenVI
    at: Tree
    z: Tree
    slope: Callable[[Tree], Tree]
    tangent: Callable[[Tree], Tree]
    tau: jax.Array
    reduction: jax.Array


LinearSolver = Callable[[Linearisation, Tree], Tree]
"""Return d with τF′(at) D d + (I − D) d = right."""

_FIRST_RUN_LENGTH = 5
"""Number of consecutive Newton steps that may fail to halve the best ‖w‖, in the first run: a few
steps identify most active sets."""

_DIVERGENCE_RATIO = 10.0
"""A Newton point is rejected if its ‖w‖ exceeds this multiple of the best."""

_TRUST_RATIO = 1e3
"""The first Newton point is rejected if ‖F‖ exceeds this multiple of its value in the linearisation:
the point is then outside the region where the linearisation approximates F."""


class _State(NamedTuple):
    """- `z`; `linear_value`, the linearisation of F at `at`, evaluated at proj_K(z);
    - `base` and `lam`, the iterate and step of the safeguard;
    - `best`, the ‖w‖ that Newton steps must halve; `steps_left`, how many may still fail to, of the
      `run_length` that the current run allows;
    - `wait`, the number of safeguard steps until the next Newton run; `next_wait`, that number after
      the next failed run;
    - `singular`, whether the last linear system was singular;
    - `trust_limit`, the largest ‖F‖ accepted at the first Newton point.
    """

    z: Tree
    at: Tree
    linear_value: Tree
    base: Tree
    lam: jax.Array
    best: jax.Array
    steps_left: jax.Array
    run_length: jax.Array
    wait: jax.Array
    next_wait: jax.Array
    singular: jax.Array
    trust_limit: jax.Array


def safeguarded_newton(
    vi: FrozenVI, y0: Tree, tol: Any, solve: LinearSolver, *, step: float, max_steps: int
) -> Answer:
    """Solve Φ(z) = F(y) + (z − y)/τ = 0 with y = proj_K(z); the value Φ(z) is the certificate w.

    The first linearisation is made at y₀ with z = y₀ − τF(y₀), as for the natural map. This takes one
    evaluation of F, and from a good guess a second one ends the solve. A run of Newton steps continues
    while it halves the best ‖w‖ at least every sixth step. A failed run doubles the number of steps
    allowed to the next one, since the contact set of an obstacle problem may change node by node.
    Otherwise extragradient steps are made, from the last point that halved ‖w‖ or from the last
    extragradient iterate.
    """
    # `iterate` passes an F without derivatives (`without_derivatives`), but Newton's method needs F′.
    differentiable_F = vi.F

    def slope_at(y: Tree) -> Callable[[Tree], Tree]:
        return lambda d: lax.stop_gradient(jax.jvp(differentiable_F, (y,), (d,))[1])

    def begin(vi: FrozenVI, y: Tree) -> tuple:
        Fy, slope = vi.F(y), slope_at(y)
        tau = first_step(vi, y, Fy, slope)
        z = _tree.sub(y, _tree.scale(tau, Fy))
        change = slope(_tree.sub(vi.K.project(z, vi.space), y))
        infinity, run_length = jnp.full_like(tau, jnp.inf), jnp.asarray(_FIRST_RUN_LENGTH)
        state = _State(
            z=z,
            at=y,
            linear_value=_tree.add(Fy, change),
            base=y,
            lam=step * tau,
            best=infinity,
            steps_left=run_length,
            run_length=run_length,
            wait=jnp.asarray(0),
            next_wait=jnp.asarray(1),
            singular=jnp.asarray(False),
            trust_limit=_TRUST_RATIO * (vi.space.norm(Fy) + vi.space.norm(change)),
        )
        return state, tau, infinity

    def newton(vi: FrozenVI, s: _State, tau: Any, first: Any) -> tuple[Tree, Tree, Tree, Tree]:
        def project(z: Tree) -> Tree:
            return vi.K.project(z, vi.space)

        def tangent(d: Tree) -> Tree:
            return jax.jvp(project, (s.z,), (d,))[1]

        right = _tree.sub(_tree.scale(-tau, s.linear_value), _tree.sub(s.z, project(s.z)))
        reduction = jnp.where(jnp.isfinite(first), s.best / first, 1.0)
        d = solve(Linearisation(vi, s.at, s.z, slope_at(s.at), tangent, tau, reduction), right)
        z = _tree.add(s.z, d)
        y = project(z)
        Fy = vi.F(y)
        return z, y, Fy, _tree.add(Fy, _tree.scale(1.0 / tau, _tree.sub(z, y)))

    def safeguard(vi: FrozenVI, s: _State, tau: Any) -> tuple:
        base, trial = extragradient_step(vi, s.base, s.lam, step)
        # w − F(y) ∈ N_K(y), so y + τ(w − F(y)) projects onto y and has the same w.
        normal = _tree.sub(trial.w, trial.value)
        z = _tree.add(trial.y, _tree.scale(tau, normal))
        return (z, trial.y, trial.value, trial.w), base, trial.step, jnp.asarray(trial.evaluations)

    def advance(vi: FrozenVI, carry: tuple) -> tuple[tuple, Trial]:
        s, tau, first = carry
        newton_is_due = s.wait == 0
        unchanged = s.z, s.at, s.linear_value, s.linear_value
        newton_point = lax.cond(
            any_lane(newton_is_due), lambda: newton(vi, s, tau, first), lambda: unchanged
        )
        norm = vi.space.norm(newton_point[3])
        # The first point has no earlier ‖w‖ to halve, so its ‖F‖ is limited instead.
        trusted = (vi.space.norm(newton_point[2]) <= s.trust_limit) | jnp.isfinite(s.best)
        halved = newton_is_due & (norm <= 0.5 * s.best) & trusted
        may_continue = newton_is_due & trusted & (s.steps_left > 0) & jnp.isfinite(norm)
        may_continue &= norm <= _DIVERGENCE_RATIO * s.best
        accepted = halved | may_continue
        safeguard_point, base, lam, evaluations = lax.cond(
            any_lane(~accepted),
            lambda: safeguard(vi, s, tau),
            lambda: (unchanged, s.base, s.lam, jnp.asarray(0)),
        )
        z, y, value, w = _tree.where(accepted, newton_point, safeguard_point)
        base = _tree.where(halved, y, _tree.where(accepted, s.base, base))
        residual_step = jnp.where(accepted, tau, lam)
        lam = jnp.where(accepted, s.lam, lam)
        evaluations = jnp.where(accepted, 0, evaluations)
        norm = vi.space.norm(w)
        failed = newton_is_due & ~accepted
        new = _State(
            z=z,
            at=y,
            linear_value=value,
            base=base,
            lam=lam,
            best=jnp.where(halved | ~accepted, jnp.minimum(s.best, norm), s.best),
            steps_left=jnp.where(
                halved,
                s.run_length,
                jnp.where(failed, 2 * s.run_length, s.steps_left - jnp.where(newton_is_due, 1, 0)),
            ),
            run_length=jnp.where(failed, 2 * s.run_length, s.run_length),
            wait=jnp.where(accepted, 0, jnp.where(failed, s.next_wait, s.wait - 1)),
            next_wait=jnp.where(
                halved, 1, jnp.where(failed, jnp.minimum(2 * s.next_wait, 8), s.next_wait)
            ),
            singular=jnp.where(newton_is_due, ~_tree.all_finite(newton_point[0]), s.singular),
            trust_limit=s.trust_limit,
        )
        first = jnp.where(jnp.isfinite(first), first, norm)
        result = RESULTS.where(new.singular, RESULTS.singular, RESULTS.max_steps)
        evaluations = evaluations + jnp.where(newton_is_due, 1, 0)
        trial = Trial(
            y, w, value, tau, [z, base], evaluations, result,
            may_repeat=accepted & ~halved, residual_step=residual_step,
        )  # fmt: skip
        return (new, tau, first), trial

    return iterate(vi, y0, tol, begin, advance, max_steps, initial_evaluations=1, iterate_count=2)
