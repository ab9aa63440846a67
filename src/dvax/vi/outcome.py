"""What a caller of a solver may return of an answer: nothing that does not solve the law."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._failure import nan_derivatives_where
from .._tree import Tree
from ..errors import Fix, SolveError
from .abstract import RESULTS, AbstractSolver, Answer, Frozen
from .auto import Auto
from .iteration import stopped
from .solve import IN_VAIN, rounding_of

ROUNDINGS = 64
"""Iterates that cycle at the level of rounding keep ‖w‖ within so many times its bound. Single
precision does not reach the tolerance 10⁻¹⁰."""


def is_solved(vi: Frozen, answer: Answer) -> Any:
    """Whether an answer met its tolerance, or missed it by rounding alone."""
    good = answer.result == RESULTS.successful
    if _tree.is_concrete(good) and bool(good):
        return True
    vain = functools.reduce(jnp.logical_or, [answer.result == word for word in IN_VAIN])
    y = jax.lax.stop_gradient(answer.y)
    rounding, _ = rounding_of(stopped(vi), y, answer.length, answer.residual)
    return good | (vain & (answer.residual <= ROUNDINGS * rounding))


def unless_failed(
    vi: Frozen, answer: Answer, read: Callable[[Tree], Tree], solver: AbstractSolver | None
) -> Tree:
    """Return read(y), computed from the y of an answer that solves the law.

    **Raises:** `dvax.SolveError`, which carries the answer, where it does not; where that is traced,
    values and derivatives are NaN instead.
    """
    solved, out = is_solved(vi, answer), read(answer.y)
    if _tree.is_concrete(solved):
        if not bool(solved):
            raise _failure(answer, solver)
        return out
    out = jtu.tree_map(lambda leaf: jnp.where(solved, leaf, jnp.nan), out)
    everything = lambda y: (vi.F(y), eqx.filter(vi.K, eqx.is_inexact_array), read(y))  # noqa: E731
    inputs = jtu.tree_leaves(eqx.filter_closure_convert(everything, answer.y))
    return nan_derivatives_where(~solved, out, inputs)


def _failure(answer: Answer, solver: AbstractSolver | None) -> SolveError:
    # The first sentence says what happened; what follows speaks of the options of `solve_vi`.
    reason = RESULTS[answer.result].split(". ")[0].rstrip(".")
    name = type(Auto() if solver is None else solver).__name__
    cause = (
        f"The law was not solved by {name}: {reason[0].lower()}{reason[1:]} (‖w‖ = "
        f"{float(answer.residual):.3g} after {int(answer.iterations)} iterations)."
    )
    other = Fix("solver", "dvax.vi.Auto()", "which chooses by the structure of the law")
    if isinstance(solver, Auto | None):
        other = Fix("solver", "dvax.vi.Extragradient(max_steps=1_000_000)", "a first-order method")
    sign = Fix("", "", "Check the sign of the way in which h depends on u, or bound K")
    value = Fix("", "", "Evaluate h at the y of `solution` (u = P⁻¹y) to see where")
    lawless = (RESULTS.diverging, RESULTS.wrong_slope, RESULTS.no_bracket)
    if any(bool(answer.result == word) for word in lawless):
        fixes = (sign,)
    elif bool(answer.result == RESULTS.nonfinite):
        fixes = (value,)
    else:
        more = Fix("", "", "A larger max_steps of the solver may be enough")
        fixes = (other, more) if bool(answer.result == RESULTS.max_steps) else (other,)
    return SolveError(cause, answer, fixes)
