"""The loop that the iterative solvers share: the best point so far, and a reason to stop.

A method brings `begin` and `advance`; each advance ends in a point of K with an element
w ∈ F(y) + N_K(y), which is its certificate (C0). What is returned is the point with the least ‖w‖,
whatever the method did afterwards.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._tree import Tree
from .abstract import RESULTS, Answer, Frozen
from .implicit import with_implicit_derivative

_DIVERGED = 1e8
"""A point so many times farther from 0 than the first one, and no nearer to solving, has left."""


class Trial(NamedTuple):
    """What one iteration leaves.

    `y` ∈ K with `w` ∈ F(y) + N_K(y), and `value` = F(y); `step`, the λ of the method, and `length`,
    where it is another, the one that w was divided by; `at`, the
    elements that the method iterates, which move as long as it does (y may rest in a corner meanwhile);
    `calls` of F it took; `word`, what to say if no further iteration is allowed. An
    iterate that is `tentative` may come back without the method going round in a circle. `base` is
    (b, λ) where w contains (b − y)/λ.
    """

    y: Tree
    w: Tree
    value: Tree
    step: Any
    at: list[Tree]
    calls: Any
    word: RESULTS = RESULTS.max_steps
    tentative: Any = False
    length: Any = None
    base: tuple[Tree, Any] | None = None


class _State(NamedTuple):
    method: Any
    y: Tree
    value: Tree
    residual: jax.Array
    at: list[Tree]
    mark: list[Tree]
    marked: jax.Array
    step: jax.Array
    length: jax.Array
    first: jax.Array
    count: jax.Array
    calls: jax.Array
    result: RESULTS
    going: jax.Array


def iterate(
    vi: Frozen,
    y0: Tree,
    tol: Any,
    begin: Callable[[Frozen, Tree], Any],
    advance: Callable[[Frozen, Any], tuple[Any, Trial]],
    max_steps: int,
    *,
    begun: int,
    moves: int = 1,
) -> Answer:
    """Advance from proj_K(y0) until ‖w‖/γ ≤ tol (‖w‖ ≤ tol where γ is unknown), or until nothing
    more will come: see `RESULTS`. `begun` is how often `begin` calls F, `moves`
    how many elements an advance moves."""
    frozen, target = stopped(vi), tol if vi.gamma is None else vi.gamma * tol
    start = lax.stop_gradient(vi.K.project(lax.stop_gradient(y0), vi.space))
    dtype = jnp.result_type(*jtu.tree_leaves(start))
    eps, norm = jnp.finfo(dtype).eps, vi.space.norm
    length = lambda elements: sum(map(norm, elements))  # noqa: E731
    far = _DIVERGED * (1.0 + norm(start))

    def body(s: _State) -> _State:
        method, trial = advance(frozen, s.method)
        residual, size = norm(trial.w), length(trial.at)
        if trial.base is not None:
            # From far away w is a difference of large terms, of which rounding is left.
            base, divisor = trial.base
            residual = residual + 8 * eps * norm(_tree.sub(base, trial.y)) / divisor
        lam = trial.step if trial.length is None else trial.length
        first = jnp.where(s.count == 0, trial.step, s.first)
        # w contains (base − y)/λ, and with it the rounding of y divided by λ. Where that is as large as
        # F itself, the step has sunk into rounding, y − λF(y) is y, and w = 0 says nothing; but for an
        # F(y) that is none itself, since 0 is a normal.
        blur, force, rounding = eps * norm(trial.y) / lam, norm(trial.value), eps * norm(trial.y)
        sunk = (force > target + 4 * rounding / first) | (lam < 1e3 * eps) & (force > target)
        blind = (blur > 0.1 * force) & sunk & (vi.L_F is None)
        finite = jnp.isfinite(residual) & jnp.isfinite(size)
        residual = jnp.where(blind, jnp.inf, residual)
        better = residual < s.residual
        done = residual <= target
        # Rounding is all that is left of a move: of the last one, or of all since the mark (which
        # is set anew at every power of two: Brent's way to find a cycle of any length).
        rest = length(_tree.sub(trial.at, s.at)) <= 4 * eps * size
        rest &= ~jnp.asarray(trial.tentative)
        back = length(_tree.sub(trial.at, s.mark)) <= 32 * eps * size
        back &= ~jnp.asarray(trial.tentative)
        collapsed = jnp.asarray(trial.step < 1e3 * eps)
        gone = (norm(trial.y) > far) & ~better
        reason = trial.word
        for holds, word in (
            (back, RESULTS.cycling),
            (rest, RESULTS.stalled),
            (gone, RESULTS.diverging),
            (collapsed, RESULTS.not_lipschitz),
            (~finite, RESULTS.nonfinite),
            (done, RESULTS.successful),
        ):
            reason = RESULTS.where(holds, word, reason)
        count = s.count + 1
        going = ~(done | rest | back | gone | collapsed) & finite
        mark = count >= 2 * s.marked
        return _State(
            method=method,
            y=_tree.where(better, trial.y, s.y),
            value=_tree.where(better, trial.value, s.value),
            residual=jnp.where(better, residual, s.residual),
            at=trial.at,
            mark=_tree.where(mark, trial.at, s.mark),
            marked=jnp.where(mark, count, s.marked),
            step=jnp.where(better, trial.step, s.step),
            length=jnp.where(better, lam, s.length),
            first=first,
            count=count,
            calls=s.calls + trial.calls,
            result=reason,
            going=going,
        )

    method = begin(frozen, start)
    nowhere = [_tree.scale(jnp.nan, start)] * moves
    state = _State(
        method, start, _tree.scale(jnp.nan, start), jnp.asarray(jnp.inf, dtype),
        nowhere, nowhere, jnp.asarray(1), jnp.ones((), dtype), jnp.ones((), dtype),
        jnp.ones((), dtype), jnp.asarray(0), jnp.asarray(begun),
        RESULTS.max_steps, jnp.asarray(True),
    )  # fmt: skip
    state = lax.while_loop(lambda s: s.going & (s.count < max_steps), body, state)
    y = with_implicit_derivative(vi, state.y, state.step, lambda found: found, pointwise=False)
    # One fixed step for every z, whatever λ the search ended with: z is compared between times.
    tau = 1.0 if vi.L_F is None else 1.0 / vi.L_F
    z = _tree.sub(state.y, _tree.scale(tau, state.value))
    z = lax.stop_gradient(z)
    return Answer(y, z, state.residual, state.count, state.result, state.calls, state.length)


def stopped(vi: Frozen) -> Frozen:
    """The same problem with derivatives cut: the iteration itself is never differentiated."""
    return vi._replace(
        F=lambda y: lax.stop_gradient(vi.F(y)), K=jtu.tree_map(lax.stop_gradient, vi.K)
    )


def first_step(
    vi: Frozen, y: Tree, Fy: Tree, slope: Callable[[Tree], Tree] | None = None
) -> jax.Array:
    """1/L_F, or where that is unknown 1/L for the L that F shows along its own direction at y: by
    one more evaluation, or by `slope`, d ↦ F′(y)d."""
    if vi.L_F is not None:
        return jnp.asarray(1.0 / vi.L_F, jnp.result_type(*jtu.tree_leaves(y)))
    norm = vi.space.norm
    length = norm(Fy)
    eps = jnp.finfo(length.dtype).eps
    reach = jnp.sqrt(eps) * (1.0 + norm(y))
    scale = reach / jnp.where(length > 0, length, 1.0)
    ahead = vi.K.project(_tree.sub(y, _tree.scale(scale, Fy)), vi.space)
    move = _tree.sub(ahead, y)
    moved = norm(move)
    change = norm(_tree.sub(vi.F(ahead), Fy) if slope is None else slope(move))
    # Held at a corner, or F flat: any length will do, and the rules of the methods cut it.
    known = (moved > 0) & (change > 0) & jnp.isfinite(change)
    return jnp.where(known, moved / jnp.where(known, change, 1.0), 1.0)


def certificate(F_new: Tree, F_old: Tree, base: Tree, y: Tree, lam: Any) -> Tree:
    """w = F(y) − F_old + (base − y)/λ ∈ F(y) + N_K(y) for y = proj_K(base − λ F_old)."""
    return _tree.add(_tree.sub(F_new, F_old), _tree.scale(1.0 / lam, _tree.sub(base, y)))
