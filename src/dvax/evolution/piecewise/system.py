"""A problem that is affine in state and response, in matrix form, and the choice of its unknowns.

    x' = Ax + By + g(t),    w = My + Cx + q(t),    wᵢ ≥ 0 where yᵢ = lᵢ,  wᵢ ≤ 0 where yᵢ = uᵢ,
    else wᵢ = 0.

Each pair (yᵢ, wᵢ) has an independent member pᵢ and a dependent member dᵢ, so that the equations read
x' = Ax + Bp + g, d = Mp + Cx + q. Principal pivots choose the independent members once per run. A bad
choice makes large entries of A that cancel when the constraint is active. No further elimination
occurs: where d is prescribed, p remains an unknown beside x. A small M (the resistance of a diode)
therefore never becomes a large entry of a matrix.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ..._tree import Tree
from ...errors import InputError, Problems, input_error
from ...problem import Problem
from ...programs.derivatives_of_operations import has_derivative, of_operations
from ...programs.intermediate import intermediate, subtracted
from ...vi import analyse, independent

Array = np.ndarray

LARGEST = 64
"""Largest number of states and of responses: a step solves dense equations in all of them."""


class Sizes(NamedTuple):
    """Sums of the absolute values of the terms of the matrices of a system, for rounding errors."""

    A: Array
    B: Array
    M: Array
    C: Array


class Affine(NamedTuple):
    """The matrices of a system and the bounds `low` ≤ y ≤ `up`.

    - `swapped`: a mask of the pairs whose independent member is w;
    - `inputs`: the matrix that maps (g, q) of the problem to (g, q) in these variables;
    - `sizes`: those of the terms of A, B, M and C before pivots.
    """

    A: Array
    B: Array
    M: Array
    C: Array
    low: Array
    up: Array
    swapped: Array
    inputs: Array
    sizes: Sizes

    def pivot(self, i: int) -> "Affine":
        """Return the system with the members of pair i exchanged (a principal pivot)."""
        n, m = self.B.shape
        block = np.block([[self.A, self.B], [self.C, self.M]])
        k = n + i
        pivot = block[k, k]
        row, column = block[k] / pivot, block[:, k] / pivot
        new = block - np.outer(block[:, k], row)
        new[k], new[:, k], new[k, k] = -row, column, 1.0 / pivot
        # Solving d = … + q for p gives p = (d − … − q)/pivot.
        inputs = np.eye(n + m)
        inputs[:, k] -= column
        inputs[k] = 0.0
        inputs[k, k] = -1.0 / pivot
        swapped = self.swapped.copy()
        swapped[i] = ~swapped[i]
        return self._replace(
            A=new[:n, :n], B=new[:n, n:], C=new[n:, :n], M=new[n:, n:], swapped=swapped,
            inputs=inputs @ self.inputs,
        )  # fmt: skip


def affine(problem: Problem, t0: Any, x0: Tree, args: Any) -> Affine:
    """Return the system of `problem`, after proving that it is affine with constant matrices.

    **Raises:** `dvax.InputError` if the code of f, h or K does not prove it.
    """
    u0 = problem.zero_control(x0)
    _check(problem, t0, x0, u0, args)
    matrices = _matrices(problem, args, x0, u0, jnp.asarray(t0, jnp.result_type(x0)))
    A, B, M, C, low, up, *sizes = (np.asarray(v, float) for v in matrices)
    n, m = B.shape
    return Affine(A, B, M, C, low, up, np.zeros(m, bool), np.eye(n + m), Sizes(*sizes))


def is_affine(problem: Problem, t0: Any, x0: Tree, args: Any) -> bool:
    """Return whether the code of f, h and K proves that `affine` has a system of this problem."""
    try:
        _check(problem, t0, x0, problem.zero_control(x0), args)
    except InputError:
        return False
    return True


def _check(problem: Problem, t0: Any, x0: Tree, u0: Tree, args: Any) -> None:
    place = "dvax.solve(method=dvax.PiecewiseLinear())"
    several = isinstance(x0, tuple) or isinstance(u0, tuple)
    sizes = [leaf.size for leaf in jtu.tree_leaves((x0, u0))]
    if several or max(sizes) > LARGEST:
        given = "several parts" if several else f"{sizes[0]} and {sizes[1]} entries"
        raise input_error(
            place, f"a state or response of {given}",
            f"state and response must each be one array of at most {LARGEST} entries",
            "Omit method, or choose another one",
        )  # fmt: skip
    t, both = jnp.asarray(t0, jnp.result_type(x0)), (x0, u0)
    wrong = Problems()
    for name, fn in (("f", problem.f), ("h", problem.h)):
        if not _is_affine(lambda t, both, fn=fn: fn(t, *both, args), t, both):
            wrong.add(
                f"{place}: {name}", "code that is not proved to be affine",
                f"{name} must be affine in (x, u) with coefficients that do not depend on t",
                "Omit method, or choose another one",
            )  # fmt: skip
    bounds = lambda t: problem.set_at(t, args).intervals(u0)  # noqa: E731
    if bounds(t) is None or not independent(bounds, t):
        wrong.add(
            f"{place}: K", type(problem.set_at(t, args)).__name__,
            "K must be a box that does not move", "Omit method, or choose another one",
        )  # fmt: skip
    wrong.raise_any()


def _is_affine(fn: Callable[..., Any], t: Any, both: Any) -> bool:
    """Return whether the code of a function of t and (x, u) proves that it is affine in these, with
    constant coefficients."""
    try:
        plain = of_operations(fn, t, both)
    except NotImplementedError:
        return False
    if not has_derivative(plain, t, both):
        return False
    constant = independent(lambda t: jax.jacfwd(plain, argnums=1)(t, both), t)
    return constant and analyse(lambda both: plain(t, both), both).affine


@eqx.filter_jit
def _matrices(problem: Problem, args: Any, x0: Any, u0: Any, t: Any) -> tuple[Any, ...]:
    n, m = x0.size, u0.size
    P = problem.operator(args)
    as_state = lambda v: v.reshape(x0.shape)  # noqa: E731
    as_control = lambda v: v.reshape(u0.shape)  # noqa: E731
    linear = jax.vmap(lambda v: problem.generator(args).apply(as_state(v)).ravel())(jnp.eye(n)).T
    inverse = jax.vmap(lambda v: P.inverse(as_control(v)).ravel())(jnp.eye(m)).T

    def slopes(fn: Any) -> tuple[Any, Any]:
        at = lambda x, u: fn(t, as_state(x), as_control(u), args).ravel()  # noqa: E731
        point = x0.ravel(), u0.ravel()
        return jax.jacfwd(of_operations(at, *point), argnums=(0, 1))(*point)

    (f_x, f_u), (h_x, h_u) = slopes(problem.f), slopes(problem.h)
    law, size = inverse - h_u @ inverse, jnp.abs(inverse) + jnp.abs(h_u) @ jnp.abs(inverse)
    traced = jax.make_jaxpr(lambda t, x, u: problem.h(t, x, u, args))(t, x0, u0)
    rest = subtracted(traced)
    if rest is not None:
        # u does not cancel to a small M, which would have the rounding errors of 1.
        of_rest = slopes(lambda t, x, u, args: intermediate(traced, rest)(t, x, u))[1]
        law, size = of_rest @ inverse, jnp.abs(of_rest) @ jnp.abs(inverse)
    bounds = problem.set_at(t, args).intervals(u0)
    assert bounds is not None
    low, up = (v.ravel() for v in bounds)
    # Terms of f that cancel terms of the generator do so here, before the time integration.
    sizes = jnp.abs(linear) + jnp.abs(f_x), jnp.abs(f_u) @ jnp.abs(inverse), size, jnp.abs(h_x)
    return linear + f_x, f_u @ inverse, law, -h_x, low, up, *sizes


def pivoted(system: Affine) -> Affine:
    """Return the system after the principal pivots that reduce roundoff.

    Pairs are tested one by one. A pivot is accepted if it halves the sum of |A|, or if it reduces this
    sum without enlarging M much: the roundoff of a dependent member is proportional to its
    coefficients.
    """
    size = np.abs(system.A).sum()
    for i in range(len(system.low)):
        if system.M[i, i] > 0.0:
            candidate = system.pivot(i)
            candidate_size = np.abs(candidate.A).sum()
            keeps_m_small = np.abs(candidate.M).max() <= 10.0 * np.abs(system.M).max()
            if candidate_size < (size if keeps_m_small else 0.5 * size):
                system, size = candidate, candidate_size
    return system
