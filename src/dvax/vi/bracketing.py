"""Pointwise intervals: one scalar equation a point, solved for certain."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from .abstract import RESULTS, AbstractSolver, Answer, Frozen
from .implicit import with_implicit_derivative
from .structure import Structure, analyse


class Bracketing(AbstractSolver):
    """For K = {lower ≤ y ≤ upper} and Fᵢ depending on yᵢ alone.

    Strong pseudomonotonicity reads F(y)(y − y*) ≥ γ(y − y*)² at every point, so F has one sign on
    each side of y*: y* = lower where F(lower) ≥ 0, y* = upper where F(upper) ≤ 0, and elsewhere a
    bracketed root, found by Chandrupatla's method (1997) at all points at once. Monotonicity of F
    is not needed, and no starting point can fail. Where F is affine (proved from its code), y* is
    the closed form proj_K(−F(0)/F′).

    **Arguments:** `max_steps`, the most iterations of the root finder.

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

    max_steps: int = 200

    def solve(self, vi: Frozen, y0: Tree, tol: Any) -> Answer:
        structure = analyse(vi.F, y0)
        intervals = vi.K.intervals(y0)
        if intervals is None or not structure.pointwise:
            raise _not_pointwise(intervals is None)
        if structure.affine:
            return affine_answer(vi, y0)
        return self._root(vi, y0, intervals)

    def _root(self, vi: Frozen, y0: Tree, intervals: tuple[Tree, Tree]) -> Answer:
        F = lambda y: lax.stop_gradient(vi.F(y))  # noqa: E731
        lower, upper = lax.stop_gradient(intervals)
        guess = jtu.tree_map(jnp.clip, lax.stop_gradient(y0), lower, upper)
        (a, fa), (b, fb), found, widened = _enclose(F, guess, lower, upper)
        root, count, closed = _chandrupatla(F, a, fa, b, fb, self.max_steps)

        def choose(lo, up, flo, fup, inner):
            return jnp.where(flo >= 0, lo, jnp.where(fup <= 0, up, inner))

        y = jtu.tree_map(choose, a, b, fa, fb, root)
        # Points not held by a bound must have a root; w there is F itself, and N_K covers the rest.
        Fy = F(y)
        w = jtu.tree_map(
            lambda yi, f, lo, up: jnp.where(
                ((yi <= lo) & (f >= 0)) | ((yi >= up) & (f <= 0)), 0.0, f
            ),
            y, Fy, lower, upper,
        )  # fmt: skip
        slope = jax.jvp(vi.F, (y,), (jtu.tree_map(jnp.ones_like, y),))[1]
        # On a bound F points outward; a distance of F/|slope| is how far y is held back.
        z = jtu.tree_map(lambda yi, f, s, wi: yi - (f - wi) / _away(s), y, Fy, slope, w)
        differentiable = with_implicit_derivative(vi, y, 1.0, lambda found: found, pointwise=True)
        residual = vi.space.norm(w)
        result = RESULTS.where(closed, RESULTS.successful, RESULTS.max_steps)
        result = RESULTS.where(found, result, RESULTS.no_bracket)
        result = RESULTS.where(jnp.isfinite(residual), result, RESULTS.nonfinite)
        calls = 3 + 2 * widened + count
        return Answer(differentiable, lax.stop_gradient(z), residual, count, result, calls)


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


def _enclose(F: Any, guess: Tree, lower: Tree, upper: Tree) -> tuple[Any, Any, Any, Any]:
    """Finite [a, b] inside K with F(a) ≥ 0 only if a = lower, and F(b) ≤ 0 only if b = upper.

    Infinite ends are replaced by points that walk outward from the guess, doubling their distance;
    how often is returned last.
    """
    finite = lambda leaf: jnp.isfinite(leaf)  # noqa: E731

    def ends(width: Any) -> tuple[Tree, Tree]:
        a = jtu.tree_map(lambda lo, g: jnp.where(finite(lo), lo, g - width), lower, guess)
        b = jtu.tree_map(lambda up, g: jnp.where(finite(up), up, g + width), upper, guess)
        return a, b

    def missing(a: Tree, fa: Tree, b: Tree, fb: Tree) -> jax.Array:
        short = jtu.tree_map(
            lambda lo, up, fl, fu: jnp.any((~finite(lo) & (fl > 0)) | (~finite(up) & (fu < 0))),
            lower, upper, fa, fb,
        )  # fmt: skip
        return jnp.any(jnp.stack(jtu.tree_leaves(short)))

    def widen(state: tuple) -> tuple:
        width = 2.0 * state[0]
        a, b = ends(width)
        return width, a, F(a), b, F(b)

    def go_on(state: tuple) -> jax.Array:
        width, (a, fa, b, fb) = state[0], state[1:]
        return missing(a, fa, b, fb) & (width < jnp.finfo(width.dtype).max ** 0.3)

    one = jnp.ones((), jnp.result_type(*jtu.tree_leaves(guess)))
    a, b = ends(one)
    start = (one, a, F(a), b, F(b))
    width, a, fa, b, fb = lax.while_loop(go_on, widen, start)
    widened = jnp.round(jnp.log2(width)).astype(int)
    return (a, fa), (b, fb), ~missing(a, fa, b, fb), widened


