"""The loop of the iterative solvers: it keeps the best point so far and decides when to stop.

A method supplies `begin` and `advance`. Each call of `advance` returns a point of K with an element
w ∈ F(y) + N_K(y), its certificate (C0). The loop returns the point with the smallest ‖w‖.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import RESULTS, Answer, FrozenVI
from .implicit import with_implicit_derivative
from .projection_error import rounding_of_w

_DIVERGENCE_FACTOR = 1e8
"""The method diverges if ‖y‖ exceeds 1 + ‖y₀‖ by this factor without reducing ‖w‖."""


_ROUNDINGS = 4.0
"""Ratio of ‖w‖ to its estimated rounding error that counts as roundoff."""


class Trial(NamedTuple):
    """The trial point of one iteration.

    - `y` ∈ K, with `w` ∈ F(y) + N_K(y) and `value` = F(y);
    - `step`, the λ of the method;
    - `iterates`, the elements that the method iterates; they change as long as it makes progress, while
      y may stay in a corner of K;
    - `evaluations` of F in this iteration;
    - `result`, the code to report if no further iteration is allowed;
    - `may_repeat`: the point may repeat an earlier one although the method is not cycling;
    - `rejected`: the method does not continue from this point. It may repeat, and it may be infinite;
    - `residual_step`, the λ in w, if it differs from `step`;
    - `base`, (b, λ) if w contains (b − y)/λ.
    """

    y: Tree
    w: Tree
    value: Tree
    step: Any
    iterates: list[Tree]
    evaluations: Any
    result: RESULTS = RESULTS.max_steps
    may_repeat: Any = False
    rejected: Any = False
    residual_step: Any = None
    base: tuple[Tree, Any] | None = None


class _State(NamedTuple):
    """The state of the method, the best point (`y` to `residual_step`, but for `iterates`), and the
    checkpoint of Brent's cycle detection: the iterates after `checkpoint_count` iterations."""

    method: Any
    y: Tree
    value: Tree
    residual: jax.Array
    iterates: list[Tree]
    checkpoint: list[Tree]
    checkpoint_count: jax.Array
    step: jax.Array
    residual_step: jax.Array
    initial_step: jax.Array
    count: jax.Array
    evaluations: jax.Array
    result: RESULTS
    running: jax.Array


