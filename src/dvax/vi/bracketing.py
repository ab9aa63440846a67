"""Pointwise intervals: one scalar equation a point, solved for certain."""

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..programs.structure import Structure, analyse
from .abstract import RESULTS, AbstractSolver, Answer, Frozen
from .brackets import Brackets, answer, begin, is_lost, is_open, narrow, trial
from .implicit import with_implicit_derivative
from .parameters import STEPS, check_parameters


class Bracketing(AbstractSolver):
    """For K = {lower ≤ y ≤ upper} and Fᵢ depending on yᵢ alone.

    Strong pseudomonotonicity reads F(y)(y − y*) ≥ γ(y − y*)² at every point, so F has one sign on
    each side of y*: y* = lower where F(lower) ≥ 0, y* = upper where F(upper) ≤ 0, and elsewhere a
    root between a point of either sign. All points go at once: from the guess by Newton's method
    until F changes its sign or a bound is reached, then between the two signs by interpolation
    with values and slopes, and by halving wherever that is slow (`brackets`). Monotonicity of F is
    not needed, and no starting point can fail. Every point ends between two points of
    opposite sign that are eight spacings of floating-point numbers apart, whatever `tol` is. Where
    F is affine (proved from its code), y* is the closed form proj_K(−F(0)/F′).

    A good guess takes two or three evaluations of F, with a slope each; a smooth law whose steepest
    part is a thousandth of the interval, up to fifteen; a law with an infinite slope or none at y*
    is halved, at worst in every third step.

    **Arguments:** `max_steps`, the most iterations of the root finder, one evaluation each.

    **Raises:** `dvax.InputError` where K is not a pointwise interval, or F mixes points.

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

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        structure = analyse(vi.F, y0)
        intervals = vi.K.intervals(y0)
        if intervals is None or not structure.pointwise:
            raise _not_pointwise(intervals is None)
        if structure.affine:
            return affine_answer(vi, y0)
        return self._root(vi, y0, intervals)

    def _root(self, vi: Frozen, y0: Tree, intervals: tuple[Tree, Tree]) -> Answer:
        lower, upper = lax.stop_gradient(intervals)
        guess = jtu.tree_map(jnp.clip, lax.stop_gradient(y0), lower, upper)
        points, count = _roots(_values_and_slopes(vi.F), lower, guess, upper, self.max_steps)

        found = [answer(p) for p in points]
        y, Fy, slope = (jtu.tree_structure(guess).unflatten(part) for part in zip(*found))
        # Points not held by a bound must have a root; w there is F itself, and N_K covers the rest.
        held = jtu.tree_map(
            lambda yi, f, lo, up: ((yi <= lo) & (f >= 0)) | ((yi >= up) & (f <= 0)),
            y, Fy, lower, upper,
        )  # fmt: skip
        w = jtu.tree_map(lambda f, h: jnp.where(h, 0.0, f), Fy, held)
        # On a bound F points outward; a distance of F/|slope| is how far y is held back.
        z = jtu.tree_map(
            lambda yi, f, s, h: yi - jnp.where(h, f / _away(s), 0.0), y, Fy, slope, held
        )
        differentiable = with_implicit_derivative(vi, y, 1.0, lambda found: found, pointwise=True)
        residual = vi.space.norm(w)
        result = RESULTS.where(_any(is_open, points), RESULTS.max_steps, RESULTS.successful)
        result = RESULTS.where(_any(is_lost, points), RESULTS.no_bracket, result)
        result = RESULTS.where(jnp.isfinite(residual), result, RESULTS.nonfinite)
        return Answer(differentiable, lax.stop_gradient(z), residual, count, result, count + 1)


def _roots(
    F: Callable[[Tree], tuple[list[Any], list[Any]]],
    lower: Tree,
    guess: Tree,
    upper: Tree,
    max_steps: int,
) -> tuple[list[Brackets], jax.Array]:
    """The brackets, leaf by leaf, and the number of iterations until all of them are closed."""
    leaves, tree = jtu.tree_flatten(guess)
    values = zip(leaves, *F(guess), jtu.tree_leaves(lower), jtu.tree_leaves(upper), strict=True)
    start = [begin(*point) for point in values]

    # XLA would compute the trial, and F there, anew for each of the seven arrays of a bracket. So
    # the trial is made an iteration early and carried, and F stands in a branch of its own, always
    # taken, out of which nothing is copied.
    def body(state: tuple) -> tuple:
        points, at, count, going = state
        values = lax.cond(going, F, lambda y: (jtu.tree_leaves(y),) * 2, tree.unflatten(at))
        points = [narrow(p, *new) for p, *new in zip(points, at, *values, strict=True)]
        at = [trial(p, count + 1) for p in points]
        return points, at, count + 1, _any(is_open, points)

    first = [trial(p, 0) for p in start]
    points, _, count, _ = lax.while_loop(
        lambda s: s[3] & (s[2] < max_steps),
        body,
        (start, first, jnp.asarray(0), _any(is_open, start)),
    )
    return points, count


def _values_and_slopes(F: Callable[[Tree], Tree]) -> Callable[[Tree], tuple[list[Any], list[Any]]]:
    """y ↦ leaves of F(y) and of F′(y), one number a point, cut off from derivatives."""

    def both(y: Tree) -> tuple[list[Any], list[Any]]:
        value, slope = jax.jvp(F, (y,), (jtu.tree_map(jnp.ones_like, y),))
        return jtu.tree_leaves(lax.stop_gradient(value)), jtu.tree_leaves(lax.stop_gradient(slope))

    return both


def _any(holds: Callable[[Brackets], jax.Array], points: list[Brackets]) -> jax.Array:
    return jnp.any(jnp.stack([jnp.any(holds(p)) for p in points]))


def affine_answer(vi: Frozen, like: Tree) -> Answer:
    """F(y) = a y + c pointwise, a ≥ γ > 0: y* = proj_K(−c/a), differentiable as it stands."""
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


def _away(slope: jax.Array) -> jax.Array:
    """|slope|, kept from zero: only a length scale is wanted."""
    return jnp.maximum(jnp.abs(slope), 1e-6)


def _not_pointwise(set_is_to_blame: bool) -> InputError:
    blame = "a set that is not a pointwise interval", "an F that mixes points"
    given = blame[0] if set_is_to_blame else blame[1]
    return InputError(
        InputProblem(
            "dvax.vi.Bracketing",
            given,
            "it solves one scalar inequality a point, so K is a Box and Fᵢ depends on yᵢ alone "
            "(as far as its code shows)",
            "Use dvax.vi.Auto() or dvax.vi.Extragradient()",
        )
    )


def is_pointwise(vi: Frozen, like: Tree) -> tuple[bool, Structure]:
    """Whether `Bracketing` applies, and the proved structure of F."""
    structure = analyse(vi.F, like)
    return vi.K.intervals(like) is not None and structure.pointwise, structure