def _chandrupatla(
    F: Any, a: Tree, fa: Tree, b: Tree, fb: Tree, max_steps: int
) -> tuple[Tree, Any, jax.Array]:
    """All roots at once: inverse quadratic interpolation where it is safe, else bisection.

    Returns the roots, the number of iterations, and whether every bracket was closed.

    Chandrupatla 1997, Adv. Eng. Software 28, 145–149. Stops when every bracket is two spacings of
    floating-point numbers wide, or F vanishes.
    """
    leaves = lambda tree: jtu.tree_leaves(tree)  # noqa: E731
    unflatten = jtu.tree_structure(a).unflatten
    A, FA, B, FB = leaves(a), leaves(fa), leaves(b), leaves(fb)

    def one(x1, f1, x2, f2, x3, f3, t):
        """New point from newest x1, opposite x2, previous x3."""
        x = x1 + t * (x2 - x1)
        return x

    def body(state: tuple) -> tuple:
        points, count, _ = state
        trial = [one(*p) for p in points]
        values = leaves(F(unflatten(trial)))
        new, open_ = [], []
        for (x1, f1, x2, f2, _, _, _), x, f in zip(points, trial, values, strict=True):
            same = jnp.sign(f) == jnp.sign(f1)
            x3, f3 = jnp.where(same, x1, x2), jnp.where(same, f1, f2)
            x2n, f2n = jnp.where(same, x2, x1), jnp.where(same, f2, f1)
            best = jnp.where(jnp.abs(f) < jnp.abs(f2n), x, x2n)
            eps = jnp.finfo(x.dtype).eps
            tol = 2 * eps * jnp.abs(best) + jnp.finfo(x.dtype).tiny
            width = jnp.abs(x2n - x)
            tl = jnp.minimum(tol / jnp.where(width > 0, width, 1.0), 0.5)
            xi = (x - x2n) / jnp.where(x3 == x2n, 1.0, x3 - x2n)
            ph = (f - f2n) / jnp.where(f3 == f2n, 1.0, f3 - f2n)
            safe = (ph**2 < xi) & ((1 - ph) ** 2 < 1 - xi) & (x3 != x2n) & (f3 != f2n)
            iqi = f / jnp.where(f2n == f, 1.0, f2n - f) * f3 / jnp.where(f2n == f3, 1.0, f2n - f3)
            iqi = iqi + (x3 - x) / jnp.where(x2n == x, 1.0, x2n - x) * f / jnp.where(
                f3 == f, 1.0, f3 - f
            ) * f2n / jnp.where(f3 == f2n, 1.0, f3 - f2n)
            t = jnp.clip(jnp.where(safe, iqi, 0.5), tl, 1 - tl)
            new.append((x, f, x2n, f2n, x3, f3, t))
            bracketed = jnp.sign(f) != jnp.sign(f2n)
            open_.append(jnp.any((width > 2 * tol) & (f != 0) & (f2n != 0) & bracketed))
        return new, count + 1, jnp.any(jnp.stack(open_))

    half = [jnp.full_like(x, 0.5) for x in A]
    start = [
        (x2, f2, x1, f1, x1, f1, t) for x1, f1, x2, f2, t in zip(A, FA, B, FB, half, strict=True)
    ]
    points, count, unfinished = lax.while_loop(
        lambda s: s[2] & (s[1] < max_steps), body, (start, jnp.asarray(0), jnp.asarray(True))
    )
    best = [jnp.where(jnp.abs(f1) < jnp.abs(f2), x1, x2) for x1, f1, x2, f2, _, _, _ in points]
    return unflatten(best), count, ~unfinished


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
