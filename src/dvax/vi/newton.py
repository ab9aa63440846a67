"""Newton's method for the normal map with an extragradient safeguard.

`SemismoothNewton` and `ActiveSet` share it and differ in how they solve the linear systems.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._batch import any_lane
from .._tree import Tree
from .abstract import RESULTS, Answer, FrozenVI
from .extragradient import GROWTH, REDUCTION, SMALLEST_REDUCTION
from .iteration import (
    Trial,
    inverse_slope,
    iterate,
    norm_of_constant,
    residual_limit,
    residual_target,
)
from .scattered import scattered


class Linearisation(NamedTuple):
    """The linearisation of F at y = proj_K(z), and of the projection at z.

    `slope` applies F′(y), and `tangent` an element D of the generalised derivative of the projection
    at z. `reduction` is the tolerance of iterative linear solvers: the smallest ‖w‖ relative to its
    first value, or a tenth of the reduction that ends the iteration.
    """

    slope: Callable[[Tree], Tree]
    tangent: Callable[[Tree], Tree]
    tau: jax.Array
    reduction: jax.Array


LinearSolver = Callable[[Linearisation, Tree], Tree]
"""Return d with τF′(y) D d + (I − D) d = right."""

_FIRST_RUN_LENGTH, _FIRST_RUN_LENGTH_QUADRATIC = 5, 20
"""Number of consecutive Newton steps that may fail to halve the best ‖w‖, in the first run: a few
steps identify most active sets. If F is the gradient of a quadratic function, nothing else can be
wrong, and more are allowed. (If F is affine but not symmetric, long runs often cycle.)"""

_DIVERGENCE_RATIO = 10.0
"""A Newton point is rejected if its ‖w‖ exceeds this multiple of the best, unless F is affine. Then a
large ‖w‖ comes from a wrong active set, which the next step corrects."""

_TRUST_RATIO = 2e3
"""The first Newton point is rejected if ‖F‖ exceeds this multiple of its value at the start, unless F
is affine: the point is then outside the region where the linearisation approximates F."""

_START, _NEWTON, _PREDICTOR, _CORRECTOR = range(4)
"""The kinds of trials."""


class _State(NamedTuple):
    """- `z`, the next trial, and its `kind`;
    - `tau`, the λ of the start and of Newton trials;
    - `base` and `base_value` = F(base), the iterate of the safeguard, and `lam`, its λ;
    - `best`, the ‖w‖ that Newton steps must halve; `first`, its first value; `steps_left`, how many
      may still fail to, of the `run_length` that the current run allows;
    - `wait`, the number of safeguard steps until the next Newton run; `next_wait`, that number after
      the next failed run;
    - `reference`, an earlier ‖w‖ of the current run, with which a cycle is detected;
    - `singular`, whether the last linear system was singular;
    - `trust_limit`, the largest ‖F‖ accepted at the first Newton point.
    """

    z: Tree
    kind: jax.Array
    tau: jax.Array
    base: Tree
    base_value: Tree
    lam: jax.Array
    best: jax.Array
    first: jax.Array
    steps_left: jax.Array
    run_length: jax.Array
    wait: jax.Array
    next_wait: jax.Array
    reference: jax.Array
    singular: jax.Array
    trust_limit: jax.Array


def safeguarded_newton(
    vi: FrozenVI, y0: Tree, tol: Any, solve: LinearSolver, *, step: float, max_steps: int,
    is_affine: bool, is_quadratic: Any = False, matrix_free: bool = False, is_box: bool = False,
) -> Answer:  # fmt: skip
    """Solve Φ(z) = F(y) + (z − y)/τ = 0 with y = proj_K(z); the value Φ(z) is the certificate w.

    Every iteration tries one z: it projects z, evaluates F at y = proj_K(z), and has the certificate
    w = F(y) + (z − y)/λ ∈ F(y) + N_K(y) for any λ > 0. A trial is of one of four kinds:

    - the start, z = y₀;
    - a Newton step, z⁺ = z + d, with λ = τ. It is accepted if it halves the best ‖w‖, or while the run
      of Newton steps may go on without;
    - the predictor of an extragradient step from b, z = b − λF(b). It is rejected with a shorter λ
      until λ‖F(y) − F(b)‖ ≤ step ‖y − b‖;
    - its corrector, z = b − λF(ȳ), with the predictor's ȳ; its y is the next b.

    On a box (`is_box`) the first Newton step starts from z = y₀ − τF(y₀), where the active set is
    nearer to that of the solution. On other sets the second projection costs more than it saves.

    From a good guess the second iteration ends the solve. A run of Newton steps continues while it
    halves the best ‖w‖ at least every sixth step, unless it cycles. A failed run doubles the number of
    steps allowed to the next one, since the contact set of an obstacle problem may change node by node.
    Otherwise extragradient steps are made, from the last point that halved ‖w‖ or from the last
    extragradient iterate.

    All kinds share one loop body, and so one projection, F and linear system: the compile time of a
    program is proportional to their number.
    """
    # `iterate` passes an F without derivatives (`without_derivatives`), but Newton's method needs F′.
    differentiable_F = vi.F
    first_run_length = jnp.where(is_quadratic, _FIRST_RUN_LENGTH_QUADRATIC, _FIRST_RUN_LENGTH)
    target = residual_target(vi, tol)

    def first_tau(value: Tree, slope: Callable[[Tree], Tree]) -> jax.Array:
        tau = inverse_slope(vi, value, slope)
        if vi.L_F is not None or not matrix_free:
            return tau
        # The formula of `solve_matrix_free` amplifies the error of Dd by ‖I − τF′‖, so τ must not be
        # longer than 1/‖F′‖. The direction of a smooth F underestimates ‖F′‖.
        return jnp.minimum(tau, inverse_slope(vi, slope(scattered(value, 1)), slope))

    def advance(vi: FrozenVI, s: _State) -> tuple[_State, Trial]:
        norm = partial(norm_of_constant, vi.space)
        project = lambda z: vi.K.project(z, vi.space)  # noqa: E731
        y, tangent = _linearise(project, s.z)
        value, slope = _linearise(differentiable_F, y)
        norm_F = norm(value)
        is_start, is_newton = s.kind == _START, s.kind == _NEWTON
        is_predictor, is_corrector = s.kind == _PREDICTOR, s.kind == _CORRECTOR
        tau = lax.cond(any_lane(is_start), lambda: first_tau(value, slope), lambda: s.tau)
        tau = jnp.where(is_start, tau, s.tau)
        lam = jnp.where(is_start, step * tau, s.lam)
        residual_step = jnp.where(is_predictor | is_corrector, lam, tau)
        offset = _tree.sub(s.z, y)
        w = _tree.add(value, _tree.scale(1.0 / residual_step, offset))
        residual = norm(w)

        # The first Newton point has no earlier ‖w‖ to halve, so its ‖F‖ is limited instead.
        trusted = is_newton & (is_affine | (norm_F <= s.trust_limit) | jnp.isfinite(s.best))
        halved = trusted & (residual <= 0.5 * s.best)
        near = is_affine | (residual <= _DIVERGENCE_RATIO * s.best)
        continues = trusted & (s.steps_left > 0) & near
        # For affine F and polyhedral K a Newton point depends on the active set alone, so a ‖w‖ that
        # comes back means a cycle. It is compared with that of the last step whose number in the run
        # is a power of two (Brent's algorithm).
        steps = s.run_length - s.steps_left
        change = jnp.abs(residual - s.reference)
        cycles = is_affine & (change <= jnp.finfo(residual.dtype).eps ** 0.5 * residual)
        reference = jnp.where(is_newton & ((steps & (steps - 1)) == 0), residual, s.reference)
        continues &= ~halved & ~cycles & jnp.isfinite(residual)
        failed = is_newton & ~halved & ~continues
        shortens = jnp.zeros_like(failed)
        if vi.L_F is None:
            change = lam * norm(_tree.sub(value, s.base_value))
            # A NaN in y or F(y) also shortens the step; the limit on λ ends the reduction.
            shortens = is_predictor & ~(change <= step * norm(_tree.sub(y, s.base)))
            shortens &= lam > SMALLEST_REDUCTION * tau
        moves_base = is_start | halved | is_corrector
        base, base_value = _tree.where(moves_base, (y, value), (s.base, s.base_value))
        wait = jnp.where(failed, s.next_wait, jnp.where(is_corrector, s.wait - 1, 0))
        wait = jnp.where(is_predictor, s.wait, wait)
        next_is_newton = (wait == 0) & ~is_predictor
        next_is_corrector = is_predictor & ~shortens

        # The same normal vector with the λ of Newton's method. (D is that of z. It differs if K is
        # curved and λ is not τ, in the first step after the safeguard.)
        z = _tree.add(y, _tree.scale(tau / residual_step, offset))
        first = jnp.where(jnp.isfinite(s.first), s.first, residual)
        least = jnp.where(residual < s.best, residual, s.best)
        best = jnp.where(is_start | continues | failed, s.best, least)

        limit = residual_limit(vi, target, y, norm_F, residual_step, tau)

        def newton() -> Tree:
            reduction = jnp.where(jnp.isfinite(best), best / first, 1.0)
            reduction = jnp.maximum(reduction, 0.1 * limit / residual)
            at, D, change = z, tangent, w
            if is_box:
                at = _tree.where(is_start, _tree.sub(y, _tree.scale(tau, value)), z)
                there, D = _linearise(project, at)

                def shifted() -> Tree:
                    linear = _tree.add(value, slope(_tree.sub(there, y)))
                    return _tree.add(linear, _tree.scale(1.0 / tau, _tree.sub(at, there)))

                change = lax.cond(any_lane(is_start), shifted, lambda: w)
                change = _tree.where(is_start, change, w)
            d = solve(Linearisation(slope, D, tau, reduction), _tree.scale(-tau, change))
            return _tree.add(at, d)

        solves = next_is_newton & (residual > limit)
        newton_z = lax.cond(any_lane(solves), newton, lambda: z)
        if vi.L_F is None:
            # Start from a larger λ, so that it recovers in regions where F is flatter.
            starts = ~next_is_newton & ~is_predictor
            lam = jnp.where(shortens, REDUCTION * lam, jnp.where(starts, GROWTH * lam, lam))
        direction = _tree.where(next_is_corrector, value, base_value)
        safeguard_z = _tree.sub(base, _tree.scale(lam, direction))
        next_kind = jnp.where(
            next_is_newton, _NEWTON, jnp.where(next_is_corrector, _CORRECTOR, _PREDICTOR)
        )
        run_length = jnp.where(failed, 2 * s.run_length, s.run_length)
        # The share of the safeguard must not vanish as the runs become longer: it is what converges.
        longest_wait = jnp.maximum(8, run_length // 8)
        new = _State(
            z=_tree.where(next_is_newton, newton_z, safeguard_z),
            kind=next_kind,
            tau=tau,
            base=base,
            base_value=base_value,
            lam=lam,
            best=best,
            first=first,
            steps_left=jnp.where(
                halved | failed, run_length, s.steps_left - jnp.where(is_newton, 1, 0)
            ),
            run_length=run_length,
            wait=wait,
            next_wait=jnp.where(
                halved,
                1,
                jnp.where(failed, jnp.minimum(2 * s.next_wait, longest_wait), s.next_wait),
            ),
            reference=jnp.where(halved | failed, jnp.inf, reference),
            singular=jnp.where(solves, ~_tree.all_finite(newton_z), s.singular),
            trust_limit=jnp.where(is_start, _TRUST_RATIO * norm_F, s.trust_limit),
        )
        result = RESULTS.where(new.singular, RESULTS.singular, RESULTS.max_steps)
        trial = Trial(
            y, w, value, tau, [z, base], 1, result, may_repeat=continues,
            rejected=failed | shortens, residual_step=residual_step,
        )  # fmt: skip
        return new, trial

    def begin(vi: FrozenVI, y0: Tree) -> _State:
        one = jnp.ones((), jnp.result_type(*jax.tree_util.tree_leaves(y0)))
        infinity, run_length = jnp.inf * one, jnp.asarray(first_run_length)
        return _State(
            y0, jnp.asarray(_START), one, y0, y0, one, infinity, infinity, run_length, run_length,
            jnp.asarray(0), jnp.asarray(1), infinity, jnp.asarray(False), infinity,
        )  # fmt: skip

    return iterate(
        vi, y0, tol, begin, advance, max_steps, initial_evaluations=0, iterate_count=2,
        projects_start=False,
    )  # fmt: skip


def _linearise(fn: Callable[[Tree], Tree], at: Tree) -> tuple[Tree, Callable[[Tree], Tree]]:
    """Return fn(at) and the derivative of fn there, as constants of an outer differentiation.

    The numbers in the derivative are made constants, not its result: it must have a transpose.
    """
    value, push = jax.linearize(fn, at)
    return lax.stop_gradient(value), jax.tree_util.tree_map(lax.stop_gradient, push)