def iterate(
    vi: FrozenVI,
    y0: Tree,
    tol: Any,
    begin: Callable[[FrozenVI, Tree], Any],
    advance: Callable[[FrozenVI, Any], tuple[Any, Trial]],
    max_steps: int,
    *,
    initial_evaluations: int,
    iterate_count: int = 1,
    projects_start: bool = True,
) -> Answer:
    """Advance from proj_K(y0) until ‖w‖/γ ≤ tol (‖w‖ ≤ tol if γ is unknown) or the method fails.

    **Arguments:** `initial_evaluations`, the number of evaluations of F in `begin`;
    `iterate_count`, the number of elements in `Trial.iterates`; `projects_start`: if false, the method
    advances from y0 itself.
    """
    frozen, start = without_derivatives(vi), lax.stop_gradient(y0)
    target = residual_target(frozen, lax.stop_gradient(tol))
    if projects_start:
        start = lax.stop_gradient(vi.K.project(start, vi.space))
    dtype = jnp.result_type(*jtu.tree_leaves(start))
    eps, norm = jnp.finfo(dtype).eps, partial(norm_of_constant, frozen.space)
    divergence_radius = _DIVERGENCE_FACTOR * (1.0 + norm(start))

    def total_norm(elements: list[Tree]) -> Any:
        return sum(map(norm, elements))

    def body(s: _State) -> _State:
        method, trial = advance(frozen, s.method)
        residual, size = norm(trial.w), total_norm(trial.iterates)
        if trial.base is not None:
            # If b is large, w is a difference of large terms, and their rounding errors add to ‖w‖.
            base, divisor = trial.base
            residual = residual + 8 * eps * norm(_tree.sub(base, trial.y)) / divisor
        lam = trial.step if trial.residual_step is None else trial.residual_step
        initial_step = jnp.where(s.count == 0, trial.step, s.initial_step)
        # w contains (base − y)/λ, and so the rounding error of y divided by λ. If that is comparable
        # with ‖F(y)‖, then y − λF(y) rounds to y and w = 0 is meaningless. The exception is an F(y)
        # that counts as zero, for which y is a solution since 0 ∈ N_K(y).
        rounding, norm_F = eps * norm(trial.y), norm(trial.value)
        F_is_large = (norm_F > target + 4 * rounding / initial_step) | (lam < 1e3 * eps) & (
            norm_F > target
        )
        limit = residual_limit(frozen, target, trial.y, norm_F, lam, initial_step)
        meaningless = (rounding / lam > 0.1 * norm_F) & F_is_large & (vi.L_F is None)
        meaningless &= norm_F > limit
        accepted = ~jnp.asarray(trial.rejected)
        finite = (jnp.isfinite(residual) & jnp.isfinite(size)) | ~accepted
        residual = jnp.where(meaningless, jnp.inf, residual)
        # The first point replaces the start in any case, since the start may lie outside of K.
        better = (residual < s.residual) | (s.count == 0)
        done = residual <= limit
        # The iterates changed by rounding alone, since the last iteration (stalled) or since the
        # checkpoint (cycling). Brent's algorithm renews the checkpoint at every power of two, so it
        # finds cycles of any length.
        is_new = accepted & ~jnp.asarray(trial.may_repeat)
        stalled = total_norm(_tree.sub(trial.iterates, s.iterates)) <= 4 * eps * size
        stalled &= is_new
        cycling = total_norm(_tree.sub(trial.iterates, s.checkpoint)) <= 32 * eps * size
        cycling &= is_new
        step_vanished = jnp.asarray(trial.step < 1e3 * eps)
        diverging = (norm(trial.y) > divergence_radius) & ~better & accepted
        result = trial.result
        for holds, code in (
            (cycling, RESULTS.cycling),
            (stalled, RESULTS.stalled),
            (diverging, RESULTS.diverging),
            (step_vanished, RESULTS.not_lipschitz),
            (~finite, RESULTS.nonfinite),
            (done, RESULTS.successful),
        ):
            result = RESULTS.where(holds, code, result)
        count = s.count + 1
        running = ~(done | stalled | cycling | diverging | step_vanished) & finite
        renew = (count >= 2 * s.checkpoint_count) & is_new
        return _State(
            method=method,
            y=_tree.where(better, trial.y, s.y),
            value=_tree.where(better, trial.value, s.value),
            residual=jnp.where(residual < s.residual, residual, s.residual),
            iterates=trial.iterates,
            checkpoint=_tree.where(renew, trial.iterates, s.checkpoint),
            checkpoint_count=jnp.where(renew, count, s.checkpoint_count),
            step=jnp.where(better, trial.step, s.step),
            residual_step=jnp.where(better, lam, s.residual_step),
            initial_step=initial_step,
            count=count,
            evaluations=s.evaluations + trial.evaluations,
            result=result,
            running=running,
        )

    method = begin(frozen, start)
    no_iterates = [_tree.scale(jnp.nan, start)] * iterate_count
    state = _State(
        method, start, _tree.scale(jnp.nan, start), jnp.asarray(jnp.inf, dtype),
        no_iterates, no_iterates, jnp.asarray(1), jnp.ones((), dtype), jnp.ones((), dtype),
        jnp.ones((), dtype), jnp.asarray(0), jnp.asarray(initial_evaluations),
        RESULTS.max_steps, jnp.asarray(True),
    )  # fmt: skip
    state = lax.while_loop(lambda s: s.running & (s.count < max_steps), body, state)
    y = with_implicit_derivative(vi, state.y, state.step, pointwise=False)
    # z is compared between times, so its step must not depend on the last λ of the iteration.
    tau = 1.0 if vi.L_F is None else 1.0 / vi.L_F
    z = _tree.sub(state.y, _tree.scale(tau, state.value))
    z = lax.stop_gradient(z)
    return Answer(
        y, z, state.residual, state.count, state.result, state.evaluations, state.residual_step
    )


