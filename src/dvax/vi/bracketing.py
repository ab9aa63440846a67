"""Pointwise intervals: one scalar equation per point, solved by bracketed root finding."""

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import InputError, input_error
from ..programs.structure import analyse
from .abstract import RESULTS, AbstractSolver, Answer, FrozenVI
from .brackets import Brackets, begin, has_no_sign_change, is_open, narrow, root, trial
from .implicit import with_implicit_derivative
from .parameters import STEPS, check_parameters


class Bracketing(AbstractSolver):
    """Bracketed root finding for K = {lower ≤ y ≤ upper} and Fᵢ depending on yᵢ alone.

    Strong pseudomonotonicity gives F(y)(y − y*) ≥ γ(y − y*)² at every point, so F has one sign on
    each side of y*: y* = lower if F(lower) ≥ 0, y* = upper if F(upper) ≤ 0, and otherwise y* is a root
    between two points of opposite sign. All points are treated at once. Newton's method runs from the
    guess until F changes sign or a bound is reached; the bracket is then narrowed by interpolation
    with values and slopes, and by bisection wherever interpolation is slow (`brackets`). F need not be
    monotone, and every starting point converges. Each bracket ends eight spacings of floating-point
    numbers wide, whatever `tol` is. If F is affine (proved from its code), y* is the closed form
    proj_K(−F(0)/F′).

    A good guess takes two or three evaluations of F and its slope. A smooth law whose steepest part
    covers a thousandth of the interval takes up to fifteen. A law whose slope at y* is infinite or
    undefined is bisected at least in every third step.

    **Arguments:** `max_steps`, the maximum number of iterations of the root finder, with one
    evaluation each.

    **Raises:** `dvax.InputError` if K is not a pointwise interval, or F couples points.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> law = lambda y, args: (2 + jnp.sin(y)) * (y - 1.0)
    >>> vi = dvax.solve_vi(law, dvax.sets.Box(0.0, 4.7), jnp.array(3.0), gamma=1.0,
    ...                    solver=dvax.vi.Bracketing())
    >>> print(f"{float(vi.y):.12f}")
    1.000000000000

    ```
    """

    certifies: ClassVar[bool] = False

    max_steps: int = 400

    def __check_init__(self) -> None:
        check_parameters(self, max_steps=STEPS)

    def solve(self, vi: FrozenVI, y0: Tree, tol: Any) -> Answer:
        structure = analyse(vi.F, y0)
        intervals = vi.K.intervals(y0)
        if intervals is None or not structure.pointwise:
            raise _not_pointwise(set_is_interval=intervals is not None)
        if structure.affine:
            return affine_answer(vi, y0)
        return self._solve_roots(vi, y0, intervals)

    def _solve_roots(self, vi: FrozenVI, y0: Tree, intervals: tuple[Tree, Tree]) -> Answer:
        lower, upper = lax.stop_gradient(intervals)
        guess = jtu.tree_map(jnp.clip, lax.stop_gradient(y0), lower, upper)
        brackets, count = _find_roots(_values_and_slopes(vi.F), lower, guess, upper, self.max_steps)

        roots = zip(*map(root, brackets), strict=True)
        y, Fy, slope, at_bound = map(jtu.tree_structure(guess).unflatten, roots)
        # At an active bound −F ∈ N_K, so w = 0 there; at every other point w = F.
        w = jtu.tree_map(lambda f, active: jnp.where(active, 0.0, f), Fy, at_bound)
        # At an active bound z is a Newton step from y towards the root of F beyond the bound.
        z = jtu.tree_map(
            lambda yi, f, s, active: yi - jnp.where(active, f / _safe_divisor(s), 0.0),
            y, Fy, slope, at_bound,
        )  # fmt: skip
        differentiable = with_implicit_derivative(vi, y, 1.0, pointwise=True)
        residual = vi.space.norm(w)
        result = RESULTS.where(_any(is_open, brackets), RESULTS.max_steps, RESULTS.successful)
        result = RESULTS.where(_any(has_no_sign_change, brackets), RESULTS.no_bracket, result)
        result = RESULTS.where(jnp.isfinite(residual), result, RESULTS.nonfinite)
        return Answer(differentiable, lax.stop_gradient(z), residual, count, result, count + 1)


