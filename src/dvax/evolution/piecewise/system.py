"""A problem that is affine in state and response, as matrices, and the variables it is solved in.

    x' = Ax + By + g(t),    w = My + Cx + q(t),    wᵢ ≥ 0 where yᵢ = lᵢ,  wᵢ ≤ 0 where yᵢ = uᵢ,
    else wᵢ = 0.

Each pair (yᵢ, wᵢ) has an independent member pᵢ and a dependent one dᵢ, so that the equations read
x' = Ax + Bp + g, d = Mp + Cx + q. Which member is independent is decided once a run, by principal
pivots: a member that the other one determines through a large coefficient makes large entries of A that
cancel when the constraint is active. Nothing is eliminated after that: where d is prescribed, p stays
an unknown beside x. So a small M (the resistance of a diode) never becomes a large entry of a matrix.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from ..._tree import Tree
from ...errors import InputError, InputProblem
from ...problem import Problem
from ...vi import analyse, independent

Array = np.ndarray

LARGEST = 64
"""The most states and the most responses: a step solves dense equations in all of them."""


class Affine(NamedTuple):
    """The matrices; `low` ≤ y ≤ `up`; `swapped` says of which pairs w is the independent member;
    `inputs` maps (g, q) as the problem has them to those of these variables, one matrix for both."""

    A: Array
    B: Array
    M: Array
    C: Array
    low: Array
    up: Array
    swapped: Array
    inputs: Array

    def modified(self, i: int) -> "Affine":
        """The same system with the members of pair i exchanged (a principal pivot)."""
        n, m = self.B.shape
        whole = np.block([[self.A, self.B], [self.C, self.M]])
        k = n + i
        pivot = whole[k, k]
        row, column = whole[k] / pivot, whole[:, k] / pivot
        new = whole - np.outer(whole[:, k], row)
        new[k], new[:, k], new[k, k] = -row, column, 1.0 / pivot
        # d = … + q determines p = (d − … − q)/pivot.
        given = np.eye(n + m)
        given[:, k] -= column
        given[k] = 0.0
        given[k, k] = -1.0 / pivot
        swapped = self.swapped.copy()
        swapped[i] = ~swapped[i]
        return self._replace(
            A=new[:n, :n], B=new[:n, n:], C=new[n:, :n], M=new[n:, n:], swapped=swapped,
            inputs=given @ self.inputs,
        )  # fmt: skip


def affine(problem: Problem, t0: Any, x0: Tree, args: Any) -> Affine:
    """The system of `problem`, proved from its code to be affine with constant matrices.

    **Raises:** `dvax.InputError` where the code of f, h or K does not show it.
    """
    u0 = problem.zero_control(x0)
    _check(problem, t0, x0, u0, args)
    found = _matrices(problem, args, x0, u0, jnp.asarray(t0, jnp.result_type(x0)))
    A, B, M, C, low, up = (np.asarray(v, float) for v in found)
    n, m = B.shape
    return Affine(A, B, M, C, low, up, np.zeros(m, bool), np.eye(n + m))


def _check(problem: Problem, t0: Any, x0: Tree, u0: Tree, args: Any) -> None:
    place = "dvax.solve(method=dvax.PiecewiseLinear())"
    several = isinstance(x0, tuple) or isinstance(u0, tuple)
    sizes = [leaf.size for leaf in jtu.tree_leaves((x0, u0))]
    if several or max(sizes) > LARGEST:
        given = "several parts" if several else f"{sizes[0]} and {sizes[1]} entries"
        raise InputError(
            InputProblem(
                place, f"a state or response of {given}",
                f"it is for one array of at most {LARGEST} entries each",
                "Leave method out, or name another",
            )
        )  # fmt: skip
    t, both = jnp.asarray(t0, jnp.result_type(x0)), (x0, u0)
    wrong = []
    for name, fn in (("f", problem.f), ("h", problem.h)):
        joint = lambda t, both, fn=fn: fn(t, *both, args)  # noqa: E731
        constant = independent(lambda t, joint=joint: jax.jacfwd(joint, argnums=1)(t, both), t)
        if not (constant and analyse(lambda both, joint=joint: joint(t, both), both).affine):
            wrong.append(
                InputProblem(
                    f"{place}: {name}", "code that does not show it", f"{name} must be affine in "
                    "(x, u) with coefficients that do not depend on t",
                    "Leave method out, or name another",
                )
            )  # fmt: skip
    bounds = lambda t: problem.set_at(t, args).intervals(u0)  # noqa: E731
    if bounds(t) is None or not independent(bounds, t):
        wrong.append(
            InputProblem(
                f"{place}: K", type(problem.set_at(t, args)).__name__,
                "K must be a box that does not move", "Leave method out, or name another",
            )
        )  # fmt: skip
    if wrong:
        raise InputError(*wrong)


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
        return jax.jacfwd(at, argnums=(0, 1))(x0.ravel(), u0.ravel())

    (f_x, f_u), (h_x, h_u) = slopes(problem.f), slopes(problem.h)
    bounds = problem.set_at(t, args).intervals(u0)
    assert bounds is not None
    low, up = (v.ravel() for v in bounds)
    # What f has of the generator with the opposite sign cancels here, before anything is computed.
    return linear + f_x, f_u @ inverse, inverse - h_u @ inverse, -h_x, low, up


def pivoted(system: Affine) -> Affine:
    """The system with members of pairs exchanged one by one, where that halves A, or makes it smaller
    and M not much larger: the noise of a dependent member is in proportion to its coefficients."""
    size = np.abs(system.A).sum()
    for i in range(len(system.low)):
        if system.M[i, i] > 0.0:
            other = system.modified(i)
            smaller = np.abs(other.A).sum()
            tame = np.abs(other.M).max() <= 10.0 * np.abs(system.M).max()
            if smaller < (size if tame else 0.5 * size):
                system, size = other, smaller
    return system