def without_derivatives(vi: FrozenVI) -> FrozenVI:
    """Return the same problem without derivatives: the iteration is not differentiated."""
    data = jtu.tree_map(lax.stop_gradient, vi._replace(F=None))
    return data._replace(F=lambda y: lax.stop_gradient(vi.F(y)))


def residual_target(vi: FrozenVI, tol: Any) -> Any:
    """Return the ‖w‖ that meets the tolerance."""
    return tol if vi.gamma is None else vi.gamma * tol


def residual_limit(
    vi: FrozenVI, target: Any, y: Tree, norm_F: Any, lam: Any, initial_step: Any
) -> Any:
    """Return the ‖w‖ at y that ends an iteration: `target`, or less by `vi.rtol`, or roundoff.

    λ at the start is about 1/L. A λ that became much smaller would make any ‖w‖ roundoff, and the terms
    of F have the size of L‖y‖ even if λ became much larger.
    """
    if vi.rtol is None:
        return target
    size, step = norm_of_constant(vi.space, y), jnp.maximum(lam, 0.1 * initial_step)
    terms = size / initial_step + norm_F
    roundoff = rounding_of_w(vi.K, y, size, norm_F, step) + jnp.finfo(terms.dtype).eps * terms
    return jnp.maximum(jnp.minimum(target, vi.rtol * terms), _ROUNDINGS * roundoff)


def norm_of_constant(space: AbstractSpace, a: Tree) -> jax.Array:
    """Return ‖a‖ by fewer operations than `space.norm`, which also has a derivative at 0."""
    return jnp.sqrt(space.inner(a, a))


def inverse_slope(vi: FrozenVI, Fy: Tree, slope: Callable[[Tree], Tree]) -> jax.Array:
    """Return 1/L_F, or if L_F is unknown ‖F(y)‖/‖F′(y)F(y)‖, with the derivative `slope` of F at y."""
    norm_F = norm_of_constant(vi.space, Fy)
    if vi.L_F is not None:
        return jnp.asarray(1.0 / vi.L_F, norm_F.dtype)
    change = norm_of_constant(vi.space, slope(Fy))
    is_defined = (norm_F > 0) & (change > 0) & jnp.isfinite(change)
    return jnp.where(is_defined, norm_F / jnp.where(is_defined, change, 1.0), 1.0)


def first_step(
    vi: FrozenVI, y: Tree, Fy: Tree, slope: Callable[[Tree], Tree] | None = None
) -> jax.Array:
    """Return 1/L_F, or if L_F is unknown 1/L for the slope L of F at y in the direction −F(y).

    L is a difference quotient, with one more evaluation of F, or comes from `slope`, d ↦ F′(y)d.
    """
    if vi.L_F is not None:
        return jnp.asarray(1.0 / vi.L_F, jnp.result_type(*jtu.tree_leaves(y)))
    norm = vi.space.norm
    norm_F = norm(Fy)
    eps = jnp.finfo(norm_F.dtype).eps
    increment = jnp.sqrt(eps) * (1.0 + norm(y))
    scale = increment / jnp.where(norm_F > 0, norm_F, 1.0)
    neighbour = vi.K.project(_tree.sub(y, _tree.scale(scale, Fy)), vi.space)
    move = _tree.sub(neighbour, y)
    distance = norm(move)
    change = norm(_tree.sub(vi.F(neighbour), Fy) if slope is None else slope(move))
    # In a corner of K, or if F is constant, any step will do: the methods reduce it if necessary.
    is_defined = (distance > 0) & (change > 0) & jnp.isfinite(change)
    return jnp.where(is_defined, distance / jnp.where(is_defined, change, 1.0), 1.0)


def residual_vector(F_new: Tree, F_old: Tree, base: Tree, y: Tree, lam: Any) -> Tree:
    """Return w = F(y) − F_old + (base − y)/λ ∈ F(y) + N_K(y) for y = proj_K(base − λ F_old)."""
    return _tree.add(_tree.sub(F_new, F_old), _tree.scale(1.0 / lam, _tree.sub(base, y)))