def _find_roots(
    F: Callable[[Tree], tuple[list[Any], list[Any]]],
    lower: Tree,
    guess: Tree,
    upper: Tree,
    max_steps: int,
) -> tuple[list[Brackets], jax.Array]:
    """Return the brackets of every leaf, and the number of iterations until all are closed."""
    leaves, tree = jtu.tree_flatten(guess)
    ends = zip(leaves, jtu.tree_leaves(lower), jtu.tree_leaves(upper), strict=True)
    whole = [begin(*point) for point in ends]

    # XLA would recompute F for each of the seven arrays of a bracket, possibly with other roundings, so
    # that its sign would not be the same for all of them. So the trial points and F there are carried
    # into the iteration that narrows the brackets.
    def body(state: tuple) -> tuple:
        brackets, at, values, count, _ = state
        brackets = [narrow(p, *new) for p, *new in zip(brackets, at, *values, strict=True)]
        running = _any(is_open, brackets) & (count < max_steps)
        at = [trial(p, count) for p in brackets]
        values = lax.cond(running, F, lambda y: (jtu.tree_leaves(y),) * 2, tree.unflatten(at))
        return brackets, at, values, jnp.where(running, count + 1, count), running

    start = whole, leaves, F(guess), jnp.asarray(0), jnp.asarray(True)
    brackets, _, _, count, _ = lax.while_loop(lambda s: s[-1], body, start)
    return brackets, count


def _values_and_slopes(F: Callable[[Tree], Tree]) -> Callable[[Tree], tuple[list[Any], list[Any]]]:
    """Return y ↦ (leaves of F(y), leaves of F′(y)), one number per point, without derivatives."""

    def both(y: Tree) -> tuple[list[Any], list[Any]]:
        value, slope = jax.jvp(F, (y,), (jtu.tree_map(jnp.ones_like, y),))
        return jtu.tree_leaves(lax.stop_gradient(value)), jtu.tree_leaves(lax.stop_gradient(slope))

    return both


def _any(condition: Callable[[Brackets], jax.Array], brackets: list[Brackets]) -> jax.Array:
    return jnp.any(jnp.stack([jnp.any(condition(p)) for p in brackets]))


def affine_answer(vi: FrozenVI, like: Tree) -> Answer:
    """Return y* = proj_K(−c/a) for F(y) = a y + c pointwise with a ≥ γ > 0, with its derivative."""
    zero = _tree.zeros_like(like)
    ones = jtu.tree_map(jnp.ones_like, zero)
    c, a = jax.jvp(vi.F, (zero,), (ones,))
    z = jtu.tree_map(lambda p, q: -p / q, c, a)
    y = vi.K.project(z, vi.space)
    leaves = jtu.tree_leaves(y)
    positive = jnp.all(jnp.stack([jnp.all(slope > 0) for slope in jtu.tree_leaves(a)]))
    result = RESULTS.where(positive, RESULTS.successful, RESULTS.wrong_slope)
    result = RESULTS.where(_tree.all_finite(y), result, RESULTS.nonfinite)
    exact, one = jnp.zeros((), jnp.result_type(*leaves)), jnp.asarray(1)
    return Answer(y, z, exact, one, result, one)


def _safe_divisor(slope: jax.Array) -> jax.Array:
    """Return |slope|, bounded away from zero: it only sets a length scale."""
    return jnp.maximum(jnp.abs(slope), 1e-6)


def _not_pointwise(*, set_is_interval: bool) -> InputError:
    value_text = "an F that couples points"
    if not set_is_interval:
        value_text = "a set that is not a pointwise interval"
    return input_error(
        "dvax.vi.Bracketing",
        value_text,
        "it solves one scalar inequality per point, so K must be a Box and the code of F must "
        "show that Fᵢ depends on yᵢ alone",
        "Use dvax.vi.Auto() or dvax.vi.Extragradient()",
    )


def is_pointwise(vi: FrozenVI, like: Tree) -> bool:
    """Return whether `Bracketing` applies: K is a pointwise interval and F is proved pointwise."""
    return vi.K.intervals(like) is not None and analyse(vi.F, like).pointwise
