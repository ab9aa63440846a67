"""Success test of a solver's answer, and the error or NaN for one that failed."""

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
from .abstract import RESULTS, AbstractSolver, Answer, FrozenVI
from .auto import Auto
from .iteration import without_derivatives
from .solve import missed_tolerance, rounding_of

_ROUNDING_FACTOR = 64
"""An answer whose ‖w‖ is within this multiple of its rounding bound is at the roundoff floor. In
single precision the tolerance 10⁻¹⁰ lies below that floor."""


def is_solved(vi: FrozenVI, answer: Answer) -> Any:
    """Return whether an answer met its tolerance, or missed it because of rounding alone."""
    successful = answer.result == RESULTS.successful
    missed = missed_tolerance(answer.result)
    y = jax.lax.stop_gradient(answer.y)
    rounding, _ = rounding_of(without_derivatives(vi), y, answer.residual_step, answer.residual)
    return successful | (missed & (answer.residual <= _ROUNDING_FACTOR * rounding))


def unless_failed(vi: FrozenVI, answer: Answer, read: Callable[[Tree], Tree]) -> tuple[Tree, Any]:
    """Return read(y) for the y of an answer, and whether the answer solves the law.

    If it does not, values and derivatives are NaN.
    """
    solved, out = is_solved(vi, answer), read(answer.y)
    out = jtu.tree_map(lambda leaf: jnp.where(solved, leaf, jnp.nan), out)

    def dependencies(y: Tree) -> tuple[Tree, Any, Tree]:
        return vi.F(y), eqx.filter(vi.K, eqx.is_inexact_array), read(y)

    inputs = jtu.tree_leaves(eqx.filter_closure_convert(dependencies, answer.y))
    return nan_derivatives_where(~solved, out, inputs), solved


def raise_failure(solved: Any, answer: Answer, solver: AbstractSolver | None) -> None:
    """Raise a `dvax.SolveError`, which carries the answer, if it does not solve the law.

    Under tracing nothing can be raised.
    """
    if _tree.is_concrete(solved) and not bool(solved):
        raise _failure(answer, solver)


def _failure(answer: Answer, solver: AbstractSolver | None) -> SolveError:
    # Only the first sentence: the following ones name options of `solve_vi`.
    reason = RESULTS[answer.result].split(". ")[0].rstrip(".")
    name = type(Auto() if solver is None else solver).__name__
    cause = (
        f"The law was not solved by {name}: {reason[0].lower()}{reason[1:]} (‖w‖ = "
        f"{float(answer.residual):.3g} after {int(answer.iterations)} iterations)."
    )
    other = Fix("solver", "dvax.vi.Auto()", "which selects a method from the structure of the law")
    if isinstance(solver, Auto | None):
        other = Fix("solver", "dvax.vi.Extragradient(max_steps=1_000_000)", "a first-order method")
    sign = Fix("", "", "Check the sign with which h depends on u, or bound K")
    value = Fix("", "", "Evaluate h at the y of `solution` (u = P⁻¹y) to find the entries")
    not_monotone = (RESULTS.diverging, RESULTS.wrong_slope, RESULTS.no_bracket)
    if any(bool(answer.result == code) for code in not_monotone):
        fixes = (sign,)
    elif bool(answer.result == RESULTS.nonfinite):
        fixes = (value,)
    else:
        more = Fix("", "", "A larger max_steps of the solver may suffice")
        fixes = (other, more) if bool(answer.result == RESULTS.max_steps) else (other,)
    return SolveError(cause, answer, fixes)
